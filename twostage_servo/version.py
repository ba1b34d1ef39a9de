"""The version of the package, for whoever has to say it; pyproject.toml has the same."""

__version__ = "0.1.0"
