"""What a connection makes of a service that does not answer, is not there, is not to be trusted, or ends it."""

import contextlib
import os
import socket
import struct
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.client.script import Script, done, lines, refused, snapshot
from twostage_servo.api.requests import ArmRequest, StatusRequest, WatchRequest
from twostage_servo.client import connection as connection_module
from twostage_servo.client.connection import Connection
from twostage_servo.client.errors import ConfigError, Reason, Refused, ServoError, Unreachable

FULL = refused("too_many_clients")


def test_who_finds_the_queue_full_waits_for_a_place_in_it(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener, contextlib.ExitStack() as queue:
        listener.bind(str(tmp_path / "s"))
        listener.listen(0)
        first = queue.enter_context(socket.socket(socket.AF_UNIX))
        first.connect(str(tmp_path / "s"))
        with pytest.raises(Unreachable, match="other clients keep connecting") as caught:
            Connection(tmp_path / "s", 0.05)
        assert caught.value.code is Reason.NO_SERVICE

        def accept_connections() -> None:
            for _ in range(2):
                queue.enter_context(listener.accept()[0])

        waiting = threading.Thread(target=lambda: queue.callback(Connection(tmp_path / "s", 60.0).close))
        waiting.start()
        accept_connections()
        waiting.join(60.0)
        assert not waiting.is_alive()


def test_a_watcher_that_has_to_make_room_is_told_so(script: Script) -> None:
    with contextlib.closing(script.connection_of()) as connection:
        script.answers(done(), snapshot(pid=1), FULL)
        script.connection.close()
        watched = connection.snapshots(WatchRequest(every=1))
        assert next(watched).service.pid == 1
        with pytest.raises(Refused, match="too_many_clients"):
            next(watched)


def test_half_a_line_is_a_lost_connection(script: Script) -> None:
    with contextlib.closing(script.connection_of()) as connection:
        script.connection.sendall(b'{"ok": tr')
        script.connection.shutdown(socket.SHUT_WR)
        with pytest.raises(Unreachable, match="is gone: the connection was closed") as caught:
            connection.ask(StatusRequest())
    assert caught.value.code is Reason.LOST


@pytest.mark.parametrize(("last", "code"), [((FULL,), "too_many_clients"), ((), "connection_lost")])
def test_what_was_said_last_is_read_though_nothing_can_be_sent_any_more(
    script: Script, last: tuple[object, ...], code: str
) -> None:
    with contextlib.closing(script.connection_of()) as connection:
        script.connection.sendall(lines(*last))
        script.connection.close()
        with pytest.raises(ServoError) as caught:
            connection.ask(ArmRequest())
    assert caught.value.code == code


def test_snapshots_that_were_under_way_are_no_answer(script: Script) -> None:
    with contextlib.closing(script.connection_of()) as connection:
        script.answers(snapshot(), snapshot(), {"ok": True, "n": 2})
        assert connection.ask(StatusRequest()) == {"ok": True, "n": 2}


def test_an_answer_that_nobody_waited_for_is_passed_over(script: Script) -> None:
    with contextlib.closing(script.connection_of(timeout_s=0.01)) as connection:
        with pytest.raises(Unreachable, match="does not answer"):
            connection.ask(StatusRequest())
        script.answers({"ok": True, "n": 1}, {"ok": True, "n": 2})
        assert connection.ask(StatusRequest()) == {"ok": True, "n": 2}


@pytest.mark.parametrize("line", [b"{", b"[1]", b"\xff"])
def test_what_is_no_answer_is_told(script: Script, line: bytes) -> None:
    with contextlib.closing(script.connection_of()) as connection:
        script.connection.sendall(line + b"\n")
        with pytest.raises(Unreachable, match="cannot be understood") as caught:
            connection.ask(StatusRequest())
    assert caught.value.code is Reason.UNREADABLE


def test_what_has_come_is_taken_without_waiting(script: Script) -> None:
    with contextlib.closing(script.connection_of()) as connection:
        assert connection.drain() == []
        script.answers(snapshot(pid=1), snapshot(pid=2))
        assert [one["pid"] for one in connection.drain()] == [1, 2]
        script.connection.close()
        with pytest.raises(Unreachable, match="is gone"):
            connection.drain()


# No service -----------------------------------------------------------------------------------------------------------


def _dead_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))


@pytest.mark.parametrize(
    ("make", "kind", "code", "text"),
    [
        (lambda path: None, Unreachable, "unreachable", "no service answers at .*: is the service running"),
        (lambda path: path.touch(), ConfigError, "usage", "is not a socket"),
        (lambda path: path.mkdir(), ConfigError, "usage", "is not a socket"),
        (_dead_socket, Unreachable, "unreachable", "the service that made this socket has"),
    ],
    ids=["missing", "file", "folder", "dead"],
)
def test_who_finds_no_service_is_told_what_is_there(
    tmp_path: Path, make: Any, kind: type[ServoError], code: str, text: str
) -> None:
    make(tmp_path / "s")
    with pytest.raises(kind, match=text) as caught:
        Connection(tmp_path / "s", 5.0)
    assert caught.value.code == code


def test_a_path_that_is_too_long_is_told(tmp_path: Path) -> None:
    with pytest.raises(Unreachable, match="AF_UNIX path too long"):
        Connection(tmp_path / ("s" * 200), 5.0)


def _forbidden(*_: object) -> None:
    raise PermissionError(13, "Permission denied")


def test_one_who_may_not_use_the_socket_is_told(script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_module, "_connect", _forbidden)
    with pytest.raises(Unreachable, match="you may not use it"):
        Connection(script.path, 5.0)


@pytest.mark.parametrize("refuses", ["_connect", "check_server"])
def test_no_descriptor_is_left_of_a_client_that_could_not_be_made(
    script: Script, monkeypatch: pytest.MonkeyPatch, refuses: str
) -> None:
    made: list[socket.socket] = []
    real = socket.socket

    def make(*arguments: Any) -> socket.socket:
        made.append(real(*arguments))
        return made[-1]

    def refuse(*_: object) -> None:
        raise ConnectionRefusedError(111, "Connection refused")

    monkeypatch.setattr(socket, "socket", make)
    monkeypatch.setattr(connection_module, refuses, refuse)
    with pytest.raises(Unreachable) as caught:
        Connection(script.path, 5.0)
    assert [one.fileno() for one in made] == [-1]
    assert caught.value.code == ("unreachable" if refuses == "_connect" else "untrusted_socket")


def test_a_link_in_a_folder_that_is_open_to_all_is_not_followed(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    (shared / "s").symlink_to(tmp_path / "other")
    with pytest.raises(Unreachable, match="is a symbolic link") as caught:
        Connection(shared / "s", 5.0)
    assert caught.value.code is Reason.UNTRUSTED


def test_a_socket_that_one_may_not_look_at_is_no_file(script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_module, "_connect", _forbidden)
    monkeypatch.setattr(Path, "is_socket", lambda _: False)  # what Python says of one in a folder that it may not enter
    with pytest.raises(Unreachable, match="you may not use it"):
        Connection(script.path, 5.0)


# Waiting --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("timeout_s", "seconds", "micros"), [(5.0, 5, 0), (0.25, 0, 250_000), (2.9999999, 2, 999_999), (1e-9, 0, 1)]
)
def test_the_kernel_is_told_how_long_a_connection_may_take(
    script: Script, timeout_s: float, seconds: int, micros: int
) -> None:
    with contextlib.closing(script.connection_of(timeout_s)) as connection:
        kept = connection._socket.getsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.calcsize("@ll"))
        assert connection._socket.gettimeout() == timeout_s
    granularity_us = 10_000  # of the kernel's timers, which round up
    told = struct.unpack("@ll", kept)
    assert 0 <= (told[0] - seconds) * 1_000_000 + told[1] - micros <= granularity_us


@pytest.mark.parametrize(("every", "longest_s"), [(1, 5.1), (20, 7.0)])
def test_a_watcher_waits_for_as_many_ticks_as_it_asked_to_pass(script: Script, every: int, longest_s: float) -> None:
    with contextlib.closing(script.connection_of()) as connection:
        script.answers(done(), snapshot())
        next(connection.snapshots(WatchRequest(every=every)))
        assert connection._socket.gettimeout() == pytest.approx(longest_s)


def test_a_service_that_does_not_answer_is_told_after_the_time(script: Script) -> None:
    silent = pytest.raises(Unreachable, match=f"at {script.path} does not answer: it hangs")
    with contextlib.closing(script.connection_of(0.01)) as connection, silent as caught:
        connection.ask(StatusRequest())
    assert caught.value.code is Reason.NO_ANSWER


@pytest.mark.parametrize("part", ["sendall", "recv"])
def test_a_connection_that_fails_is_a_lost_one(script: Script, part: str) -> None:
    class Failing:
        def __init__(self, sound: socket.socket) -> None:
            self._sound = sound

        def __getattr__(self, name: str) -> Any:
            if name == part:
                raise OSError(os.EX_IOERR, "it failed")
            return getattr(self._sound, name)

    with contextlib.closing(script.connection_of()) as connection:
        connection._socket = Failing(connection._socket)  # type: ignore[assignment]
        with pytest.raises(Unreachable, match=r"is gone: .*it failed") as caught:
            connection.ask(StatusRequest())
    assert caught.value.code is Reason.LOST
