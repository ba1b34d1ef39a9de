"""The control socket: a Unix socket on which each line is a JSON request and each answer a JSON line.

Whoever may open the socket may command the axis: its folder and file permissions decide. Nothing here ever makes a tick
wait, and all that clients have is bounded: connections, in whatever phase they are, tasks, and what is kept for each.
Nor do idle clients keep anybody from `stop`: of too many, the one that has been idle the longest makes room.
"""

import asyncio
import contextlib
import errno
import functools
import itertools
import math
import socket
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

from twostage_servo.api.request_reading import (
    COMMAND_WORDS,
    LONGEST_URGENT,
    URGENT_WORDS,
    longest_line,
    parse_request,
)
from twostage_servo.api.requests import BadRequestError, Request, WatchRequest
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.service import answers
from twostage_servo.service.background_server import Priority, priority_of
from twostage_servo.service.connection import Connection, wake
from twostage_servo.service.connections import MOST, Connections
from twostage_servo.service.newcomers import Newcomers
from twostage_servo.service.request_age import RequestAge
from twostage_servo.service.request_handler import RequestHandler
from twostage_servo.service.socket_file import SocketFile, SocketInUseError
from twostage_servo.service.watchers import Watchers
from twostage_servo.timing.ticks import Tick

if TYPE_CHECKING:
    from twostage_servo.service.background_server import BackgroundServer

__all__ = ["ControlSocket", "SocketInUseError"]

_BACKLOG: Final = 32
"""Clients that may wait to be let in: the next one waits for those before it, and all of them are let in in a tick."""
_MOST_A_TURN: Final = 16
"""Clients let in, or pieces of an answer made, in one turn, however little time they seem to take."""
_PAUSE_S: Final = 1.0
"""After a client that could not be let in."""
_LINGER_S: Final = 1.0
"""For so long a client that sends no more may take what it was answered."""
_SILENT_TICKS: Final = 10
"""Ticks without a request after which a client is no flood."""
_NO_ROOM: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
_TOO_MANY: Final = answers.failure(
    RefusalCode.TOO_MANY_CLIENTS,
    f"{MOST} clients are the most, and this one was idle the longest. Connect again; "
    "`ss -xp` shows which processes hold the others",
)
_NO_PLACE: Final = answers.failure(
    RefusalCode.TOO_MANY_CLIENTS,
    f"{MOST} clients are the most, and too many others wait for a place. Connect again; "
    "`ss -xp` shows which processes hold the others",
)
_MOST_DROPPED: Final = 64
"""Reads of a client that has gone in one turn, however little time they seem to take."""
_LOOKS: Final = 4
"""Idle clients that are looked at again before one of them has to go: it may have asked for something just now."""
_BETWEEN_REPORTS_S: Final = 1.0
"""Time between two lines of the log about newcomers that were turned away."""


class ControlSocket:
    """Serves requests and streams snapshots.

    Parameters
    ----------
    path
        Path of the socket.
    requests
        Carries out what is asked.
    background
        Says when that may be done.
    names
        Names of the axes, for the length of the longest request.
    fail
        Called with a defect that has to end the service.
    """

    def __init__(
        self,
        path: Path,
        requests: RequestHandler,
        background: "BackgroundServer",
        names: Iterable[str],
        fail: Callable[[Exception], None],
    ) -> None:
        self.path = path
        self._handler = requests
        self._background = background
        self._fail = fail
        self._age = requests.age
        self._connections = Connections()
        self._newcomers: Newcomers | None = None
        self._turned_away = 0
        self._next_report_s = -math.inf
        self._watchers = Watchers(self._connections, requests.status, background)
        self._longest = longest_line(names)
        self._numbers = itertools.count(1)
        self._serving: set[asyncio.Task[None]] = set()
        self._file = SocketFile(path, _BACKLOG)
        self._listening: set[asyncio.Task[None]] = set()
        self._working: list[asyncio.Task[None]] = []
        self._log = structlog.get_logger().bind(room="control_socket")

    async def start(self) -> None:
        """Listen.

        Raises
        ------
        SocketInUseError
            If another service listens there.
        OSError
            If the path cannot be used.
        """
        listener = self._file.bind()
        newcomers = self._newcomers = Newcomers(self._age)
        listen = functools.partial(self._listen, newcomers)
        listening = listen(listener)
        keeping = self._file.keep(lambda: self._background.slot(Priority.CONNECTION), listen, listening, listener)
        serving = (keeping, self._watch(), self._hear_out(newcomers), self._let_wait(newcomers))
        self._working = [asyncio.create_task(one) for one in serving]

    async def stop(self) -> None:
        """Stop listening, end all connections, remove the socket; waits for no client."""
        self._file.remove()
        tasks = [*self._listening, *self._working, *self._serving]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for connection in self._connections:  # of a task that had not even begun
            self._end(connection)
        if self._newcomers is not None:
            self._newcomers.close()
            self._newcomers = None
        self._working = []

    def _listen(self, newcomers: Newcomers, listener: socket.socket) -> "asyncio.Task[None]":
        task = asyncio.create_task(self._let_in(newcomers, listener))
        self._listening.add(task)
        task.add_done_callback(self._listening.discard)
        task.add_done_callback(lambda _: listener.close())  # also where it has not even begun
        return task

    def publish(self, tick: Tick) -> None:
        """Take notice of a tick, and of the watchers for which a snapshot is due; it is made between the ticks."""
        self._age.tick()
        self._handler.status.forget()
        self._watchers.publish(tick.index)

    # Who comes, and who goes -----------------------------------------------------------------------------------------

    async def _let_in(self, newcomers: Newcomers, listener: socket.socket) -> None:
        """Let clients in, in turns; the kernel keeps the others waiting."""
        with listener:
            door = _Door(listener, self._age)
            while True:
                await newcomers.room()
                await door.somebody()
                try:
                    async with self._background.slot(Priority.CONNECTION):
                        self._let_some_in(newcomers, door)
                except Exception as error:  # noqa: BLE001 - no descriptor is left, or a defect: nobody is shut out for good
                    self._log.warning("no client can be let in", error=repr(error), retry_s=_PAUSE_S)
                    await asyncio.sleep(_PAUSE_S)
                await asyncio.sleep(0)

    def _let_some_in(self, newcomers: Newcomers, door: "_Door") -> None:
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._background.slice_s
        for _ in range(_MOST_A_TURN):
            if newcomers.pause_s() > 0.0:
                return
            try:
                accepted = door.accept()
            except OSError as error:
                if error.errno not in _NO_ROOM or not (self._shed_silent(newcomers) or self._make_room()):
                    raise
                return
            if accepted is None:
                return
            self._begin(newcomers, *accepted)
            if clock() >= until_s:
                return

    def _begin(self, newcomers: Newcomers, stream: socket.socket, empty_s: float) -> None:
        """Begin with a client; one that has come and gone, or has nothing to say yet, costs no more than this."""
        try:
            stream.setblocking(False)
            connection = Connection(stream, next(self._numbers), self._longest, self._age, empty_s)
        except BaseException:
            stream.close()
            raise
        connection.receive()  # most have said what they want by now
        if connection.ended or connection.has_line:
            self._arrive(newcomers, connection)
            return
        if newcomers.is_silent_full:
            self._shed_silent(newcomers)
        newcomers.add_silent(connection)

    async def _hear_out(self, newcomers: Newcomers) -> None:
        """Read the first request of each who had none when he was let in."""
        while True:
            await newcomers.somebody_speaks()
            async with self._background.slot(Priority.CONNECTION):
                self._hear_some_out(newcomers)
            await asyncio.sleep(0)

    def _hear_some_out(self, newcomers: Newcomers) -> None:
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._background.slice_s
        for connection in newcomers.speaking(_MOST_A_TURN):
            connection.receive()
            if connection.ended or connection.has_line:
                newcomers.remove_silent(connection)
                self._arrive(newcomers, connection)
            if clock() >= until_s:
                return

    def _arrive(self, newcomers: Newcomers, connection: Connection) -> None:
        """Serve a client that has said something. Where all places are taken only what is urgent goes before others."""
        if not connection.has_line:
            connection.close()
            return
        request = None
        if connection.next_line_names(URGENT_WORDS, LONGEST_URGENT):
            connection.identify()
            request = self._read(connection)
        if not self._connections.full or connection.urgent is not None:
            self._admit(connection, request)
        elif newcomers.is_waiting_full:
            self._turn_away(connection)
        else:
            newcomers.add_waiting(connection, request)

    async def _let_wait(self, newcomers: Newcomers) -> None:
        """Find a place for each who waits for one."""
        while True:
            await newcomers.somebody_waits()
            async with self._background.slot(Priority.CONNECTION):
                self._admit_some(newcomers)
            await asyncio.sleep(0)

    def _admit_some(self, newcomers: Newcomers) -> None:
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._background.slice_s
        for _ in range(_MOST_A_TURN):
            waiting = newcomers.next_waiting()
            if waiting is None:
                return
            self._admit(*waiting)
            if clock() >= until_s:
                return

    def _admit(self, connection: Connection, request: Request | None) -> None:
        """Let a client be one of those that are served, with its first request if that was read already."""
        connection.identify()
        if self._connections.full:
            self._make_room()
        self._connections.add(connection)
        if request is None and connection.has_line:
            request = self._read(connection)
        connection.task = task = asyncio.create_task(self._serve(connection, request))
        self._serving.add(task)
        task.add_done_callback(self._serving.discard)

    # Who goes --------------------------------------------------------------------------------------------------------

    def _shed_silent(self, newcomers: Newcomers) -> bool:
        """End the newcomer that has been silent the longest, unless he speaks now; return whether there was one."""
        connection = newcomers.oldest_silent()
        if connection is None:
            return False
        newcomers.remove_silent(connection)
        connection.receive()
        if connection.ended or connection.has_line:
            self._arrive(newcomers, connection)
        else:
            self._turn_away(connection)
        return True

    def _turn_away(self, connection: Connection) -> None:
        """End a newcomer. The log tells of many at once: a line for each would cost more than all the rest."""
        self._turned_away += 1
        now_s = asyncio.get_running_loop().time()
        if now_s >= self._next_report_s:
            connection.identify()
            newest, number = connection.peer, self._turned_away
            self._log.warning("newcomers were turned away: all places are taken", newest=newest, number=number)
            self._turned_away, self._next_report_s = 0, now_s + _BETWEEN_REPORTS_S
        connection.write(_NO_PLACE)
        connection.close()

    def _least(self) -> Connection | None:
        """Return the connection that matters least, and has not asked for anything just now either."""
        connection = None
        for _ in range(_LOOKS):
            connection = self._connections.the_one_to_go(self._handler.authority.holder)
            if connection is None or connection.busy or connection.ended or connection.urgent is not None:
                break
            if not connection.has_line:
                connection.receive()
            if not connection.has_line:
                break
            self._connections.touch(connection)
        return connection

    def _make_room(self) -> bool:
        """End the connection that matters least; return whether there was one that may be ended."""
        connection = self._least()
        if connection is None:
            return False
        self._log.warning("a client had to make room", peer=connection.peer, clients=len(self._connections))
        if connection.urgent is None and connection.next_line_names(URGENT_WORDS, LONGEST_URGENT):
            self._read(connection)
        if connection.urgent is not None:  # it shall be carried out, and nobody waits for its answer
            self._handler.answer(connection.urgent, connection)
        if not connection.busy:
            connection.write(_TOO_MANY)
        self._end(connection)
        if connection.task is not None:
            connection.task.cancel()
        return True

    def _end(self, connection: Connection) -> None:
        if connection in self._connections:
            self._connections.discard(connection)
            self._handler.leave(connection.peer)
        connection.close()

    # What they ask ---------------------------------------------------------------------------------------------------

    async def _serve(self, connection: Connection, request: Request | None) -> None:
        """Serve a client, whose first request may have been read already, until it has asked for all that it wants."""
        try:
            while request is not None or (request := await self._next_request(connection)) is not None:
                await self._answer(connection, request)
                request = None
            self._handler.leave(connection.peer)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_LINGER_S):
                    await connection.taken()
        except ConnectionError as error:
            self._log.info("client lost", peer=connection.peer, error=str(error))
        except Exception as error:  # noqa: BLE001 - a defect in one answer ends this connection, and nothing else
            self._log.error("a client could not be served", peer=connection.peer, exc_info=error)
        finally:
            self._end(connection)

    async def _next_request(self, connection: Connection) -> Request | None:
        """Return the next request; None at the end of the connection, or where it must end."""
        while True:
            if not connection.has_line:
                if connection.ended:
                    return None
                await connection.readable()
            async with self._background.slot(self._priority_of_reading(connection)):
                request = self._read(connection)
            if request is not None:
                return request
            if not connection.ended:  # at the end it is not waited for that long
                await connection.taken()
            await asyncio.sleep(0)

    def _priority_of_reading(self, connection: Connection) -> Priority:
        """Return how a client comes to speak: whoever has been silent for a while need not wait behind those who flood.

        It may be the operator, who wants to stop.
        """
        silent_s = asyncio.get_running_loop().time() - connection.read_s
        return Priority.CONNECTION if silent_s >= _SILENT_TICKS * self._background.period_s else Priority.READING

    def _read(self, connection: Connection) -> Request | None:
        """Read once; return a request if there is one, and answer what is none."""
        connection.read_s = asyncio.get_running_loop().time()
        if not connection.has_line:
            connection.receive()
        if connection.too_long:
            text = f"a request must fit in {self._longest} bytes"
            connection.write(answers.failure(RefusalCode.BAD_REQUEST, text))
            connection.end()
            return None
        if not connection.has_line or (connection.gone and self._drop_readings(connection)):
            return None
        self._connections.touch(connection)
        try:
            request = parse_request(connection.take_line())
        except BadRequestError as error:
            connection.write(answers.failure(RefusalCode.BAD_REQUEST, str(error)))
            return None
        if priority_of(request) is Priority.URGENT:
            connection.urgent = request
        return request

    def _drop_readings(self, connection: Connection) -> bool:
        """Forget what a client that has gone only wanted to know; return whether no other line is left for now."""
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._background.slice_s
        for _ in range(_MOST_DROPPED):
            if not connection.drop_lines_without(COMMAND_WORDS) and connection.has_line:
                return False
            if connection.ended or clock() >= until_s:
                break
            connection.receive()
        return not connection.has_line

    async def _answer(self, connection: Connection, request: Request) -> None:
        """Carry a request out and answer it, in a turn for each piece of work: a tick may come between."""
        is_more = connection.busy = True
        refused = await self._handler.prepare(request, connection)
        connection.look()
        pieces: Iterator[bytes] | None = None if refused is None else refused.pieces
        while is_more:
            async with self._background.slot(priority_of(request)):
                if connection.closed:
                    return  # it has been told that its connection ends, and must not set an axis moving after that
                if pieces is None:
                    connection.urgent = None
                    pieces, done, axis_loop = self._handler.answer(request, connection)
                    if done and isinstance(request, WatchRequest):
                        self._watchers.begin(connection, request.every, axis_loop)
                is_more = self._send_some(connection, pieces)
            await connection.taken()
            connection.look()
            await asyncio.sleep(0)
        connection.busy = False

    def _send_some(self, connection: Connection, pieces: Iterator[bytes]) -> bool:
        """Make and send some pieces of an answer; return whether there may be more."""
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._background.slice_s
        made = []
        for _ in range(_MOST_A_TURN):
            piece = next(pieces, None)
            if piece is None:
                break
            made.append(piece)
            if clock() >= until_s:
                break
        connection.write(b"".join(made))
        return piece is not None

    async def _watch(self) -> None:
        try:
            await self._watchers.run()
        except Exception as error:  # noqa: BLE001 - the service ends with it
            self._fail(error)


class _Door:
    """The listening socket, with what is known of when those who wait there came.

    Parameters
    ----------
    listener
        The socket.
    age
        Tells the time.
    """

    def __init__(self, listener: socket.socket, age: RequestAge) -> None:
        self._listener = listener
        self._age = age
        self._empty_s = age.now_s()  # nobody waited
        self._let_in: deque[float] = deque(maxlen=_BACKLOG + 2)  # who comes after so many came after the first of them

    async def somebody(self) -> None:
        """Wait until somebody waits."""
        loop, watched_since_s = asyncio.get_running_loop(), self._age.now_s()
        future = loop.create_future()
        loop.add_reader(self._listener, wake, future)
        try:
            await future
        finally:
            loop.remove_reader(self._listener)
        noticed_s = self._age.noticed_s(watched_since_s)
        if noticed_s is not None:
            self._empty_s = max(self._empty_s, noticed_s)

    def accept(self) -> tuple[socket.socket, float] | None:
        """Return a client's socket, and a time at which that did not wait here yet; None if nobody waits."""
        now_s = self._age.now_s()
        try:
            stream, _ = self._listener.accept()
        except BlockingIOError:
            self._empty_s = now_s
            return None
        empty_s = self._empty_s
        if len(self._let_in) == self._let_in.maxlen:
            empty_s = max(empty_s, self._let_in[0])
        self._let_in.append(now_s)
        return stream, empty_s
