"""Fuzzing of the frames, the control socket and the configuration; `python tools/fuzz/run.py --help`."""
