"""Does the service manager wait until the axes are at rest?"""

import math
from collections.abc import Sequence
from pathlib import Path

import pytest

from twostage_servo.host.findings import Host, Status
from twostage_servo.host.service_manager import seconds, service_manager_finding


def host(*lines: str, error: OSError | None = None) -> Host:
    def run(command: Sequence[str]) -> str:
        assert command[:3] == ["systemctl", "show", "twostage-servo.service"]
        if error is not None:
            raise error
        return "\n".join(lines)

    return Host(Path("/nowhere"), Path("/nowhere"), run)


@pytest.mark.parametrize(
    ("lines", "longest_s", "status", "words"),
    [
        (("LoadState=loaded", "NotifyAccess=main", "TimeoutStopUSec=15s"), 12.8, Status.OK, "waits for 15 s"),
        (("LoadState=loaded", "NotifyAccess=main", "TimeoutStopUSec=15s"), 72.0, Status.OK, "if the service asks"),
        (("LoadState=loaded", "NotifyAccess=none", "TimeoutStopUSec=15s"), 12.8, Status.OK, "waits for 15 s"),
        (("LoadState=loaded", "NotifyAccess=none", "TimeoutStopUSec=1min 30s"), 91.0, Status.WARN, "waits for 90 s"),
        (("LoadState=loaded", "NotifyAccess=none", "TimeoutStopUSec=infinity"), 91.0, Status.OK, "waits for inf s"),
        (("LoadState=loaded", "NotifyAccess=none", "TimeoutStopUSec=soon"), 91.0, Status.SKIP, "does not report"),
        (
            ("LoadState=not-found", "TimeoutStopUSec=1min 30s"),
            1.0,
            Status.SKIP,
            "service is not installed",
        ),
    ],
)
def test_how_long_it_waits(lines: Sequence[str], longest_s: float, status: Status, words: str) -> None:
    finding = service_manager_finding(host(*lines), longest_s)
    assert finding.status is status
    assert words in finding.found
    assert ("TimeoutStopSec=91" in finding.remedy) is (status is Status.WARN)


@pytest.mark.parametrize(
    ("error", "words"),
    [(FileNotFoundError(), "no systemd"), (OSError("not booted with it"), "failed: not booted with it")],
)
def test_without_a_manager_there_is_nothing_to_check(error: OSError, words: str) -> None:
    finding = service_manager_finding(host(error=error), 1.0)
    assert finding.status is Status.SKIP
    assert words in finding.found


@pytest.mark.parametrize(
    ("text", "expected_s"),
    [("15s", 15.0), ("1min 30s", 90.0), ("500ms", 0.5), ("1h 5min 100us", 3900.0001), ("1.5s", 1.5), ("0", None),
     ("", None), ("5 fortnights", None), ("infinity", math.inf)],
)  # fmt: skip
def test_time_spans_as_systemd_shows_them(text: str, expected_s: float | None) -> None:
    assert seconds(text) == (expected_s if expected_s is None else pytest.approx(expected_s))
