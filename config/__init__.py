"""The shipped configurations and the drive's DBC, importable so that an installed wheel finds its embedded defaults."""
