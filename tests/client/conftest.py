"""A service that is a script."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.client.script import Script


@pytest.fixture
def script(tmp_path: Path) -> Iterator[Script]:
    made = Script(tmp_path / "s")
    yield made
    made.close()
