"""A type of drives as another package brings it, in a distribution that is made for a test."""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from twostage_servo.drives import registry

EXAMPLE = Path(__file__).parents[2] / "examples" / "04_own_drive"


def install(folder: Path, entry_points: str) -> None:
    """Put a distribution with the drive of the example into a folder."""
    shutil.copy(EXAMPLE / "node_drive.py", folder)
    information = folder / "node_drive-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: node-drive\nVersion: 1.0\n", encoding="utf-8")
    (information / "entry_points.txt").write_text(f"[{registry.GROUP}]\n{entry_points}\n", encoding="utf-8")


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install the type `node` for a test."""
    install(tmp_path, "node = node_drive:DRIVE")
    monkeypatch.syspath_prepend(tmp_path)
    registry.drive_type.cache_clear()
    yield
    registry.drive_type.cache_clear()
    sys.modules.pop("node_drive", None)
