"""A law as another package brings it, in a distribution that is made for a test."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import installed
from twostage_servo.axis import law_settings
from twostage_servo.control.laws import registry

EXAMPLE = Path(__file__).parents[2] / "examples" / "05_own_law"


def forget_laws() -> None:
    """Let the laws be looked for anew."""
    registry.LAWS.forget()
    law_settings._with_tables.cache_clear()


def install(folder: Path, entry_points: str) -> None:
    """Put a distribution with the law of the example into a folder."""
    installed.install(folder, EXAMPLE / "cascade_law.py", registry.GROUP, entry_points)


@pytest.fixture
def cascade(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install the law `cascade` for a test."""
    install(tmp_path, "cascade = cascade_law:LAW")
    monkeypatch.syspath_prepend(tmp_path)
    forget_laws()
    yield
    forget_laws()
