"""Fuzzing of the frames, the control socket and the configuration; `python -m tools.fuzz.run --help`."""
