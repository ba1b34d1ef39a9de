"""How clients come to be served: let in, heard out, and given a place, in slots between the ticks.

All that they have meanwhile is bounded: of too many who are silent, the one that has been silent the longest goes.
"""

import asyncio
import errno
import itertools
import math
import socket
from typing import Final

import structlog

from twostage_servo.api.request_reading import LONGEST_URGENT, URGENT_WORDS
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.service import answers
from twostage_servo.service.background_server import BackgroundServer, Priority
from twostage_servo.service.client_sessions import ClientSessions
from twostage_servo.service.connection import Connection
from twostage_servo.service.connections import MOST
from twostage_servo.service.listening_socket import ListeningSocket
from twostage_servo.service.newcomers import Newcomers
from twostage_servo.service.request_age import RequestAge

_MOST_A_SLOT: Final = 16
"""Clients let in in one turn, however little time they seem to take."""
_PAUSE_S: Final = 1.0
"""After a client that could not be let in."""
_NO_ROOM: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
_NO_PLACE: Final = answers.failure(
    RefusalCode.TOO_MANY_CLIENTS,
    f"at most {MOST} clients are served, and too many others wait for a place. Connect again; "
    "`ss -xp` shows which processes hold the others",
)
_BETWEEN_REPORTS_S: Final = 1.0
"""Time between two lines of the log about newcomers that were turned away."""


class ClientAdmission:
    """Lets clients in, on the running loop.

    Parameters
    ----------
    sessions
        Where they are served.
    background
        Says when they may be let in.
    age
        Tells the time.

    Attributes
    ----------
    newcomers
        Those who have no place yet.
    """

    def __init__(self, sessions: ClientSessions, background: BackgroundServer, age: RequestAge) -> None:
        self.newcomers = Newcomers(age)
        self._sessions = sessions
        self._background = background
        self._age = age
        self._turned_away = 0
        self._next_report_s = -math.inf
        self._numbers = itertools.count(1)
        self._log = structlog.get_logger().bind(room="control_socket")

    async def accept_connections(self, listener: socket.socket) -> None:
        """Accept connections, each in a slot; the kernel keeps the others waiting."""
        with listener:
            door = ListeningSocket(listener, self._age)
            while True:
                await self.newcomers.room()
                await door.somebody()
                try:
                    async with self._background.slot(Priority.CONNECTION):
                        self._accept_some(door)
                except Exception as error:  # noqa: BLE001 - no descriptor is left, or a defect: nobody is shut out for good
                    self._log.warning("connections cannot be accepted", error=repr(error), retry_s=_PAUSE_S)
                    await asyncio.sleep(_PAUSE_S)
                await asyncio.sleep(0)

    def _accept_some(self, door: "ListeningSocket") -> None:
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._background.slice_s
        for _ in range(_MOST_A_SLOT):
            if self.newcomers.pause_s() > 0.0:
                return
            try:
                accepted = door.accept()
            except OSError as error:
                if error.errno not in _NO_ROOM or not (self._shed_silent() or self._sessions.make_room()):
                    raise
                return
            if accepted is None:
                return
            self._begin(*accepted)
            if clock() >= until_s:
                return

    def _begin(self, stream: socket.socket, empty_s: float) -> None:
        """Begin with a client; one that has come and gone, or has nothing to say yet, costs no more than this."""
        try:
            stream.setblocking(False)
            connection = Connection(stream, next(self._numbers), self._sessions.longest, self._age, empty_s)
        except BaseException:
            stream.close()
            raise
        connection.receive()  # most have said what they want by now
        if connection.ended or connection.has_line:
            self._arrive(connection)
            return
        if self.newcomers.is_silent_full:
            self._shed_silent()
        self.newcomers.add_silent(connection)

    async def read_first_requests(self) -> None:
        """Read the first request of each who had none when he was let in."""
        while True:
            await self.newcomers.somebody_speaks()
            async with self._background.slot(Priority.CONNECTION):
                self._read_some()
            await asyncio.sleep(0)

    def _read_some(self) -> None:
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._background.slice_s
        for connection in self.newcomers.speaking(_MOST_A_SLOT):
            connection.receive()
            if connection.ended or connection.has_line:
                self.newcomers.remove_silent(connection)
                self._arrive(connection)
            if clock() >= until_s:
                return

    def _arrive(self, connection: Connection) -> None:
        """Serve a client that has said something. Where all places are taken only what is urgent goes before others."""
        if not connection.has_line:
            connection.close()
            return
        request = None
        if connection.next_line_names(URGENT_WORDS, LONGEST_URGENT):
            connection.identify()
            request = self._sessions.read(connection)
        if not self._sessions.full or connection.urgent is not None:
            self._sessions.admit(connection, request)
        elif self.newcomers.is_waiting_full:
            self._turn_away(connection)
        else:
            self.newcomers.add_waiting(connection, request)

    async def find_places(self) -> None:
        """Find a place for each who waits for one."""
        while True:
            await self.newcomers.somebody_waits()
            async with self._background.slot(Priority.CONNECTION):
                self._admit_some()
            await asyncio.sleep(0)

    def _admit_some(self) -> None:
        clock = asyncio.get_running_loop().time
        until_s = clock() + self._background.slice_s
        for _ in range(_MOST_A_SLOT):
            waiting = self.newcomers.next_waiting()
            if waiting is None:
                return
            self._sessions.admit(*waiting)
            if clock() >= until_s:
                return

    def _shed_silent(self) -> bool:
        """End the newcomer that has been silent the longest, unless he speaks now; return whether there was one."""
        connection = self.newcomers.oldest_silent()
        if connection is None:
            return False
        self.newcomers.remove_silent(connection)
        connection.receive()
        if connection.ended or connection.has_line:
            self._arrive(connection)
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
            self._log.warning("connections were refused: all places are taken", newest=newest, number=number)
            self._turned_away, self._next_report_s = 0, now_s + _BETWEEN_REPORTS_S
        connection.write(_NO_PLACE)
        connection.close()
