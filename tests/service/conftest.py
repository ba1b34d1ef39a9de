"""What tests of the control socket share."""

import contextlib
from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import Any, NoReturn

import pytest
import structlog

from tests.service.log_fields import defects


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where the control socket is."""
    return tmp_path / "control.sock"


@pytest.fixture
def callers() -> Iterator[contextlib.ExitStack]:
    """What closes, at the end, the sockets of clients that speak for themselves."""
    with contextlib.ExitStack() as stack:
        yield stack


@pytest.fixture(autouse=True)
def log_lines(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[dict[str, Any]]]:
    """Every line of the log that a test brings about, each of which has to have its fields."""
    lines: list[dict[str, Any]] = []
    capture = structlog.testing.LogCapture.__call__

    def captured(
        self: structlog.testing.LogCapture, logger: Any, method: str, event: MutableMapping[str, Any]
    ) -> NoReturn:
        lines.append(dict(event))
        capture(self, logger, method, event)

    def seen(_: Any, __: str, event: MutableMapping[str, Any]) -> Mapping[str, Any]:
        lines.append(dict(event))
        raise structlog.DropEvent

    monkeypatch.setattr(structlog.testing.LogCapture, "__call__", captured)
    before = structlog.get_config() if structlog.is_configured() else None
    structlog.configure(processors=[seen])
    yield lines
    structlog.reset_defaults()
    if before is not None:
        structlog.configure(**before)
    assert defects(lines) == []
