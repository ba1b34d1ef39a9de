"""Mutation testing of the rooms `control` and `axis`; `python -m tools.mutation.run --help`."""
