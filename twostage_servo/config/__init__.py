"""From a TOML file to the settings of the rooms: the loader, the machine of several axes, and what is wrong where."""
