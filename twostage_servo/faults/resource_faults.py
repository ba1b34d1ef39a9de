"""Injections in what the host gives to the process: signals, descriptors, threads, memory, and the socket's path."""

import asyncio
import contextlib
import os
import resource
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any

from twostage_servo.api.requests import StatusRequest
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripFile
from twostage_servo.client.errors import ServoError
from twostage_servo.faults.bus_faults import foreign_command
from twostage_servo.faults.client_faults import serves_others
from twostage_servo.faults.world import World
from twostage_servo.service.ending_signals import EndingSignals
from twostage_servo.telemetry.trip_files import Document, Records, TripFiles, write_file

if TYPE_CHECKING:
    import concurrent.futures
    from types import TracebackType
    from typing import Self

Injection = Callable[[World, Random], None]

_PATIENCE_S = 60.0
"""Real time after which a file is not waited for any more; nothing is measured against it."""
_ANOTHER_S = 0.015
"""A second signal comes while the axis brakes."""
_LOOKED_AT_S = 3.0
"""Simulated time in which a service has looked at its socket."""


def receive(number: signal.Signals) -> Injection:
    """Send this process a signal that would end it, and the same again while the axis brakes."""

    def inject(world: World, _: Random) -> None:
        signals = world.held.enter_context(_Caught(number))
        signals.call(world.service.shut_down, asyncio.get_running_loop())
        signal.raise_signal(number)
        world.later(_ANOTHER_S, lambda: signal.raise_signal(number))

    return inject


class _Caught(EndingSignals):
    """Catches a signal as the service does, also where whoever runs the campaign ignores it (``nohup``)."""

    def __init__(self, number: signal.Signals) -> None:
        super().__init__()
        self._number = number
        self._outer: Any = signal.SIG_DFL

    def __enter__(self) -> "Self":
        self._outer = signal.signal(self._number, signal.SIG_DFL)
        return super().__enter__()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: "TracebackType | None"
    ) -> None:
        super().__exit__(kind, error, traceback)
        signal.signal(self._number, self._outer)


async def ended_with_the_drive_disabled(world: World) -> str | None:
    """Check that the service has ended without an error, and has told its drive to disable."""
    serving = world.serving
    if not serving.done():
        return "the service continues"
    if error := serving.exception():
        return f"the service ended with {error!r}"
    if world.drive.enabled:
        return "the drive is still enabled"
    if world.axis.state is not State.DISARMED:
        return f"the braking was cut short, the axis was still {world.axis.state}"
    timeouts = world.drive.counters.command_timeouts
    return f"the drive had to stop by itself, {timeouts} times" if timeouts else None


# Exhausted when it trips ----------------------------------------------------------------------------------------------


def _trip_while(
    exhausted: contextlib.AbstractContextManager[None],
    writer: Callable[[Path, str, Document, Records], Path] = write_file,
) -> Injection:
    """Let another node command the drive, which trips the axis, while something is exhausted."""

    def inject(world: World, random: Random) -> None:
        files = _Threaded(world.folder / "trips", writer)
        files.start()
        world.loop.trip_files.use(files)
        world.held.callback(files.close)
        world.held.enter_context(exhausted)
        foreign_command(world, random)

    return inject


class _Threaded(TripFiles):
    """Trip files that are written by their thread in simulated time as well, which else calls what is for a thread."""

    def __init__(self, folder: Path, writer: Callable[[Path, str, Document, Records], Path]) -> None:
        super().__init__(folder, writer)
        self._handed_over: list[tuple[str, str, concurrent.futures.Future[Path]]] = []

    def write(
        self, axis: str, code: str, document: Document, records: Records, file: TripFile | None = None
    ) -> TripFile:
        """Hand a file over to the thread; :meth:`wait` tells what came of it."""
        file = TripFile() if file is None else file
        try:
            future = self._thread.submit(self._write_file, self.folder, f"{axis}-{code}", document, records)
            self._handed_over.append((axis, code, future))
        except RuntimeError as error:
            self.fail(axis, code, error, file)
        return file

    def wait(self) -> None:
        """Wait, in real time, until all are written."""
        for axis, code, future in self._handed_over:
            self.latest = None
            try:
                self.latest = future.result(_PATIENCE_S)
            except (OSError, MemoryError) as error:
                self.fail(axis, code, error, TripFile())


@contextlib.contextmanager
def _no_descriptor() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    free = os.open(os.devnull, os.O_RDONLY)
    os.close(free)
    resource.setrlimit(resource.RLIMIT_NOFILE, (free, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@contextlib.contextmanager
def _no_thread() -> Iterator[None]:
    start = threading.Thread.start

    def fail(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    threading.Thread.start = fail  # type: ignore[method-assign, assignment]
    try:
        yield
    finally:
        threading.Thread.start = start  # type: ignore[method-assign]


def _no_memory(*_: object) -> Path:
    raise MemoryError


def no_descriptor_left(world: World, random: Random) -> None:
    """Let the axis trip while the process can open no file and no connection."""
    _trip_while(_no_descriptor())(world, random)


def no_thread_left(world: World, random: Random) -> None:
    """Let the axis trip while the process can start no thread."""
    _trip_while(_no_thread())(world, random)


def no_memory_left(world: World, random: Random) -> None:
    """Let the axis trip while there is no memory for what is written about it."""
    _trip_while(contextlib.nullcontext(), _no_memory)(world, random)


async def wrote_the_trip(world: World) -> str | None:
    """Check that there is a file of the trip, if there was one, and the service goes on."""
    return await _after_the_trip(world, "")


async def told_that_no_descriptor_is_left(world: World) -> str | None:
    """Check that it is told that there is no file of the trip, and the service goes on."""
    return await _after_the_trip(world, "Too many open files")


async def told_that_no_memory_is_left(world: World) -> str | None:
    """Check that it is told that there is no file of the trip, and the service goes on."""
    return await _after_the_trip(world, "out of memory")


async def _after_the_trip(world: World, expected_error: str) -> str | None:
    files = world.loop.trip_files.files
    if world.axis.trip is not None and isinstance(files, _Threaded):
        files.wait()
        error = files.error or ""
        if (expected_error not in error) or bool(error) is not bool(expected_error):
            return f"the status reports of the trip file: {error or 'nothing'}"
        if not expected_error and (files.latest is None or not files.latest.exists()):
            return "there is no file of the trip"
    world.held.close()
    return await _is_served(world)


# The socket -----------------------------------------------------------------------------------------------------------


def delete_socket(world: World, _: Random) -> None:
    """Delete the control socket, while an operator is connected."""
    world.clients.spawn(_delete_socket(world))


async def _delete_socket(world: World) -> None:
    async with world.clients.connect() as client:
        world.clients.socket_path.unlink()
        for _ in range(5):
            await asyncio.sleep(1.0)
            try:
                await client.ask(StatusRequest())
            except ServoError:
                world.refusals.append("unserved")
            else:
                world.refusals.append(None)


async def is_served_again(world: World) -> str | None:
    """Check that who was connected stays so, and anybody can connect again."""
    await world.seconds(_LOOKED_AT_S)
    if not world.refusals or any(world.refusals):
        return "an operator who was connected is not served any more"
    return await _is_served(world)


async def _is_served(world: World) -> str | None:
    """Check that the service goes on, and serves a new client."""
    if world.serving.done():
        return "the service has ended"
    return await serves_others(world)
