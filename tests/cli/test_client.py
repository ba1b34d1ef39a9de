"""What a client makes of a service that ends its connection."""

import contextlib
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from twostage_servo.cli.client import Client
from twostage_servo.cli.output import CommandError

FAILURE = {"ok": False, "error": {"code": "too_many_clients", "message": "connect again"}}


def test_who_finds_the_queue_full_waits_for_a_place_in_it(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener, contextlib.ExitStack() as queue:
        listener.bind(str(tmp_path / "s"))
        listener.listen(0)
        first = queue.enter_context(socket.socket(socket.AF_UNIX))
        first.connect(str(tmp_path / "s"))
        with pytest.raises(CommandError, match="others connect to it all of the time") as caught:
            Client(tmp_path / "s", timeout_s=0.05)
        assert (caught.value.code, caught.value.exit_code) == ("unreachable", 4)

        def let_in() -> None:
            for _ in range(2):
                queue.enter_context(listener.accept()[0])

        waiting = threading.Thread(target=lambda: queue.callback(Client(tmp_path / "s", timeout_s=60.0)._socket.close))
        waiting.start()
        let_in()
        waiting.join(60.0)
        assert not waiting.is_alive()


@pytest.fixture
def connected(tmp_path: Path) -> Iterator[tuple[Client, socket.socket]]:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        client = Client(tmp_path / "s")
        service, _ = listener.accept()
        with service:
            yield client, service
        client._lines.close()
        client._socket.close()


def lines(*answers: object) -> bytes:
    return b"".join(json.dumps(answer).encode() + b"\n" for answer in answers)


def test_a_watcher_that_has_to_make_room_is_told_so(connected: tuple[Client, socket.socket]) -> None:
    client, service = connected
    service.sendall(lines({"ok": True}, {"event": "snapshot", "n": 1}, FAILURE))
    service.close()
    watched = client.watch(1)
    assert next(watched) == {"n": 1}
    with pytest.raises(CommandError, match="connect again") as caught:
        next(watched)
    assert caught.value.code == "too_many_clients"


def test_half_a_line_is_a_lost_connection(connected: tuple[Client, socket.socket]) -> None:
    client, service = connected
    service.sendall(b'{"ok": tr')
    service.shutdown(socket.SHUT_WR)
    with pytest.raises(CommandError, match="is gone: the connection was closed") as caught:
        client.request(op="status")
    assert caught.value.code == "connection_lost"


@pytest.mark.parametrize(("last", "code"), [((FAILURE,), "too_many_clients"), ((), "connection_lost")])
def test_what_was_said_last_is_read_though_nothing_can_be_sent_any_more(
    connected: tuple[Client, socket.socket], last: tuple[object, ...], code: str
) -> None:
    client, service = connected
    service.sendall(lines(*last))
    service.close()
    with pytest.raises(CommandError) as caught:
        client.request(op="arm")
    assert caught.value.code == code
    assert client.repeated == 0


@pytest.mark.parametrize("op", ["stop", "disarm"])
def test_a_stop_whose_connection_ends_is_asked_for_again(tmp_path: Path, op: str) -> None:
    asked: list[dict[str, object]] = []

    def serve(listener: socket.socket) -> None:
        for last in (None, FAILURE, {"ok": True}):
            stream, _ = listener.accept()
            with stream, stream.makefile("rb") as requests:
                if last is not None:  # the first one is closed before anything can be said
                    asked.append(json.loads(requests.readline()))
                    stream.sendall(lines(last))

    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        serving = threading.Thread(target=serve, args=(listener,))
        serving.start()
        client = Client(tmp_path / "s", timeout_s=60.0, axis="x")
        assert client.request(op=op) == {"ok": True}
        assert client._socket.gettimeout() == 60.0  # of each answer, also after that
        serving.join(60.0)
        client.close()
    assert asked == [{"op": op, "axis": "x"}] * 2
    assert client.repeated == 2


@pytest.mark.parametrize("op", ["stop", "disarm"])
def test_a_stop_that_is_refused_is_not_asked_for_again(connected: tuple[Client, socket.socket], op: str) -> None:
    client, service = connected
    service.sendall(lines({"ok": False, "error": {"code": "disarmed", "message": "there is nothing to stop"}}))
    with pytest.raises(CommandError, match="nothing to stop") as caught:
        client.request(op=op)
    assert (caught.value.code, client.repeated) == ("disarmed", 0)


def test_a_stop_is_not_asked_for_again_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0

    def closing(listener: socket.socket, connections: int) -> None:
        for _ in range(connections):
            listener.accept()[0].close()

    def sleep(duration_s: float) -> None:
        nonlocal now_s
        now_s += 100.0 * duration_s

    monkeypatch.setattr("twostage_servo.cli.client.time", SimpleNamespace(monotonic=lambda: now_s, sleep=sleep))
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        serving = threading.Thread(target=closing, args=(listener, 3))
        serving.start()
        client = Client(tmp_path / "s", timeout_s=0.5)
        with pytest.raises(CommandError) as caught:
            client.request(op="stop")
        serving.join(60.0)
    assert (caught.value.code, caught.value.exit_code, client.repeated) == ("connection_lost", 4, 2)
