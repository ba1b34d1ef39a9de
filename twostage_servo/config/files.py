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
    return _shipped_folder() / name


def similar_configurations(path: Path) -> list[str]:
    """Return names of configurations that may have been meant by one that does not exist, the likeliest first."""
    import difflib  # noqa: PLC0415 - as above

    beside = [*path.parent.glob("*.toml"), *(_shipped_folder().glob("*.toml") if path.parent == Path() else ())]
    names = {one.stem: one.name for one in beside}
    return [str(path.with_name(names[stem])) for stem in difflib.get_close_matches(path.stem, names, cutoff=0.7)]


def _shipped_folder() -> Path:
    import importlib.resources  # noqa: PLC0415 - the operator's commands start without it

    return Path(str(importlib.resources.files("twostage_servo_config")))
