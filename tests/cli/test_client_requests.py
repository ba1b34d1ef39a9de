"""What the client sends, what it makes of each answer, and how it parts; the service is a script at a real socket."""

import json
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from twostage_servo.app.reloading import LONGEST_S
from twostage_servo.cli import operate
from twostage_servo.cli.client import BAD_USAGE, Client
from twostage_servo.cli.main import main
from twostage_servo.cli.output import CommandError, ExitCode

SNAPSHOT = {"event": "snapshot", "n": 1}


class Script:
    """A service whose answers are written before they are asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        self._connection: socket.socket | None = None

    def connect(self, **arguments: Any) -> Client:
        client = Client(self.path, **arguments)
        self._connection, _ = self._listener.accept()
        return client

    @property
    def connection(self) -> socket.socket:
        assert self._connection is not None
        return self._connection

    def answers(self, *answers: object) -> None:
        self.connection.sendall(b"".join(json.dumps(answer).encode() + b"\n" for answer in answers))

    def asked(self) -> list[Any]:
        """Return what has been asked so far."""
        self.connection.setblocking(False)
        received = b""
        try:
            while piece := self.connection.recv(65536):
                received += piece
        except BlockingIOError:
            pass
        finally:
            self.connection.setblocking(True)
        assert received.endswith(b"\n") or not received
        return [json.loads(line) for line in received.splitlines()]

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._listener.close()


@pytest.fixture
def script(tmp_path: Path) -> Iterator[Script]:
    made = Script(tmp_path / "s")
    yield made
    made.close()


def refused(code: str) -> dict[str, Any]:
    return {"ok": False, "error": {"code": code, "message": f"it is {code}"}}


# Requests and answers -------------------------------------------------------------------------------------------------


def test_a_request_is_a_line_and_its_answer_is_returned(script: Script) -> None:
    client = script.connect()
    script.answers({"ok": True, "n": 7}, {"ok": True, "release": 1})
    with client:
        assert client.request(op="move", position=1.5) == {"ok": True, "n": 7}
        assert script.asked() == [{"op": "move", "position": 1.5}]


@pytest.mark.parametrize("op", ["status", "recording", "stop", "arm", "move", "home", "reset"])
def test_an_axis_that_is_named_is_named_in_each_request_that_concerns_one(script: Script, op: str) -> None:
    client = script.connect(axis="y")
    script.answers({"ok": True}, {"ok": True})
    with client:
        client.request(op=op)
        assert script.asked() == [{"op": op, "axis": "y"}]


@pytest.mark.parametrize("op", ["release", "acquire", "preempt", "reload"])
def test_what_concerns_all_axes_names_none(script: Script, op: str) -> None:
    client = script.connect(axis="y")
    script.answers({"ok": True}, {"ok": True})
    with client:
        client.request(op=op)
        assert script.asked() == [{"op": op}]


def test_snapshots_that_were_under_way_are_no_answer(script: Script) -> None:
    client = script.connect()
    script.answers(SNAPSHOT, SNAPSHOT, {"ok": True, "n": 2})
    with client:
        assert client.request(op="status") == {"ok": True, "n": 2}


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_none_is_not_sent(script: Script, value: float) -> None:
    client = script.connect()
    script.answers({"ok": True})
    with client, pytest.raises(CommandError, match="a number must be finite") as caught:
        client.request(op="move", position=value)
    assert (caught.value.code, caught.value.exit_code) == ("bad_request", ExitCode.USAGE)
    assert script.asked() == [{"op": "release"}]


@pytest.mark.parametrize("code", sorted(BAD_USAGE))
def test_a_request_that_alone_is_to_blame_is_bad_usage(script: Script, code: str) -> None:
    client = script.connect()
    script.answers(refused(code))
    with client, pytest.raises(CommandError, match=f"it is {code}") as caught:
        client.request(op="status")
    assert (caught.value.code, caught.value.exit_code) == (code, ExitCode.USAGE)


@pytest.mark.parametrize("code", ["tripped", "lease_held", "disarmed", "expired"])
def test_any_other_refusal_is_a_failure(script: Script, code: str) -> None:
    client = script.connect()
    script.answers(refused(code))
    with client, pytest.raises(CommandError, match=f"it is {code}") as caught:
        client.request(op="status")
    assert (caught.value.code, caught.value.exit_code) == (code, ExitCode.FAILED)


@pytest.mark.parametrize(("op", "exit_code"), [("arm", 3), ("jog", 3), ("move", 2), ("home", 2)])
def test_an_axis_that_stands_outside_its_limits_is_no_bad_usage(script: Script, op: str, exit_code: int) -> None:
    client = script.connect()
    script.answers(refused("position_limit"), {"ok": True})
    with client, pytest.raises(CommandError) as caught:
        client.request(op=op)
    assert caught.value.exit_code == exit_code


def test_bad_usage_is_what_the_docs_say() -> None:
    assert {"bad_request", "position_limit", "velocity_limit", "which_axis"} == BAD_USAGE


# Watching -------------------------------------------------------------------------------------------------------------


def test_a_watcher_says_how_often_and_yields_what_comes_without_its_event(script: Script) -> None:
    client = script.connect(axis="y")
    script.answers({"ok": True}, SNAPSHOT, {"event": "snapshot", "n": 2})
    with client:
        watched = client.watch(7)
        assert [next(watched), next(watched)] == [{"n": 1}, {"n": 2}]
        assert script.asked() == [{"op": "watch", "every": 7, "axis": "y"}]


@pytest.mark.parametrize(("every", "longest_s"), [(1, 5.1), (20, 7.0)])
def test_a_watcher_waits_for_as_many_ticks_as_it_asked_to_pass(script: Script, every: int, longest_s: float) -> None:
    client = script.connect(timeout_s=5.0)
    script.answers({"ok": True}, SNAPSHOT)
    with client:
        next(client.watch(every))
        assert client._socket.gettimeout() == pytest.approx(longest_s)


# Parting --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("op", ["arm", "move", "stop", "acquire", "jog"])
def test_who_has_commanded_gives_the_lease_back(script: Script, op: str) -> None:
    client = script.connect()
    script.answers({"ok": True}, {"ok": True}, {"ok": True})
    with client:
        client.request(op=op)
        client.request(op="status")  # which takes nothing of it back
    assert [request["op"] for request in script.asked()] == [op, "status", "release"]


@pytest.mark.parametrize("op", ["status", "recording", "watch"])
def test_who_has_only_looked_has_none_to_give_back(script: Script, op: str) -> None:
    client = script.connect()
    script.answers({"ok": True})
    with client:
        client.request(op=op)
    assert [request["op"] for request in script.asked()] == [op]


def test_a_service_that_does_not_answer_the_parting_is_left_after_a_second(script: Script) -> None:
    client = script.connect(timeout_s=60.0)
    script.answers({"ok": True})
    client.request(op="arm")
    client.__enter__()
    waits: list[float | None] = []

    def read() -> dict[str, Any]:
        waits.append(client._socket.gettimeout())
        return {"ok": True}

    client._read = read  # type: ignore[method-assign]
    client.__exit__(None, None, None)
    assert waits == [1.0]
    assert client._socket.fileno() == -1
    assert client._lines.closed


def test_a_service_that_is_gone_at_the_parting_is_no_error(script: Script) -> None:
    client = script.connect()
    script.answers({"ok": True})
    with client:
        client.request(op="arm")
        script.connection.close()
    assert client._socket.fileno() == -1


def _dead_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))


# No service -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "exit_code", "code", "text"),
    [
        (lambda path: None, ExitCode.UNREACHABLE, "unreachable", "no service answers at .*: is the service running"),
        (lambda path: path.touch(), ExitCode.USAGE, "usage", "is not a socket"),
        (lambda path: path.mkdir(), ExitCode.USAGE, "usage", "is not a socket"),
        (_dead_socket, ExitCode.UNREACHABLE, "unreachable", "the service that made this socket has"),
    ],
    ids=["missing", "file", "folder", "dead"],
)
def test_who_finds_no_service_is_told_what_is_there(
    tmp_path: Path, make: Any, exit_code: ExitCode, code: str, text: str
) -> None:
    make(tmp_path / "s")
    with pytest.raises(CommandError, match=text) as caught:
        Client(tmp_path / "s")
    assert (caught.value.exit_code, caught.value.code) == (exit_code, code)


def test_a_path_that_is_too_long_is_told(tmp_path: Path) -> None:
    with pytest.raises(CommandError, match="AF_UNIX path too long") as caught:
        Client(tmp_path / ("s" * 200))
    assert caught.value.code == "unreachable"


def test_one_who_may_not_use_the_socket_is_told(script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("twostage_servo.cli.client._connect", forbidden)
    with pytest.raises(CommandError, match="you may not use it") as caught:
        Client(script.path)
    assert caught.value.exit_code is ExitCode.UNREACHABLE


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

    monkeypatch.setattr("twostage_servo.cli.client.socket.socket", make)
    monkeypatch.setattr(f"twostage_servo.cli.client.{refuses}", refuse)
    with pytest.raises(CommandError) as caught:
        Client(script.path)
    assert [one.fileno() for one in made] == [-1]
    assert caught.value.code == ("unreachable" if refuses == "_connect" else "untrusted_socket")


def test_a_link_in_a_folder_that_is_open_to_all_is_not_followed(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    (shared / "s").symlink_to(tmp_path / "other")
    with pytest.raises(CommandError, match="is a symbolic link") as caught:
        Client(shared / "s")
    assert (caught.value.code, caught.value.exit_code) == ("untrusted_socket", ExitCode.UNREACHABLE)


def test_a_socket_that_one_may_not_look_at_is_no_file(script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("twostage_servo.cli.client._connect", forbidden)
    monkeypatch.setattr(Path, "is_socket", lambda _: False)  # what Python says of one in a folder that it may not enter
    with pytest.raises(CommandError, match="you may not use it"):
        Client(script.path)


# Waiting --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("timeout_s", "seconds", "micros"), [(5.0, 5, 0), (0.25, 0, 250_000), (2.9999999, 2, 999_999), (1e-9, 0, 1)]
)
def test_the_kernel_is_told_how_long_a_connection_may_take(
    script: Script, timeout_s: float, seconds: int, micros: int
) -> None:
    client = script.connect(timeout_s=timeout_s)
    kept = client._socket.getsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.calcsize("@ll"))
    granularity_us = 10_000  # of the kernel's timers, which round up
    told = struct.unpack("@ll", kept)
    assert 0 <= (told[0] - seconds) * 1_000_000 + told[1] - micros <= granularity_us
    assert client._socket.gettimeout() == timeout_s
    client.__exit__(None, None, None)


def test_five_seconds_are_the_longest_wait_of_who_names_none(script: Script) -> None:
    client = script.connect()
    assert client._socket.gettimeout() == 5.0
    client.__exit__(None, None, None)


def test_a_service_that_does_not_answer_is_told_after_the_time(script: Script) -> None:
    client = script.connect(timeout_s=0.01)
    with client, pytest.raises(CommandError, match=f"at {script.path} does not answer: it hangs") as caught:
        client.request(op="status")
    assert (caught.value.code, caught.value.exit_code) == ("no_answer", ExitCode.UNREACHABLE)


@pytest.mark.parametrize("part", ["_lines", "_socket"])
def test_a_connection_that_fails_is_a_lost_one(script: Script, part: str) -> None:
    class Failing:
        def sendall(self, _: bytes) -> None:
            raise OSError(os.EX_IOERR, "it failed")

        def readline(self) -> bytes:
            raise OSError(os.EX_IOERR, "it failed")

    client = script.connect()
    sound = getattr(client, part)
    setattr(client, part, Failing())
    with pytest.raises(CommandError, match=r"is gone: .*it failed") as caught:
        client.request(op="status")
    assert (caught.value.code, caught.value.exit_code) == ("connection_lost", ExitCode.UNREACHABLE)
    setattr(client, part, sound)
    client.__exit__(None, None, None)


def test_a_reload_is_waited_for_as_long_as_the_service_lets_it_take(
    script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, waited = script.connect(), []
    monkeypatch.setattr(operate, "_connect", lambda _: client)

    def answer() -> dict[str, Any]:
        waited.append(client._socket.gettimeout())
        drive = {"enabled": False, "lasting": []}
        return {"ok": True, "axis": {"name": "x", "state": "disarmed"}, "drive": drive, "trip": None}

    monkeypatch.setattr(client, "_read", answer)
    assert main(["reload", "--json"]) == ExitCode.DONE
    assert waited[0] == operate.LONGEST_RELOAD_S
    assert operate.LONGEST_RELOAD_S > LONGEST_S
