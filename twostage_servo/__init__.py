"""Two-stage servo control over CAN for Linux."""

__version__ = "0.1.0"
