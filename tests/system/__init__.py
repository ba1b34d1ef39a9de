"""What must hold on a real bus under a real systemd, and of the Debian package; run in the rig's machine."""
