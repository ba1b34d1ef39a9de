"""The control socket: a Unix socket on which each line is a JSON request and each answer a JSON line.

Whoever may open the socket may command the axis: its folder and file permissions decide. Nothing here ever makes a tick
wait, and all that clients have is bounded: connections, in whatever phase they are, tasks, and what is kept for each.
Nor do idle clients keep anybody from `stop`: of too many, the one that has been idle the longest makes room.
"""

import asyncio
import functools
import socket
from collections.abc import Callable, Iterable
from pathlib import Path

from twostage_servo.api.request_reading import longest_line
from twostage_servo.service.background_server import BackgroundServer, Priority
from twostage_servo.service.client_admission import ClientAdmission
from twostage_servo.service.client_sessions import ClientSessions
from twostage_servo.service.listening_socket import BACKLOG
from twostage_servo.service.request_handler import RequestHandler
from twostage_servo.service.socket_file import SocketFile, SocketInUseError
from twostage_servo.timing.ticks import Tick

__all__ = ["ControlSocket", "SocketInUseError"]


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
        background: BackgroundServer,
        names: Iterable[str],
        fail: Callable[[Exception], None],
    ) -> None:
        self.path = path
        self._background = background
        self._fail = fail
        self._age = requests.age
        self._sessions = ClientSessions(requests, background, longest_line(names))
        self._admission: ClientAdmission | None = None
        self._file = SocketFile(path, BACKLOG)
        self._listening: set[asyncio.Task[None]] = set()
        self._working: list[asyncio.Task[None]] = []

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
        admission = self._admission = ClientAdmission(self._sessions, self._background, self._age)
        listen = functools.partial(self._listen, admission)
        listening = listen(listener)
        keeping = self._file.maintain(lambda: self._background.slot(Priority.CONNECTION), listen, listening, listener)
        serving = (keeping, self._watch(), admission.read_first_requests(), admission.find_places())
        self._working = [asyncio.create_task(one) for one in serving]

    async def stop(self) -> None:
        """Stop listening, end all connections, remove the socket; waits for no client."""
        self._file.remove()
        tasks = [*self._listening, *self._working]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._sessions.stop()
        if self._admission is not None:
            self._admission.newcomers.close()
            self._admission = None
        self._working = []

    def publish(self, tick: Tick) -> None:
        """Mark the watchers for which a snapshot is due at this tick; it is made between the ticks."""
        self._age.tick()
        self._sessions.publish(tick)

    def _listen(self, admission: ClientAdmission, listener: socket.socket) -> "asyncio.Task[None]":
        task = asyncio.create_task(admission.accept_connections(listener))
        self._listening.add(task)
        task.add_done_callback(self._listening.discard)
        task.add_done_callback(lambda _: listener.close())  # also where it has not even begun
        return task

    async def _watch(self) -> None:
        try:
            await self._sessions.watch()
        except Exception as error:  # noqa: BLE001 - the service ends with it
            self._fail(error)
