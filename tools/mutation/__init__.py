"""Mutation testing of the rooms `control` and `axis`; `python tools/mutation/run.py --help`."""
