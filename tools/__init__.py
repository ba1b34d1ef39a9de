"""Benchmarks, soak, fuzzing, mutation testing, the rig, the package builder; run with ``python -m``."""
