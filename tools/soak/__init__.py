"""Soak: months of random operation in simulated time, and hostile clients; ``python -m tools.soak.run --help``."""
