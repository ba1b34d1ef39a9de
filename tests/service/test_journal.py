"""What the journal gets, over a real datagram socket."""

import io
import json
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import pytest
import structlog

from twostage_servo.service import journal
from twostage_servo.service.journal import JournalStream, goes_to_the_journal
from twostage_servo.service.log import open_log


@pytest.fixture
def address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the journal's socket is."""
    path = tmp_path / "socket"
    begin = JournalStream.__init__
    monkeypatch.setattr(JournalStream, "__init__", lambda stream, spare: begin(stream, spare, path))
    return path


@pytest.fixture
def reader(address: Path) -> Iterator[socket.socket]:
    """The journal's socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as reading:
        reading.bind(str(address))
        reading.settimeout(30.0)
        yield reading


@pytest.fixture
def stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TextIO]:
    """A file that the environment names as the one that the journal reads."""
    with (tmp_path / "stderr").open("w+") as opened:
        there = os.fstat(opened.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{there.st_dev}:{there.st_ino}")
        yield opened


def fields(datagram: bytes) -> dict[str, str]:
    """Read an entry as the journal does."""
    found = {}
    while datagram:
        line, _, datagram = datagram.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if not equals:
            (length,) = struct.unpack("<Q", datagram[:8])
            value, datagram = datagram[8 : 8 + length], datagram[9 + length :]
        found[name.decode()] = value.decode()
    return found


def test_axis_tick_and_code_are_fields_beside_message_and_priority(reader: socket.socket, stream: TextIO) -> None:
    writer = open_log("info", stream)
    log = structlog.get_logger().bind(axis="x")
    log.error("trip", tick=7, code="stall", cause="effort 12 V\nand no motion")
    log.info("state", states={"y": "holding"}, message="m", priority="high")
    writer.close()
    entry = fields(reader.recv(65536))
    assert entry == {
        "MESSAGE": 'x: trip tick=7 code=stall cause="effort 12 V\\nand no motion"', "PRIORITY": "3", "AXIS": "x",
        "TICK": "7", "CODE": "stall", "CAUSE": "effort 12 V\nand no motion",
    }  # fmt: skip
    entry = fields(reader.recv(65536))
    assert (entry["PRIORITY"], entry["STATES"]) == ("6", '{"y": "holding"}')
    assert entry["MESSAGE"].startswith("x: state")
    stream.seek(0)
    assert stream.read() == ""


def test_a_traceback_is_in_the_message(reader: socket.socket, stream: TextIO) -> None:
    writer = open_log("info", stream)
    try:
        json.loads("broken")
    except ValueError as error:
        structlog.get_logger().critical("failed", exc_info=error)
    writer.close()
    entry = fields(reader.recv(65536))
    assert entry["PRIORITY"] == "2"
    assert entry["MESSAGE"].startswith("failed\nTraceback")
    assert "JSONDecodeError: Expecting value" in entry["MESSAGE"]


@pytest.mark.usefixtures("address")
def test_without_the_journals_socket_the_line_goes_to_the_stream_with_its_priority(stream: TextIO) -> None:
    writer = open_log("info", stream)
    structlog.get_logger().warning("late", tick=7)
    writer.close()
    stream.seek(0)
    assert stream.read().startswith('<4>{"tick": 7, "event": "late", "level": "warning"')


def test_an_entry_that_is_too_long_goes_to_the_stream(reader: socket.socket) -> None:
    spare = io.StringIO()
    reader.setblocking(False)
    journal_stream = JournalStream(spare)
    journal_stream.write('{"event": "long", "level": "info", "text": "' + "x" * 2_000_000 + '"}\n')
    journal_stream.close()
    assert spare.getvalue().startswith("<6>{")
    with pytest.raises(BlockingIOError):
        reader.recv(10)


def test_another_stream_than_the_journals_is_left_as_it_is(
    stream: TextIO, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert goes_to_the_journal(stream)
    assert not goes_to_the_journal(io.StringIO())
    with (tmp_path / "other").open("w") as other:
        assert not goes_to_the_journal(other)
    monkeypatch.delenv("JOURNAL_STREAM")
    assert not goes_to_the_journal(stream)
    assert journal._SOCKET == "/run/systemd/journal/socket"
