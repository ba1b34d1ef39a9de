"""Nothing that a client, a file or a drive says gives orders to a terminal."""

import io
import json
import math
import re
import sys
import unicodedata
from pathlib import Path
from typing import Any

import pytest
import structlog
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from twostage_servo.api.law_status import IdentifiedStatus, LawStatus, LoadStatus, RejectionStatus
from twostage_servo.api.status import (
    AuthorityStatus,
    AxisReport,
    AxisStatus,
    BusStatus,
    DriveStatus,
    FrameStatus,
    InputStatus,
    ServiceStatus,
    Status,
    TickStatus,
    Times,
    TripStatus,
    Trouble,
)
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.cli.axis_text import describe, lines_of
from twostage_servo.cli.main import build_parser
from twostage_servo.cli.output import Progress, note, print_json, print_line
from twostage_servo.printable import printable, printable_json, printable_line, ready_for_json
from twostage_servo.service.journal import journal_entry
from twostage_servo.service.log import open_log

ORDERS = ["\x1b[2J", "\x9b2J", "\x07", "\r", "\x08", "\x7f", "\u202e", "\u2028", "\ud800", "\x00", "\x85", "\n"]
texts = st.text(st.characters(), max_size=50) | st.lists(st.sampled_from(ORDERS) | st.text(max_size=5), max_size=8).map(
    "".join
)
FIXTURE = [HealthCheck.function_scoped_fixture]


def harmless(text: str) -> bool:
    """Whether a terminal only shows a text, and breaks its lines."""
    return all(
        character == "\n" or unicodedata.category(character) not in {"Cc", "Cf", "Cs", "Co", "Zl", "Zp"}
        for character in text
    )


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setattr(sys, "stderr", terminal)
    return terminal


@given(text=texts)
def test_what_is_printable_stays_and_what_is_not_is_an_escape(text: str) -> None:
    shown = printable(text)
    assert harmless(shown)
    assert shown.count("\n") == text.count("\n")
    assert printable(shown) == shown
    assert "\n" not in printable_line(text)
    if harmless(text) and text.isprintable():
        assert shown == text
    shown.encode()  # which half a surrogate could not be


@pytest.mark.parametrize("text", ["400 mm, 24,5 °C", "N·m", "µs", "漢字 😀", "a\u00a0b", "two\nlines", ""])
def test_usual_text_is_left_alone(text: str) -> None:
    assert printable(text) == text


@given(value=st.recursive(texts, lambda inner: st.lists(inner) | st.dictionaries(texts, inner), max_leaves=5))
def test_json_stays_the_same_json(value: Any) -> None:
    text = printable_json(json.dumps(value))
    assert harmless(text)
    assert json.loads(text) == value


@settings(suppress_health_check=FIXTURE)
@given(text=texts)
def test_the_command_line_prints_no_orders(screen: Terminal, text: str) -> None:
    start = screen.tell()
    print_line(text)
    note(text)
    print_json({"message": text})
    progress = Progress(quiet=False)
    progress.show(text)
    progress.end()
    shown = screen.getvalue()[start:]
    assert harmless(shown.replace("\r\x1b[K", ""))  # the live line's own


@settings(suppress_health_check=FIXTURE)
@given(text=texts)
def test_a_status_is_shown_whatever_its_texts_say(screen: Terminal, text: str) -> None:
    start = screen.tell()
    times = Times(p50=0.0, p90=0.0, p99=0.0, max=0.0)
    counts = dict.fromkeys(
        (
            "received", "sent", "rejected", "dropped", "errors", "overflowed", "overruns", "late", "lost", "doubled",
            "reordered", "implausible", "recent_errors", "predicted",
        ),
        0,
    )  # fmt: skip
    code = TripCode.FOLLOWING_ERROR
    report = AxisReport(
        axis=AxisStatus(
            name=text, unit=text, effort_unit=text, state=State.TRIPPED, cia402=text, referenced=False, reference=None,
            reference_lost=text, position=1.0, feedback_age_ms=None, velocity=None, disturbance=None, effort=0.0,
            target=None, following_error=0.0, saturated=False, override_percent=50.0,
        ),
        move=None,
        trip=TripStatus(
            code=code, cause=text, next_action=text, tick=1, reaction=text, escalation=None, codes=[code, code],
            file=text, file_error=text,
        ),
        drive=DriveStatus(
            enabled=None, disabling=False, moved=1.0, lasting=[Trouble(code=code, cause=text, next_action=text)]
        ),
        inputs=InputStatus(safe_torque_off=True, positive_limit=None, negative_limit=None, home_switch=None),
        frames=FrameStatus(
            **counts, rejected_by_reason={}, errors_by_kind={}, age_us=None, feedback_to_command_us=None
        ),
        bus=BusStatus(channel=text, open=False, error=text, drive_state=None, controller=text, error_counters=None),
        law=LawStatus(
            type=text, accepted=False, file_error=text,
            rejection=RejectionStatus(code=text, cause=text, degrades=True),
            identified=IdentifiedStatus(
                gain=1.0, pole=1.0, delay_ticks=1, load=LoadStatus(forward=1.0, backward=None), moves=1
            ),
        ),
    )  # fmt: skip
    service = ServiceStatus(
        version=text, pid=1, uptime_s=0.0, authority=AuthorityStatus(holder=text), realtime=None,
        ticks=TickStatus(count=1, missed=0, lateness_us=times, lateness_histogram=[], duration_us={"whole": times}),
    )  # fmt: skip
    status = Status(service=service, axes={text: report})
    print_line(lines_of(status))
    print_line(describe(status))
    assert harmless(screen.getvalue()[start:])


def test_the_parser_repeats_arguments_without_orders(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        build_parser().parse_args(["status", "--no-such\x1b[2J"])
    said = capsys.readouterr().err
    assert "--no-such\\x1b[2J" in said
    assert harmless(said)


@pytest.mark.parametrize("kind", [Terminal, io.StringIO])
@settings(max_examples=30, deadline=None)
@given(text=texts)
def test_the_log_gives_no_orders_but_its_own_colours(kind: type[io.StringIO], text: str) -> None:
    stream = kind()
    writer = open_log("info", stream)
    log = structlog.get_logger().bind(axis=text)
    log.warning(text, reason=text, positions={text: 1.0}, names=[text])
    log.error("a defect", exc_info=ValueError(text))
    writer.close()
    shown = re.sub(r"\x1b\[\d+m", "", stream.getvalue())
    assert "a defect" in shown
    assert harmless(shown)


def test_the_log_shows_the_values_of_enumerations_inside_a_field_as_well() -> None:
    stream = Terminal()
    writer = open_log("info", stream)
    structlog.get_logger().info("ending", states={"x": State.DISARMED}, told=(State.HOLDING, 1), now=State.TRIPPED)
    writer.close()
    shown = re.sub(r"\x1b\[\d+m", "", stream.getvalue())
    assert "now=tripped states={'x': 'disarmed'} told=('holding', 1)" in shown


@given(text=texts)
def test_the_journal_has_no_orders_in_its_message(text: str) -> None:
    entry = journal_entry({"event": text, "level": "info", "axis": text, "reason": text, "more": {text: 1}})
    first, _, rest = entry.partition(b"\n")
    assert first.startswith(b"MESSAGE=")
    assert harmless(first.decode())
    assert rest.startswith(b"PRIORITY=6\n")


def test_no_other_place_writes_to_a_terminal() -> None:
    """Whoever adds a print has to send it through the functions that are tested here."""
    package = Path(__file__).resolve().parents[1] / "twostage_servo"
    writers = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if re.search(r"\bprint\(|sys\.std(out|err)\.write", path.read_text(encoding="utf-8"))
    }
    # The children of the fault campaign write numbers, and JSON without control characters, to their parent.
    assert writers == {"cli/output.py", "faults/child.py", "faults/power_cut.py"}


def test_what_is_no_number_in_json_is_null() -> None:
    values = [1.5, math.nan, math.inf, -math.inf, None, "nan", 7, True]
    assert ready_for_json(values) == [1.5, None, None, None, None, "nan", 7, True]
