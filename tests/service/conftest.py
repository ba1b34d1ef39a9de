"""What tests of the control socket share."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where the control socket is."""
    return tmp_path / "control.sock"


@pytest.fixture
def callers() -> Iterator[contextlib.ExitStack]:
    """What closes, at the end, the sockets of clients that speak for themselves."""
    with contextlib.ExitStack() as stack:
        yield stack
