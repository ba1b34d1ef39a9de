"""The path of the control socket: one service has it, removes only its own, and makes a lost one again."""

import asyncio
import concurrent.futures
import os
import shutil
import socket
import threading
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any

import pytest
import structlog

from tests.service.operators import connect, serve
from tests.service.rig import World, simulate
from twostage_servo.service.control_socket import ControlSocket, SocketInUseError
from twostage_servo.service.socket_file import SocketFile


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "runtime" / "control.sock"


def remove(path: Path, what: str = "socket") -> None:
    if what == "socket":
        path.unlink()
    else:
        shutil.rmtree(path.parent)


def inode(path: Path) -> int | None:
    return path.lstat().st_ino if path.is_socket() else None


def test_nothing_is_left_in_the_end(path: Path) -> None:
    serve(path, lambda *_: asyncio.sleep(0))
    assert list(path.parent.iterdir()) == []


def test_of_services_that_start_at_the_same_time_exactly_one_gets_the_path(path: Path) -> None:
    services = 8
    for _ in range(25):
        together = threading.Barrier(services)

        def bind(together: threading.Barrier) -> tuple[SocketFile, socket.socket] | None:
            file = SocketFile(path, 1)
            together.wait(60)
            try:
                return file, file.bind()
            except SocketInUseError:
                return None

        with concurrent.futures.ThreadPoolExecutor(services) as pool:
            got = [one for one in pool.map(bind, [together] * services) if one]
        assert len(got) == 1
        ((file, listener),) = got
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(path))
        file.remove()
        listener.close()
    assert list(path.parent.iterdir()) == []


def test_the_path_of_a_service_that_was_killed_can_be_taken(path: Path) -> None:
    path.parent.mkdir()
    path.with_name("control.sock.lock").touch()  # its lock has ended with it
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    serve(path, lambda *_: asyncio.sleep(0))


def test_a_socket_of_a_service_that_takes_no_lock_is_left_alone_and_never_waited_for(path: Path) -> None:
    path.parent.mkdir()
    with socket.socket(socket.AF_UNIX) as earlier, socket.socket(socket.AF_UNIX) as waiting:
        earlier.bind(str(path))
        earlier.listen(0)
        waiting.connect(str(path))  # the queue is full
        with pytest.raises(SocketInUseError, match="another service answers"):
            SocketFile(path, 1).bind()
        assert path.exists()
    assert not path.with_name("control.sock.lock").exists()


def test_a_service_that_ends_does_not_remove_the_socket_of_another(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as another:

        async def script(_: World, __: ControlSocket) -> None:
            shutil.rmtree(path.parent)
            path.parent.mkdir()
            another.bind(str(path))

        serve(path, script)
        assert path.is_socket()


def test_the_socket_of_another_is_told_from_the_own_one_that_was_removed(path: Path) -> None:
    """The number of a removed file is given to the next one, unless something still holds it."""
    file = SocketFile(path, 1)
    with file.bind():
        path.unlink()
        with socket.socket(socket.AF_UNIX) as another:
            another.bind(str(path))
            file.remove()
            assert path.is_socket()


@pytest.mark.parametrize("what", ["socket", "folder"])
def test_a_socket_that_was_removed_is_made_again_and_clients_stay(path: Path, what: str) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        remove(path, what)
        await world.seconds(2.5)
        fresh = await connect(path)
        assert (await fresh.done(op="status"))["axis"]["state"] == "holding"
        assert (await operator.done(op="move", by=1.0))["ok"]  # who still holds authority
        assert os.stat(path).st_mode & 0o777 == 0o660  # noqa: PTH116
        assert world.service.statistics.missed == 0
        with pytest.raises(SocketInUseError):
            SocketFile(path, 1).bind()

    serve(path, script)
    assert list(path.parent.iterdir()) == []


def test_it_is_made_again_as_often_as_it_is_removed_and_leaks_no_descriptor(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        counts = []
        for _again in range(5):
            remove(path)
            await world.seconds(4.5)
            assert inode(path)
            counts.append(len(os.listdir("/proc/self/fd")))  # noqa: PTH208
        assert len(set(counts)) == 1

    serve(path, script)


def test_those_who_wait_at_the_removed_socket_are_let_in(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        with socket.socket(socket.AF_UNIX) as waiting:
            waiting.connect(str(path))
            remove(path)
            await world.seconds(3.5)
            waiting.setblocking(False)
            waiting.send(b'{"op": "status"}\n')
            await world.seconds(0.1)
            assert b'"ok":true' in waiting.recv(1 << 16)

    serve(path, script)


def test_a_lock_that_was_removed_is_taken_again(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        path.with_name("control.sock.lock").unlink()
        await world.seconds(2.5)
        with pytest.raises(SocketInUseError):
            SocketFile(path, 1).bind()

    serve(path, script)


def test_a_path_that_another_service_has_taken_meanwhile_is_left_to_it_until_that_ends(path: Path) -> None:
    async def script(world: World, control: ControlSocket) -> None:
        operator = await connect(path)
        shutil.rmtree(path.parent)
        other = SocketFile(path, 1)
        with other.bind():
            taken = inode(path)
            await world.seconds(5.0)
            assert inode(path) == taken
            assert (await operator.done(op="stop" if world.axis.can_stop else "status"))["ok"]
            assert control._file._trouble.startswith("another service answers")
            other.remove()
        await world.seconds(2.5)
        await (await connect(path)).done(op="status")

    serve(path, script)


def test_a_path_that_cannot_be_made_again_is_told_once_and_tried_again(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        shutil.rmtree(path.parent)
        path.parent.write_text("no folder", encoding="utf-8")
        await world.seconds(5.0)
        assert len(told()) == 1
        path.parent.unlink()
        await world.seconds(2.0)
        await (await connect(path)).done(op="status")
        shutil.rmtree(path.parent)
        path.parent.write_text("no folder", encoding="utf-8")
        await world.seconds(5.0)
        assert len(told()) == 3  # a trouble that has come back is told again
        path.parent.unlink()
        await world.seconds(2.0)

    def told() -> list[MutableMapping[str, Any]]:
        return [line for line in logs if str(line["event"]).startswith("the control socket")]

    with structlog.testing.capture_logs() as logs:
        serve(path, script)
    cannot, made, *again = told()
    assert again == [cannot, made]
    assert "File exists" in cannot.pop("error")
    assert cannot == {
        "event": "the control socket was removed and cannot be created again: no new client can connect",
        "log_level": "error", "room": "control_socket", "socket": str(path),
    }  # fmt: skip
    assert made == {
        "event": "the control socket was removed, and has been created again", "log_level": "warning",
        "room": "control_socket", "socket": str(path),
    }  # fmt: skip


def test_the_lock_is_given_up_where_the_socket_cannot_be_made(path: Path) -> None:
    path.parent.mkdir()
    path.touch()
    file = SocketFile(path, 1)
    with pytest.raises(SocketInUseError, match="is not a socket; remove it"):
        file.bind()
    path.unlink()
    other = SocketFile(path, 1)
    other.bind().close()
    other.remove()
    assert list(path.parent.iterdir()) == []


def test_nobody_can_open_the_lock_but_its_owner_and_nobody_is_led_elsewhere_by_it(path: Path) -> None:
    lock = path.with_name("control.sock.lock")
    file = SocketFile(path, 1)
    file.bind().close()
    assert lock.stat().st_mode & 0o777 == 0o600
    file.remove()
    lock.symlink_to(path.parent / "elsewhere")
    with pytest.raises(OSError, match="Too many levels of symbolic links"):
        SocketFile(path, 1).bind()
    assert not (path.parent / "elsewhere").exists()


def test_the_mask_for_new_files_is_what_it_was(path: Path) -> None:
    before = os.umask(0o027)
    try:
        file = SocketFile(path, 1)
        file.bind().close()
        file.remove()
        assert os.umask(0o027) == 0o027
    finally:
        os.umask(before)


def test_one_that_was_never_started_removes_nothing(path: Path) -> None:
    async def script(world: World) -> None:
        await world.loop.control_socket(path).stop()

    path.parent.mkdir()
    path.touch()
    simulate(script)
    assert path.exists()
