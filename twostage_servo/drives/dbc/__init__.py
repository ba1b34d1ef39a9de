"""A drive whose frames a DBC file describes."""
