"""A throw-away virtual machine with CAN and systemd, and what is tried out in it."""
