"""A law as another package brings it, in a distribution that is made for a test."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from twostage_servo.axis import law_settings
from twostage_servo.control.laws import registry

EXAMPLE = Path(__file__).parents[2] / "examples" / "05_own_law"


def forget_laws() -> None:
    """Let the laws be looked for anew."""
    registry.law_type.cache_clear()
    law_settings._with_tables.cache_clear()


def install(folder: Path, entry_points: str) -> None:
    """Put a distribution with the law of the example into a folder."""
    shutil.copy(EXAMPLE / "cascade_law.py", folder)
    information = folder / "cascade_law-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: cascade-law\nVersion: 1.0\n", encoding="utf-8")
    (information / "entry_points.txt").write_text(f"[{registry.GROUP}]\n{entry_points}\n", encoding="utf-8")


@pytest.fixture
def cascade(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install the law `cascade` for a test."""
    install(tmp_path, "cascade = cascade_law:LAW")
    monkeypatch.syspath_prepend(tmp_path)
    forget_laws()
    yield
    forget_laws()
