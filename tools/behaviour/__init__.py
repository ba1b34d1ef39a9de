"""What the service does, frame by frame, as a hash a run; ``python -m tools.behaviour.run --help``."""
