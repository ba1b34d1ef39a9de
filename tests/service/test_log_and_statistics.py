"""The log's thread and the statistics of the ticks."""

import contextlib
import io
import json
import logging
import queue
import threading

import structlog

from twostage_servo.service.log import LogWriter, RateLimit, open_log
from twostage_servo.service.statistics import TickStatistics


class StuckStream(io.StringIO):
    """A stream whose reader has stopped reading, until it is let go."""

    def __init__(self) -> None:
        super().__init__()
        self.let_go = threading.Event()
        self.entered = threading.Event()
        self.written: queue.SimpleQueue[str] = queue.SimpleQueue()

    def write(self, text: str) -> int:
        self.entered.set()
        self.let_go.wait(60)
        length = super().write(text)
        self.written.put(text)
        return length


def test_a_stuck_log_drops_lines_and_counts_them() -> None:
    stream = StuckStream()
    writer = LogWriter(stream, capacity=10)
    writer.msg("first")
    assert stream.entered.wait(60)
    for number in range(25):
        writer.msg(f"line {number}")
    assert writer.dropped == 15
    stream.let_go.set()
    writer.close()
    assert stream.getvalue().splitlines() == ["first", *(f"line {number}" for number in range(10))]


def test_lines_that_were_lost_are_told_as_soon_as_there_is_room() -> None:
    stream = StuckStream()
    writer = open_log("info", stream, capacity=10)
    log = structlog.get_logger()
    log.info("first")
    assert stream.entered.wait(60)
    for number in range(25):
        log.info(f"line {number}")
    stream.let_go.set()
    while "line 9" not in stream.written.get(timeout=60):
        pass
    log.info("after")
    log.info("and on")
    writer.close()
    told = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [one["event"] for one in told[11:]] == [
        "after", "log lines were lost: the reader of the log does not keep up", "and on",
    ]  # fmt: skip
    assert (told[12]["level"], told[12]["lines"]) == ("error", 15)


def test_a_stream_that_is_gone_is_no_error() -> None:
    stream = io.StringIO()
    stream.close()
    writer = LogWriter(stream)
    writer.msg("lost")
    writer.close()
    assert writer.dropped == 1


def test_a_line_is_json() -> None:
    stream = io.StringIO()
    handlers = logging.getLogger().handlers[:]
    writer = open_log("info", stream)
    structlog.get_logger().debug("not written")
    structlog.get_logger().warning("late", tick=7)
    logging.getLogger("library").warning("from %s", "elsewhere")
    writer.close()
    first, second = stream.getvalue().splitlines()
    assert json.loads(first) | {"timestamp": 0} == {"event": "late", "level": "warning", "tick": 7, "timestamp": 0}
    assert json.loads(second)["event"] == "from elsewhere"
    assert logging.getLogger().handlers == handlers


def test_of_a_flood_the_log_has_the_beginning_and_the_number() -> None:
    now_s = 0.0
    limit = RateLimit(burst=3, window_s=10.0, clock=lambda: now_s)

    def passes(**event: object) -> dict[str, object] | None:
        try:
            return dict(limit(None, "warning", {"event": "refused", **event}))
        except structlog.DropEvent:
            return None

    through = [passes(tick=tick) for tick in range(8)]
    assert [event and event["tick"] for event in through] == [0, 1, 2, *[None] * 5]
    assert passes(axis="y") is not None  # another axis, and another code, are other kinds
    assert passes(code="busy") is not None
    assert passes(op="reset") is not None  # as are another request and another state
    assert passes(now="tripped") is not None
    now_s = 10.0
    assert passes(tick=9) == {"event": "refused", "tick": 9, "left_out": 5}
    now_s = 20.0
    assert passes(tick=10) == {"event": "refused", "tick": 10}


def test_texts_that_never_come_twice_do_not_fill_the_memory() -> None:
    now_s = 0.0
    limit = RateLimit(burst=100, window_s=10.0, clock=lambda: now_s)
    through = 0
    for number in range(5000):
        with contextlib.suppress(structlog.DropEvent):
            limit(None, "info", {"event": f"number {number}"})
            through += 1
    assert len(limit._kinds) <= 1000
    assert through == 999 + 100  # each kind once, and the rest as one kind more
    assert limit(None, "info", {"event": "number 7"})  # a kind that is known is none of the rest
    now_s = 20.0
    for number in range(5000, 5999):
        limit(None, "info", {"event": f"number {number}"})


def test_a_flood_of_made_up_names_is_one_kind_and_hides_nobody_else() -> None:
    limit = RateLimit(clock=lambda: 0.0)
    through = 0
    for number in range(8000):
        with contextlib.suppress(structlog.DropEvent):
            refusal = {"event": "refused", "axis": f"made up {number}", "op": "move", "code": "which_axis"}
            limit(None, "warning", refusal | {"reason": f"there is no axis {number}", "peer": f"#{number}"})
            through += 1
    assert through == 100
    assert limit(None, "warning", {"event": "refused", "axis": "x", "op": "reset", "code": "busy"})
    assert limit(None, "error", {"event": "trip", "axis": "x", "code": "stall"})


def test_what_a_library_logs_is_one_kind_a_library() -> None:
    stream = io.StringIO()
    writer = open_log("info", stream)
    for number in range(300):
        logging.getLogger("chatty").warning("number %d", number)
    logging.getLogger("other").warning("once")
    writer.close()
    told = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [one["event"] for one in told[-2:]] == ["number 99", "once"]
    assert len(told) == 101
    assert "library" not in told[0]


def test_a_log_within_a_log_gives_the_outer_one_back() -> None:
    structlog.reset_defaults()  # other tests of this process may have had a log of their own
    outer_stream, inner_stream = io.StringIO(), io.StringIO()
    outer = open_log("info", outer_stream)
    inner = open_log("critical", inner_stream)
    structlog.get_logger().critical("inside")
    inner.close()
    structlog.get_logger().info("outside")
    outer.close()
    assert not structlog.is_configured()
    assert "inside" in inner_stream.getvalue()
    assert [json.loads(line)["event"] for line in outer_stream.getvalue().splitlines()] == ["outside"]


def test_what_the_ticks_were_like_is_told_by_phase_and_as_a_histogram() -> None:
    statistics = TickStatistics()
    statistics.begin(0.01, 3e-6, 0)
    statistics.end(0.0, 10e-6, 30e-6, 35e-6, 45e-6, 50e-6)
    statistics.begin(0.04, 300e-6, 2)
    statistics.end(0.0, 10e-6, 30e-6, 35e-6, 45e-6, 50e-6)
    told = json.loads(json.dumps(statistics.summary().to_json()))
    assert (told["count"], told["missed"]) == (2, 2)
    assert statistics.uptime_s == 0.04
    assert told["lateness_us"]["max"] == 300.0
    assert told["lateness_histogram"] == [{"up_to_us": 3.16, "ticks": 1}, {"up_to_us": 316.0, "ticks": 1}]
    assert {name: row["max"] for name, row in told["duration_us"].items()} == {
        "read": 10.0, "update": 20.0, "hold": 5.0, "write": 10.0, "publish": 5.0, "whole": 50.0,
    }  # fmt: skip
