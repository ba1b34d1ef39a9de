"""Where configuration files are: those that are named, and those that came with this package."""

from pathlib import Path


def find_configuration(path: Path | None) -> Path | None:
    """Return a path that exists as it is; a bare name that does not may be one of the shipped files."""
    if path is None or path.exists() or path.parent != Path():
        return path
    shipped = shipped_configuration(path.name)
    return shipped if shipped.exists() else path


def shipped_configuration(name: str) -> Path:
    """Return where a file that came with this package is, whatever lies in the working directory."""
    import importlib.resources  # noqa: PLC0415 - the operator's commands start without it

    return Path(str(importlib.resources.files("twostage_servo_config"))) / name
