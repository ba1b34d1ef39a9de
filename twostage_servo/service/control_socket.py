"""The control socket: a Unix socket on which each line is a JSON request and each answer a JSON line.

Whoever may open the socket may command the axis: its folder and file permissions decide. Nothing here ever makes a tick
wait, and all that clients have is bounded: connections, in whatever phase they are, tasks, and what is kept for each.
Nor do idle clients keep anybody from `stop`: of too many, the one that has been idle the longest makes room.
"""

import asyncio
import contextlib
import errno
import itertools
import socket
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

from twostage_servo.service import answers
from twostage_servo.service.connection import Connection, wake
from twostage_servo.service.connections import MOST, Connections
from twostage_servo.service.request_age import RequestAge, no_time_asleep
from twostage_servo.service.request_handler import RequestHandler
from twostage_servo.service.request_reading import BadRequestError, longest_line, parse_request, rank_of
from twostage_servo.service.requests import Request, WatchRequest
from twostage_servo.service.socket_file import SocketFile, SocketInUseError
from twostage_servo.service.status_lines import StatusLines
from twostage_servo.service.turns import Rank
from twostage_servo.service.watchers import Watchers

if TYPE_CHECKING:
    from twostage_servo.service.loop import ServoService

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
_TOO_MANY: Final = (
    f"{MOST} clients are the most, and this one was idle the longest. Connect again; "
    "`ss -xp` shows which processes hold the others"
)


class ControlSocket:
    """Serves requests and streams snapshots.

    Parameters
    ----------
    path
        Path of the socket.
    service
        What the requests are for; it says when they may be served.
    asleep_s
        Tells how long the machine has slept, s, for the age of requests.
    """

    def __init__(self, path: Path, service: "ServoService", asleep_s: Callable[[], float] = no_time_asleep) -> None:
        self.path = path
        self._service = service
        self._turns = service.turns
        self._age = RequestAge(service.ticks.period_s, asleep_s)
        self._status = StatusLines(service)
        self._handler = RequestHandler(service, self._status, self._age)
        self._connections = Connections()
        self._watchers = Watchers(self._connections, self._status, service.turns)
        self._longest = longest_line(station.name for station in service.stations)
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
        listening = self._listen(listener)
        keeping = self._file.keep(lambda: self._turns.turn(Rank.CONNECTION), self._listen, listening, listener)
        self._working = [asyncio.create_task(keeping), asyncio.create_task(self._watch())]

    async def stop(self) -> None:
        """Stop listening, end all connections, remove the socket; waits for no client."""
        self._file.remove()
        tasks = [*self._listening, *self._working, *self._serving]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for connection in self._connections:  # of a task that had not even begun
            self._end(connection)
        self._working = []

    def _listen(self, listener: socket.socket) -> "asyncio.Task[None]":
        task = asyncio.create_task(self._let_in(listener))
        self._listening.add(task)
        task.add_done_callback(self._listening.discard)
        task.add_done_callback(lambda _: listener.close())  # also where it has not even begun
        return task

    def publish(self, tick: int) -> None:
        """Take notice of a tick, and of the watchers for which a snapshot is due; it is made between the ticks."""
        self._age.tick()
        self._status.forget()
        self._watchers.publish(tick)

    # Who comes, and who goes -----------------------------------------------------------------------------------------

    async def _let_in(self, listener: socket.socket) -> None:
        """Let clients in, in turns; the kernel keeps the others waiting."""
        with listener:
            door = _Door(listener, self._age)
            while True:
                await door.somebody()
                try:
                    async with self._turns.turn(Rank.CONNECTION):
                        self._let_some_in(door)
                except Exception as error:  # noqa: BLE001 - no descriptor is left, or a defect: nobody is shut out for good
                    self._log.warning("no client can be let in", error=repr(error), retry_s=_PAUSE_S)
                    await asyncio.sleep(_PAUSE_S)
                await asyncio.sleep(0)

    def _let_some_in(self, door: "_Door") -> None:
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._turns.slice_s
        for _ in range(_MOST_A_TURN):
            try:
                accepted = door.accept()
            except OSError as error:
                if error.errno not in _NO_ROOM or not self._make_room():
                    raise
                return
            if accepted is None:
                return
            self._begin(*accepted)
            if clock() >= until_s:
                return

    def _begin(self, stream: socket.socket, empty_s: float) -> None:
        """Begin with a client; one that has come and gone costs no more than this."""
        try:
            stream.setblocking(False)
            connection = Connection(stream, next(self._numbers), self._longest, self._age, empty_s)
        except BaseException:
            stream.close()
            raise
        connection.receive()  # most have said what they want by now
        if connection.ended and not connection.has_line:
            connection.close()
            return
        if self._connections.full:
            self._make_room()
        self._connections.add(connection)
        first = self._read(connection) if connection.has_line else None
        connection.task = task = asyncio.create_task(self._serve(connection, first))
        self._serving.add(task)
        task.add_done_callback(self._serving.discard)

    def _make_room(self) -> bool:
        """End the connection that matters least; return whether there was one that may be ended."""
        connection = self._connections.the_one_to_go(self._service.desk.lease.holder)
        if connection is None:
            return False
        self._log.warning("a client had to make room", peer=connection.peer, clients=len(self._connections))
        if connection.urgent is not None:  # it shall be carried out, and nobody waits for its answer
            self._handler.answer(connection.urgent, connection)
        if not connection.busy:
            connection.write(answers.failure("too_many_clients", _TOO_MANY))
        self._end(connection)
        if connection.task is not None:
            connection.task.cancel()
        return True

    def _end(self, connection: Connection) -> None:
        if connection in self._connections:
            self._connections.discard(connection)
            self._service.desk.leave(connection.peer)
        connection.close()

    # What they ask ---------------------------------------------------------------------------------------------------

    async def _serve(self, connection: Connection, request: Request | None) -> None:
        """Serve a client, whose first request may have been read already, until it has asked for all that it wants."""
        try:
            while request is not None or (request := await self._next_request(connection)) is not None:
                await self._answer(connection, request)
                request = None
            self._service.desk.leave(connection.peer)
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
            async with self._turns.turn(self._rank_of_reading(connection)):
                request = self._read(connection)
            if request is not None:
                return request
            if not connection.ended:  # at the end it is not waited for that long
                await connection.taken()
            await asyncio.sleep(0)

    def _rank_of_reading(self, connection: Connection) -> Rank:
        """Return how a client comes to speak: whoever has been silent for a while need not wait behind those who flood.

        It may be the operator, who wants to stop.
        """
        silent_s = asyncio.get_running_loop().time() - connection.read_s
        return Rank.CONNECTION if silent_s >= _SILENT_TICKS * self._service.ticks.period_s else Rank.READING

    def _read(self, connection: Connection) -> Request | None:
        """Read once; return a request if there is one, and answer what is none."""
        connection.read_s = asyncio.get_running_loop().time()
        if not connection.has_line:
            connection.receive()
        if connection.too_long:
            text = f"a request must fit in {self._longest} bytes"
            connection.write(answers.failure("bad_request", text))
            connection.end()
            return None
        if not connection.has_line:
            return None
        self._connections.touch(connection)
        try:
            request = parse_request(connection.take_line())
        except BadRequestError as error:
            connection.write(answers.failure("bad_request", str(error)))
            return None
        if rank_of(request) is Rank.URGENT:
            connection.urgent = request
        return request

    async def _answer(self, connection: Connection, request: Request) -> None:
        """Carry a request out and answer it, in a turn for each piece of work: a tick may come between."""
        is_more = connection.busy = True
        refused = await self._handler.prepare(request, connection)
        pieces: Iterator[bytes] | None = None if refused is None else refused.pieces
        while is_more:
            async with self._turns.turn(rank_of(request)):
                if connection.closed:
                    return  # it has been told that its connection ends, and must not set an axis moving after that
                if pieces is None:
                    connection.urgent = None
                    pieces, done = self._handler.answer(request, connection)
                    if done and isinstance(request, WatchRequest):
                        connection.every, connection.axis = request.every, request.axis
                is_more = self._send_some(connection, pieces)
            await connection.taken()
            await asyncio.sleep(0)
        connection.busy = False

    def _send_some(self, connection: Connection, pieces: Iterator[bytes]) -> bool:
        """Make and send some pieces of an answer; return whether there may be more."""
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._turns.slice_s
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
            self._service.fail(error)


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
