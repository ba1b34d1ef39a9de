"""The systemd units and their companion files, as `twostage-servo install-service` installs them."""
