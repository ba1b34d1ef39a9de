"""The control socket: real connections to the real service, in simulated time."""

import asyncio
import contextlib
import errno
import itertools
import json
import math
import os
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import structlog
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.service.operators import connect, serve
from tests.service.rig import World, simulate
from twostage_servo.api.address import find_socket, own_socket, prepare_folder
from twostage_servo.api.requests import Request
from twostage_servo.axis.state import State
from twostage_servo.service import answers
from twostage_servo.service.answers import encode
from twostage_servo.service.background_server import Priority
from twostage_servo.service.control_socket import ControlSocket, SocketInUseError
from twostage_servo.service.listening_socket import ListeningSocket
from twostage_servo.service.reply import Asker, Reply
from twostage_servo.telemetry.recorder import Recorder
from twostage_servo.telemetry.sample import FIELDS


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "runtime" / "control.sock"


def test_a_session_of_an_operator(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        assert (await operator.ask(op="status"))["axis"]["state"] == "disarmed"
        refused = await operator.ask(op="move", position=10.0)
        assert refused == {
            "ok": False,
            "error": {"code": "disarmed", "message": "the axis is disarmed: `arm` it first."},
        }
        assert (await operator.ask(op="arm"))["ok"]
        await world.seconds(0.1)
        moving = await operator.ask(op="move", position=100.0, velocity=50.0)
        assert moving["move"] == {
            "number": 1, "start": 0.0, "target": 100.0, "velocity": 50.0, "outcome": "moving", "kind": "move",
            "reason": None,
        }  # fmt: skip
        await world.seconds(1.0)
        stopping = await operator.ask(op="stop")
        assert stopping["axis"]["state"] == "stopping"
        await world.seconds(2.0)
        status = await operator.ask(op="status")
        assert status["axis"]["state"] == "holding"
        assert status["move"]["outcome"] == "stopped"
        assert (await operator.ask(op="move", by=-5))["move"]["velocity"] == 100.0
        assert (await operator.ask(op="disarm"))["axis"]["state"] in {"disarming", "disarmed"}

    serve(path, script)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"", "EOF"),
        (b"{", "EOF"),
        (b"[]", "an object"),
        (b"null", "an object"),
        (b'{"op": "fly"}', "fly"),
        (b'{"position": 1}', "op"),
        (b'{"op": "move"}', "either position or by"),
        (b'{"op": "move", "position": 1, "by": 1}', "either position or by"),
        (b'{"op": "move", "position": NaN}', "finite"),
        (b'{"op": "move", "position": Infinity}', "finite"),
        (b'{"op": "move", "position": 1e400}', "finite"),
        (b'{"op": "move", "position": "10"}', "valid number"),
        (b'{"op": "move", "position": true}', "valid number"),
        (b'{"op": "move", "position": 1, "velocity": 0}', "greater than 0"),
        (b'{"op": "move", "position": 1, "speed": 3}', "speed"),
        (b'{"op": "arm", "force": true}', "force"),
        (b'{"op": "watch", "every": 0}', "greater than or equal to 1"),
        (b"\xff\xfe\x00", "invalid"),
        (b"[" * 4_000, "recursion"),
    ],
)
def test_a_bad_request_is_answered_and_the_connection_goes_on(path: Path, line: bytes, said: str) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        answer = await operator.send(line)
        assert answer["ok"] is False
        assert answer["error"]["code"] == "bad_request"
        assert said.lower() in answer["error"]["message"].lower()
        assert (await operator.ask(op="status"))["ok"]
        assert world.service.statistics.missed == 0

    serve(path, script)


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(lines=st.lists(st.binary(max_size=200).filter(lambda line: b"\n" not in line), min_size=1, max_size=20))
def test_any_bytes_at_all_are_answered(tmp_path: Path, lines: list[bytes]) -> None:
    async def script(_: World, __: ControlSocket) -> None:
        operator = await connect(tmp_path / "any.sock")
        for line in lines:
            assert (await operator.send(line))["ok"] is False

    serve(tmp_path / "any.sock", script)


def test_a_line_without_an_end_is_refused_and_closed(path: Path) -> None:
    async def script(_: World, __: ControlSocket) -> None:
        operator = await connect(path)
        operator.writer.write(b"x" * 200_000 + b"\n")
        assert "4096 bytes" in (await operator.answer())["error"]["message"]
        assert await operator.reader.read() == b""

    serve(path, script)


def test_a_watcher_gets_snapshots_at_its_pace(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        watcher = await connect(path)
        await watcher.ask(op="watch", every=20)
        counts = [(await watcher.answer())["ticks"]["count"] for _ in range(5)]
        assert [after - before for before, after in itertools.pairwise(counts)] == [20] * 4
        assert world.service.statistics.missed == 0

    serve(path, script)


def test_a_watcher_that_never_reads_is_bounded_and_delays_nothing(path: Path) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        watcher = await connect(path)
        await watcher.ask(op="watch", every=1)
        watcher.writer.transport.pause_reading()  # type: ignore[attr-defined]
        await world.seconds(30.0)
        (client,) = control._sessions._connections
        assert client.unsent > 1000
        assert len(client._outgoing) == 1
        assert world.service.statistics.missed == 0
        assert (await (await connect(path)).ask(op="status"))["ok"]

    serve(path, script)


def test_of_many_that_connect_at_once_some_are_let_in_between_two_looks_at_the_clock(path: Path) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        callers = [socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) for _ in range(30)]
        assert control._admission is not None
        newcomers = control._admission.newcomers
        assert newcomers is not None
        try:
            for caller in callers:
                caller.setblocking(False)
                caller.connect(str(path))  # would raise if the kernel did not keep them all waiting
            let_in = [0]
            for _ in range(60):
                await asyncio.sleep(0)
                let_in.append(len(newcomers))
            assert max(after - before for before, after in itertools.pairwise(let_in)) == 16
            assert let_in[-1] == 30
        finally:
            for caller in callers:
                caller.close()
        await world.seconds(0.01)
        assert not control._sessions._connections

    serve(path, script)


def test_clients_are_let_in_when_it_is_their_turn(path: Path) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        async with world.loop.parts.background.slot(Priority.REQUEST):  # somebody else has it
            newcomer = await connect(path)
            asking = asyncio.create_task(newcomer.ask(op="status"))
            await world.seconds(0.005)
            assert not control._sessions._connections
        assert (await asking)["ok"]

    serve(path, script)


def test_who_cannot_be_let_in_is_told_to_the_log_and_let_in_later(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World, __: ControlSocket) -> None:
        accept, full = (
            ListeningSocket.accept,
            [RuntimeError("a defect"), *[OSError(errno.EMFILE, "Too many open files")] * 2],
        )

        def sometimes(door: ListeningSocket) -> object:
            if full:
                raise full.pop()
            return accept(door)

        monkeypatch.setattr(ListeningSocket, "accept", sometimes)
        asking = asyncio.create_task((await connect(path)).ask(op="status"))
        await world.seconds(2.9)
        assert not asking.done()
        assert (await asking)["ok"]

    with structlog.testing.capture_logs() as logs:
        serve(path, script)
    told = [entry["error"] for entry in logs if entry["event"] == "connections cannot be accepted"]
    assert told == ["OSError(24, 'Too many open files')"] * 2 + ["RuntimeError('a defect')"]


def test_the_end_waits_for_nobody_who_waits_to_be_let_in(path: Path) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        stack = contextlib.AsyncExitStack()
        await stack.enter_async_context(world.loop.parts.background.slot(Priority.REQUEST))
        newcomers = [await connect(path) for _ in range(3)]
        await world.seconds(0.005)
        await control.stop()
        for newcomer in newcomers:
            with contextlib.suppress(ConnectionError):
                assert await newcomer.reader.read() == b""
        await stack.aclose()

    serve(path, script)
    assert not path.exists()


def test_idle_clients_make_room_for_whoever_wants_to_stop(path: Path) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        operator, watcher, *idle = [await connect(path) for _ in range(64)]
        assert (await watcher.ask(op="watch", every=1))["ok"]
        assert (await operator.ask(op="arm"))["ok"]
        await world.until(lambda: world.state() is State.HOLDING)
        assert (await operator.ask(op="move", position=100.0))["ok"]
        for client in reversed(idle):
            assert (await client.ask(op="status"))["ok"]
        await world.seconds(0.1)
        gone = idle[:-4:-1]  # those that asked before all others did
        newcomers = [await connect(path) for _ in gone]
        for client in newcomers:
            assert (await client.ask(op="stop"))["axis"]["state"] == "stopping"
        for client in gone:
            assert (await client.answer())["error"]["code"] == "too_many_clients"
            assert await client.reader.read() == b""
        await world.seconds(0.1)
        assert len(control._sessions._connections) == 64
        assert world.requests.authority.holder is not None  # the operator has not gone
        assert (await idle[0].ask(op="status"))["ok"]
        watches = control._sessions._watchers._watches
        assert any(client in watches for client in control._sessions._connections)  # nor has the watcher, who reads

    serve(path, script)


@pytest.mark.parametrize(("op", "state"), [("move", State.HOLDING), ("stop", State.STOPPING)])
def test_a_client_that_was_told_to_go_moves_nothing_but_may_stop(path: Path, op: str, state: State) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        client = await connect(path)
        assert (await client.ask(op="arm"))["ok"]
        await world.until(lambda: world.state() is State.HOLDING)
        if op == "stop":
            assert (await client.ask(op="move", position=100.0))["ok"]
        assert (await client.ask(op="release"))["ok"]  # whoever commands need not make room
        turn = world.loop.parts.background.slot

        @contextlib.asynccontextmanager
        async def late_turn(rank: Priority) -> AsyncIterator[None]:
            async with turn(rank):
                if rank is not Priority.READING:
                    control._sessions.make_room()  # while it waited for its turn
                yield

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(world.loop.parts.background, "slot", late_turn)
            client.writer.write(encode({"op": op} | ({"position": 50.0} if op == "move" else {})))
            await world.seconds(0.03)
        assert world.state() is state
        assert world.requests.authority.holder is None

    serve(path, script)


def test_a_watcher_that_never_reads_makes_room_as_well(path: Path) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        watcher = await connect(path)
        assert (await watcher.ask(op="watch", every=1))["ok"]
        (client,) = control._sessions._connections
        await world.until(lambda: client.unsent > 0)
        for _ in range(64):
            assert (await (await connect(path)).ask(op="status"))["ok"]
        await world.seconds(0.1)
        assert client not in control._sessions._connections
        assert len(control._sessions._serving) == 64  # nothing waits for it to read

    serve(path, script)


def test_the_recording_can_be_fetched(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        await world.seconds(3.0)
        answer = await (await connect(path)).ask(op="recording")
        assert answer["fields"][0] == "tick"
        assert len(answer["records"]) == 200
        assert len(answer["records"][0]) == len(answer["fields"])

    serve(path, script)


def test_only_owner_and_group_may_open_the_socket(path: Path) -> None:
    modes: list[int] = []

    async def script(_: World, __: ControlSocket) -> None:
        modes.extend(stat.S_IMODE(os.stat(entry).st_mode) for entry in (path, path.parent))  # noqa: PTH116

    serve(path, script)
    assert modes == [0o660, 0o700]
    assert not path.exists()


def test_a_second_service_is_refused_and_a_dead_socket_is_taken_over(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        with pytest.raises(SocketInUseError, match="another service answers"):
            await world.loop.control_socket(path).start()

    serve(path, script)
    path.parent.mkdir(exist_ok=True)
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    serve(path, lambda *_: asyncio.sleep(0))


def test_a_file_that_is_no_socket_is_not_removed(path: Path) -> None:
    path.parent.mkdir()
    path.write_text("precious")

    async def script(world: World) -> None:
        with pytest.raises(OSError, match="is not a socket"):
            await world.loop.control_socket(path).start()

    simulate(script)
    assert path.read_text() == "precious"


def test_where_the_socket_lies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("TWOSTAGE_SERVO_SOCKET", "RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"):
        monkeypatch.delenv(name, raising=False)
    assert own_socket() == Path(f"/tmp/twostage-servo-{os.getuid()}/control.sock")  # noqa: S108
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert own_socket() == tmp_path / "twostage-servo" / "control.sock"
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/twostage-servo:/run/other")
    assert own_socket() == Path("/run/twostage-servo/control.sock")
    monkeypatch.setenv("TWOSTAGE_SERVO_SOCKET", str(tmp_path / "mine.sock"))
    assert find_socket() == tmp_path / "mine.sock"


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become somebody who may not enter a folder")
def test_who_may_not_enter_the_folder_of_the_socket_is_told_so() -> None:
    """The service manager's runtime folder is for the operators' group alone."""
    ask = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from twostage_servo import connect\n"  # all that it takes, before nothing can be read any more
        "from twostage_servo.api import address\n"
        "address.SYSTEM_SOCKET = Path(sys.argv[1])\n"
        "os.setresuid(65534, 65534, 65534)\n"
        "connect()\n"
    )
    environment = {name: value for name, value in os.environ.items() if "RUNTIME" not in name and "SOCKET" not in name}
    environment["XDG_RUNTIME_DIR"] = "/nowhere"
    with tempfile.TemporaryDirectory() as closed:  # for its owner alone, in a folder that everybody may enter
        done = subprocess.run(  # noqa: S603 - our own program
            [sys.executable, "-c", ask, f"{closed}/control.sock"],
            capture_output=True, text=True, check=False, env=environment,
        )  # fmt: skip
    assert "you may not use it; its owner and group may" in done.stderr, done.stderr


def test_a_folder_of_somebody_else_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 123_456)
    status = tmp_path.stat()
    if status.st_uid == 0:
        os.chown(tmp_path, 65_534, -1)
    with pytest.raises(PermissionError, match="user 65534's"):
        prepare_folder(tmp_path / "control.sock")


def test_a_flood_of_requests_does_not_hold_up_the_tick(path: Path) -> None:
    """Each request is one pass of the loop: a tick that is due comes between two of them, not after all."""

    async def script(world: World, control: ControlSocket) -> None:
        served = 0
        handle = control._sessions._requests.answer

        def count(request: Request, asker: Asker) -> Reply:
            nonlocal served
            served += 1
            return handle(request, asker)

        control._sessions._requests.answer = count  # type: ignore[method-assign]
        operator = await connect(path)
        operator.writer.write(b'{"op": "status"}\n' * 1000)
        seen = []
        for _ in range(1000):
            await operator.answer()
            seen.append(served)
        # Without a pass of the loop between them, all that fits in the buffers would be served at one go.
        assert max(after - before for before, after in itertools.pairwise(seen)) <= 5
        assert world.service.statistics.missed == 0

    serve(path, script)


def test_a_long_recording_is_sent_in_pieces() -> None:
    records = [(n, math.nan if n == 7 else 0.5) for n in range(1234)]
    pieces = list(answers.recording(["tick", "effort"], records))
    assert len(pieces) > 20
    assert max(map(len, pieces)) < 2000
    whole = json.loads(b"".join(pieces))
    assert whole["ok"] is True
    assert whole["records"] == [[n, None if n == 7 else 0.5] for n in range(1234)]
    assert whole["fields"] == ["tick", "effort"]
    assert b"".join(pieces).count(b"\n") == 1


def test_the_recording_of_no_tick_yet_is_an_empty_one() -> None:
    line = b"".join(answers.recording(FIELDS[:1], Recorder(5, 0.01).records()))
    assert line == b'{"ok":true,"fields":["tick"],"records":[]}\n'
