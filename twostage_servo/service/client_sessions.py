"""The clients that are served: what each asks for is read, carried out and answered, in slots between the ticks."""

import asyncio
import contextlib
from collections.abc import Iterator
from typing import Final

import structlog

from twostage_servo.api.request_reading import COMMAND_WORDS, LONGEST_URGENT, URGENT_WORDS, parse_request
from twostage_servo.api.requests import BadRequestError, Request, WatchRequest
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.service import answers
from twostage_servo.service.background_server import BackgroundServer, Priority, priority_of
from twostage_servo.service.connection import Connection
from twostage_servo.service.connections import MOST, Connections
from twostage_servo.service.request_handler import RequestHandler
from twostage_servo.service.watchers import Watchers
from twostage_servo.timing.ticks import Tick

_MOST_A_SLOT: Final = 16
"""Pieces of an answer made in one turn, however little time they seem to take."""
_LINGER_S: Final = 1.0
"""For so long a client that sends no more may take what it was answered."""
_SILENT_TICKS: Final = 10
"""Ticks without a request after which a client is no flood."""
_TOO_MANY: Final = answers.failure(
    RefusalCode.TOO_MANY_CLIENTS,
    f"at most {MOST} clients are served, and this one was idle the longest. Connect again; "
    "`ss -xp` shows which processes hold the others",
)
_MOST_DROPPED: Final = 64
"""Reads of a client that has gone in one turn, however little time they seem to take."""
_LOOKS: Final = 4
"""Idle clients that are looked at again before one of them has to go: it may have asked for something just now."""


class ClientSessions:
    """Serves clients, each by a task of its own, and sends snapshots to those that watch.

    Of too many, the one that has been idle the longest makes room.

    Parameters
    ----------
    requests
        Carries out what is asked.
    background
        Says when that may be done.
    longest
        Bytes of the longest request.

    Attributes
    ----------
    longest
        As given.
    """

    def __init__(self, requests: RequestHandler, background: BackgroundServer, longest: int) -> None:
        self.longest = longest
        self._requests = requests
        self._background = background
        self._connections = Connections()
        self._watchers = Watchers(self._connections, requests.status, background)
        self._serving: dict[Connection, asyncio.Task[None]] = {}
        self._log = structlog.get_logger().bind(room="control_socket")

    @property
    def full(self) -> bool:
        """Whether all places are taken."""
        return self._connections.full

    def publish(self, tick: Tick) -> None:
        """Mark the watchers for which a snapshot is due at this tick; it is made between the ticks."""
        self._requests.status.forget()
        self._watchers.publish(tick.index)

    async def watch(self) -> None:
        """Send snapshots, until cancelled.

        Raises
        ------
        Exception
            A defect of this program.
        """
        await self._watchers.run()

    async def stop(self) -> None:
        """End all sessions; waits for no client."""
        tasks = list(self._serving.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for connection in self._connections:  # of a task that had not even begun
            self._end(connection)

    # Who comes, and who goes -----------------------------------------------------------------------------------------

    def admit(self, connection: Connection, request: Request | None) -> None:
        """Let a client be one of those that are served, with its first request if that was read already."""
        connection.identify()
        if self._connections.full:
            self.make_room()
        self._connections.add(connection)
        if request is None and connection.has_line:
            request = self.read(connection)
        task = self._serving[connection] = asyncio.create_task(self._serve(connection, request))
        task.add_done_callback(lambda _: self._serving.pop(connection))

    def _least(self) -> Connection | None:
        """Return the connection that matters least, and has not asked for anything just now either."""
        connection = None
        for _ in range(_LOOKS):
            connection = self._connections.to_evict(self._requests.authority.holder)
            if connection is None or connection.busy or connection.ended or connection.urgent is not None:
                break
            if not connection.has_line:
                connection.receive()
            if not connection.has_line:
                break
            self._connections.touch(connection)
        return connection

    def make_room(self) -> bool:
        """End the connection that matters least; return whether there was one that may be ended."""
        connection = self._least()
        if connection is None:
            return False
        self._log.warning(
            "a client was disconnected to make room", peer=connection.peer, clients=len(self._connections)
        )
        if connection.urgent is None and connection.next_line_names(URGENT_WORDS, LONGEST_URGENT):
            self.read(connection)
        if connection.urgent is not None:  # it shall be carried out, and nobody waits for its answer
            self._requests.answer(connection.urgent, connection)
        if not connection.busy:
            connection.write(_TOO_MANY)
        self._end(connection)
        if (task := self._serving.get(connection)) is not None:
            task.cancel()
        return True

    def _end(self, connection: Connection) -> None:
        if connection in self._connections:
            self._connections.discard(connection)
            self._watchers.end(connection)
            self._requests.disconnect(connection.peer)
        connection.close()

    # What they ask ---------------------------------------------------------------------------------------------------

    async def _serve(self, connection: Connection, request: Request | None) -> None:
        """Serve a client, whose first request may have been read already, until it has asked for all that it wants."""
        try:
            while request is not None or (request := await self._next_request(connection)) is not None:
                await self._answer(connection, request)
                request = None
            self._requests.disconnect(connection.peer)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_LINGER_S):
                    await connection.flushed()
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
                request = self.read(connection)
            if request is not None:
                return request
            if not connection.ended:  # at the end it is not waited for that long
                await connection.flushed()
            await asyncio.sleep(0)

    def _priority_of_reading(self, connection: Connection) -> Priority:
        """Return how a client comes to speak: whoever has been silent for a while need not wait behind those who flood.

        It may be the operator, who wants to stop.
        """
        silent_s = asyncio.get_running_loop().time() - connection.read_s
        return Priority.CONNECTION if silent_s >= _SILENT_TICKS * self._background.period_s else Priority.READING

    def read(self, connection: Connection) -> Request | None:
        """Read once; return a request if there is one, and answer what is none."""
        connection.begin_reading()
        if not connection.has_line:
            connection.receive()
        if connection.too_long:
            text = f"a request must fit in {self.longest} bytes"
            connection.write(answers.failure(RefusalCode.BAD_REQUEST, text))
            connection.end()
            return None
        if not connection.has_line or (connection.gone and self._drop_readings(connection)):
            return None
        self._connections.touch(connection)
        try:
            request = parse_request(connection.pop_line())
        except BadRequestError as error:
            connection.write(answers.failure(RefusalCode.BAD_REQUEST, str(error)))
            return None
        if priority_of(request) is Priority.URGENT:
            connection.hold_urgent(request)
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
        """Carry a request out and answer it, in a slot for each piece of work: a tick may come between."""
        is_more = True
        connection.begin_answer()
        refused = await self._requests.prepare(request, connection)
        connection.probe()
        pieces: Iterator[bytes] | None = None if refused is None else refused.pieces
        while is_more:
            async with self._background.slot(priority_of(request)):
                if connection.closed:
                    return  # it has been told that its connection ends, and must not set an axis moving after that
                if pieces is None:
                    connection.release_urgent()
                    pieces, done, axis_loop = self._requests.answer(request, connection)
                    if done and isinstance(request, WatchRequest):
                        self._watchers.begin(connection, request.every, axis_loop)
                is_more = self._send_some(connection, pieces)
            await connection.flushed()
            connection.probe()
            await asyncio.sleep(0)
        connection.end_answer()

    def _send_some(self, connection: Connection, pieces: Iterator[bytes]) -> bool:
        """Make and send some pieces of an answer; return whether there may be more."""
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._background.slice_s
        made = []
        for _ in range(_MOST_A_SLOT):
            piece = next(pieces, None)
            if piece is None:
                break
            made.append(piece)
            if clock() >= until_s:
                break
        connection.write(b"".join(made))
        return piece is not None
