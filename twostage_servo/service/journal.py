"""The journal's own protocol, as in systemd.io/JOURNAL_NATIVE_PROTOCOL: one datagram an entry, with fields.

Ours, because the package for it needs libsystemd to build, and it is a few lines.
"""

import json
import os
import re
import socket
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TextIO

from twostage_servo.printable import printable, printable_line

_SOCKET: Final = "/run/systemd/journal/socket"
_PRIORITY: Final = {"debug": 7, "info": 6, "warning": 4, "error": 3, "critical": 2}
_FIELD: Final = re.compile(r"[A-Z][A-Z0-9_]{0,63}")
_MEANT_OTHERWISE: Final = frozenset({"MESSAGE", "PRIORITY", "UNIT"})
"""Fields that the journal and its tools take for something else than a key of ours."""
_NO_FIELD: Final = frozenset({"event", "level", "timestamp"})
_NO_DETAIL: Final = _NO_FIELD | {"axis", "exception"}


def goes_to_the_journal(stream: TextIO) -> bool:
    """Whether systemd's journal is what reads a stream: it has said which one in the environment."""
    try:
        there = os.fstat(stream.fileno())
    except (AttributeError, OSError, ValueError):  # not a file
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{there.st_dev}:{there.st_ino}"


def journal_entry(event: Mapping[str, Any]) -> bytes:
    """Return an event as a datagram: a message for eyes, its priority, and each key as a field."""
    axis = f"{event['axis']}: " if "axis" in event else ""
    details = "".join(f" {key}={_detail(value)}" for key, value in event.items() if key not in _NO_DETAIL)
    traceback = "\n" + printable(event["exception"]) if "exception" in event else ""
    entry = _field("MESSAGE", printable_line(f"{axis}{event['event']}{details}") + traceback) + _field(
        "PRIORITY", str(_priority(event))
    )
    for key, value in event.items():
        name = key.upper()
        if key not in _NO_FIELD and name not in _MEANT_OTHERWISE and _FIELD.fullmatch(name):
            entry += _field(name, printable(value) if isinstance(value, str) else json.dumps(value))
    return entry


def _priority(event: Mapping[str, Any]) -> int:
    return _PRIORITY.get(event["level"], 6)


def _detail(value: object) -> str:
    if isinstance(value, str) and re.fullmatch(r'[^\s"=]+', value):
        return value
    return json.dumps(value, ensure_ascii=False)


def _field(name: str, value: str) -> bytes:
    data = value.encode(errors="replace")
    if b"\n" in data:  # several lines stand behind their length
        return name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n"
    return name.encode() + b"=" + data + b"\n"


class JournalStream:
    """Sends each line of JSON to the journal as an entry.

    Parameters
    ----------
    spare
        Takes the line, behind the ``<N>`` prefix by which the journal tells the priority, where the journal's socket
        does not: while the journal starts anew, or where the entry is too long for a datagram.
    address
        Path of the socket.
    """

    def __init__(self, spare: TextIO, address: str | Path = _SOCKET) -> None:
        self._spare = spare
        self._address = str(address)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)

    def write(self, line: str) -> None:
        """Send one line."""
        event = json.loads(line)
        try:
            self._socket.sendto(journal_entry(event), self._address)
        except OSError:
            self._spare.write(f"<{_priority(event)}>{line}")
            self._spare.flush()

    def flush(self) -> None:
        """Do nothing: each entry was sent as it was written."""

    def close(self) -> None:
        """Close the socket; the spare stream stays its owner's."""
        self._socket.close()
