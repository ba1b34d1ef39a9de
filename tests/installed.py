"""A package with an entry point, as another project brings it, installed for a test."""

import shutil
from pathlib import Path


def install(folder: Path, module: Path, group: str, entry_points: str) -> None:
    """Put a distribution with one module, and its entry points of a group, into a folder."""
    name = module.stem
    shutil.copy(module, folder)
    information = folder / f"{name}-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    (information / "entry_points.txt").write_text(f"[{group}]\n{entry_points}\n", encoding="utf-8")
