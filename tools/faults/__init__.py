"""The matrices of the fault campaign in the docs: the tool is `python tools/write_tables.py --help`."""
