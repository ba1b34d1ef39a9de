"""A type of drives as another package brings it, in a distribution that is made for a test."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import installed
from twostage_servo.drives import registry

EXAMPLE = Path(__file__).parents[2] / "examples" / "04_own_drive"


def install(folder: Path, entry_points: str) -> None:
    """Put a distribution with the drive of the example into a folder."""
    installed.install(folder, EXAMPLE / "node_drive.py", registry.GROUP, entry_points)


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install the type `node` for a test."""
    install(tmp_path, "node = node_drive:DRIVE")
    monkeypatch.syspath_prepend(tmp_path)
    registry.DRIVES.forget()
    yield
    registry.DRIVES.forget()
    sys.modules.pop("node_drive", None)
