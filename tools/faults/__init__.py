"""The matrices of the fault campaign in the docs: the tool is `python -m tools.write_tables --help`."""
