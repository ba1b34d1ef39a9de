"""What the blocking client asks, what it makes of each answer, and how it parts; the service is a script."""

import json
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.client.script import Script, done, lines, refused, snapshot, status
from twostage_servo.app.reloading import LONGEST_S
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.client import blocking
from twostage_servo.client.blocking import ServoClient, connect
from twostage_servo.client.connection import Connection
from twostage_servo.client.errors import Reason, Refused, Unreachable
from twostage_servo.client.verbs import LONGEST_RELOAD_S

FULL = refused("too_many_clients")
ME = {"holder": "me"}
HOLDING = {"state": "holding"}

Verb = Callable[[ServoClient], Any]

OF_AN_AXIS: dict[str, Verb] = {
    "status": lambda client: client.status(),
    "stop": lambda client: client.stop(),
    "arm": lambda client: client.arm(),
    "move": lambda client: client.move(1.0),
    "home": lambda client: client.home(2.0),
    "override": lambda client: client.override(50.0),
    "reset": lambda client: client.reset(),
    "forget": lambda client: client.forget(),
}
OF_ALL: dict[str, Verb] = {
    "release": lambda client: client.release(),
    "acquire": lambda client: client.acquire(),
    "preempt": lambda client: client.acquire(preempt=True),
    "reload": lambda client: client.reload(),
}


@pytest.mark.parametrize("op", OF_AN_AXIS)
def test_an_axis_that_is_named_is_named_in_each_request_that_concerns_one(script: Script, op: str) -> None:
    with script.connect(axis="y") as client:
        script.answers(*[done(axis=HOLDING)] * 3)
        OF_AN_AXIS[op](client)
        first, *rest = script.asked()
    assert (first["op"], first["axis"]) == (op, "y")
    assert all(one == {"op": "status", "axis": "y"} for one in rest)


@pytest.mark.parametrize("op", OF_ALL)
def test_what_concerns_all_axes_names_none(script: Script, op: str) -> None:
    with script.connect(axis="y") as client:
        script.answers(done(), done())
        OF_ALL[op](client)
        assert script.asked() == [{"op": op}]


def test_a_request_says_what_was_asked_for(script: Script) -> None:
    with script.connect() as client:
        script.answers(*[done()] * 6)
        client.move(400, velocity=20)
        client.move_by(-1.5)
        client.move({"x": 1, "y": 2}, velocity=3.0)
        client.home(7)
        client.override(50)
        assert script.asked() == [
            {"op": "move", "position": 400.0, "velocity": 20.0},
            {"op": "move", "by": -1.5},
            {"op": "move", "positions": {"x": 1.0, "y": 2.0}, "velocity": 3.0},
            {"op": "home", "position": 7.0},
            {"op": "override", "percent": 50.0},
        ]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_none_is_not_sent(script: Script, value: float) -> None:
    with script.connect() as client, pytest.raises(Refused, match="position: should be a finite number") as caught:
        client.move(value)
    assert caught.value.code is RefusalCode.BAD_REQUEST
    assert script.asked() == []


@pytest.mark.parametrize("wait", [False, True])
def test_set_points_by_name_from_a_client_of_one_axis_are_not_sent(script: Script, wait: bool) -> None:
    with script.connect(axis="y") as client, pytest.raises(Refused, match="leave axis out") as caught:
        client.move({"x": 12.0}, wait=wait)
    assert caught.value.code is RefusalCode.BAD_REQUEST
    assert script.asked() == []


@pytest.mark.parametrize("op", [*OF_AN_AXIS, "recording", "disarm", "jog"])
def test_a_name_that_no_axis_can_have_is_refused_as_any_other(script: Script, op: str) -> None:
    verbs = OF_AN_AXIS | {
        "recording": lambda client: client.recording(),
        "disarm": lambda client: client.disarm(),
        "jog": lambda client: client.jog(1.0),
    }
    with script.connect(axis=65 * "y") as client, pytest.raises(Refused, match="at most 64 characters"):
        verbs[op](client)
    assert script.asked() == []


@pytest.mark.parametrize("code", [*RefusalCode, "of_a_later_version"])
def test_a_refusal_is_raised_with_its_code(script: Script, code: str) -> None:
    with script.connect() as client:
        script.answers(refused(code))
        with pytest.raises(Refused, match=f"it is {code}") as caught:
            client.status()
    assert caught.value.code == code
    assert isinstance(caught.value.code, RefusalCode) == (code in set(RefusalCode))


def test_an_answer_of_another_version_is_told(script: Script) -> None:
    with script.connect() as client:
        script.answers(done(axis={"state": "flying"}))
        with pytest.raises(Unreachable, match="state: 'flying' is not a valid State") as caught:
            client.status()
    assert caught.value.code is Reason.UNREADABLE


def test_a_watcher_has_a_connection_of_its_own(script: Script) -> None:
    others: list[socket.socket] = []

    def serve() -> None:
        others.append(script.accept())
        others[0].sendall(lines(done(), snapshot(pid=1), snapshot(pid=2)))

    with script.connect(axis="y") as client:
        watched = client.watch(7)
        serving = threading.Thread(target=serve)
        serving.start()
        assert [next(watched).service.pid, next(watched).service.pid] == [1, 2]
        serving.join(60.0)
        assert json.loads(others[0].recv(4096)) == {"op": "watch", "axis": "y", "every": 7}
        watched.close()
        assert others[0].recv(4096) == b"", "its end is that of the connection"
        others[0].close()
        assert script.asked() == []


# Parting --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("op", ["arm", "move", "stop", "acquire"])
def test_who_has_commanded_gives_authority_back(script: Script, op: str) -> None:
    with script.connect() as client:
        script.answers(*[done(axis=HOLDING)] * 4)
        (OF_AN_AXIS | OF_ALL)[op](client)
        client.status()  # which takes nothing of it back
    asked = [request["op"] for request in script.asked()]
    assert (asked[0], asked[-2:]) == (op, ["status", "release"])


@pytest.mark.parametrize("verb", [ServoClient.status, ServoClient.recording])
def test_who_has_only_looked_has_none_to_give_back(script: Script, verb: Verb) -> None:
    with script.connect() as client:
        script.answers(done() | {"fields": [], "records": []})
        verb(client)
    assert len(script.asked()) == 1


def test_who_has_given_it_back_has_none_either(script: Script) -> None:
    with script.connect() as client:
        script.answers(done(), done())
        client.acquire()
        client.release()
    assert [request["op"] for request in script.asked()] == ["acquire", "release"]


@pytest.mark.parametrize(
    ("holder", "asked"), [("me", ["move", "status", "stop", "release"]), ("you", ["move", "status", "release"])]
)
def test_an_error_stops_the_axis_unless_another_has_authority_by_then(
    script: Script, holder: str, asked: list[str]
) -> None:
    def slip() -> None:
        with script.connect() as client:
            script.answers(done(authority=ME), done(authority={"holder": holder}), done(authority=ME), done())
            client.move(1.0)
            client.status()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        slip()
    assert [request["op"] for request in script.asked()] == asked


def test_a_service_that_does_not_answer_the_parting_is_left_after_a_second(
    script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = script.connect(timeout_s=60.0)
    script.answers(done())
    client.acquire()
    waits: list[float | None] = []

    def receive(connection: Connection) -> None:
        waits.append(connection._socket.gettimeout())
        connection._protocol.receive(lines(done()))

    monkeypatch.setattr(Connection, "_receive", receive)
    client.close()
    assert waits == [1.0]
    assert client._connection._socket.fileno() == -1


def test_a_service_that_is_gone_at_the_parting_is_no_error(script: Script) -> None:
    with script.connect() as client:
        script.answers(done())
        client.acquire()
        script.connection.close()
    assert client._connection._socket.fileno() == -1


# Asked for again ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("op", ["stop", "disarm"])
def test_a_stop_whose_connection_ends_is_asked_for_again(tmp_path: Path, op: str) -> None:
    asked: list[dict[str, object]] = []

    def serve(listener: socket.socket) -> None:
        for answers in ((), (FULL,), (done(), done(), done())):
            stream, _ = listener.accept()
            with stream, stream.makefile("rb") as requests:
                for answer in answers:  # the first one is closed before anything can be said
                    asked.append(json.loads(requests.readline()))
                    stream.sendall(lines(answer))

    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        serving = threading.Thread(target=serve, args=(listener,))
        serving.start()
        with connect(tmp_path / "s", "x", timeout_s=60.0) as client:
            getattr(client, op)()
        serving.join(60.0)
    assert [one["op"] for one in asked] == [op, op, "status", "release"]
    assert asked[0]["axis"] == asked[1]["axis"] == "x"


@pytest.mark.parametrize("op", ["stop", "disarm"])
def test_a_stop_that_is_refused_is_not_asked_for_again(script: Script, op: str) -> None:
    with script.connect() as client:
        script.answers(refused("disarmed"), done())
        with pytest.raises(Refused, match="it is disarmed"):
            getattr(client, op)()
        assert len(script.asked()) == 1


def test_a_stop_is_not_asked_for_again_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, pauses = 0.0, 0

    def closing(listener: socket.socket, connections: int) -> None:
        for _ in range(connections):
            listener.accept()[0].close()

    def sleep(duration_s: float) -> None:
        nonlocal now_s, pauses
        now_s, pauses = now_s + 100.0 * duration_s, pauses + 1

    monkeypatch.setattr(blocking, "time", SimpleNamespace(monotonic=lambda: now_s, sleep=sleep))
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        serving = threading.Thread(target=closing, args=(listener, 3))
        serving.start()
        client = connect(tmp_path / "s", timeout_s=0.5)
        with pytest.raises(Unreachable) as caught:
            client.stop()
        serving.join(60.0)
        client._connection.close()
    assert (caught.value.code, pauses) == (Reason.LOST, 3)


# Patience -------------------------------------------------------------------------------------------------------------


def test_five_seconds_are_the_longest_wait_of_who_names_none(script: Script) -> None:
    client = connect(script.path)
    assert client._connection._socket.gettimeout() == 5.0
    client.close()


def test_a_reload_is_waited_for_as_long_as_the_service_lets_it_take(
    script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited: list[float | None] = []

    def receive(connection: Connection) -> None:
        waited.append(connection._socket.gettimeout())
        connection._protocol.receive(lines(done()))

    monkeypatch.setattr(Connection, "_receive", receive)
    with script.connect() as client:
        assert client.reload().to_json() == status()
    assert waited[0] == LONGEST_RELOAD_S > LONGEST_S
