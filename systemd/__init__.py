"""The units of systemd and what belongs to them, as `twostage-servo install-service` places them."""
