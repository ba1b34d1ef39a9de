"""One asynchronous connection to a service: the protocol on a socket that the event loop reads."""

import asyncio
import contextlib
import socket
from collections.abc import AsyncGenerator
from pathlib import Path

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.requests import Request, WatchRequest
from twostage_servo.api.status import Status
from twostage_servo.client.connection import AT_ONCE, connected
from twostage_servo.client.protocol import Protocol, checked, longest_wait_s, status_in


class AsyncConnection:
    """A connection, over which one task at a time asks.

    Parameters
    ----------
    path
        Path of the control socket.
    timeout_s
        Longest wait for the connection, and for an answer.
    """

    def __init__(self, path: Path, timeout_s: float) -> None:
        self.path = path
        self._timeout_s = timeout_s
        self._lock = asyncio.Lock()
        self._socket: socket.socket | None = None
        self._protocol = Protocol(path)

    async def open(self, within_s: float) -> None:
        """Connect within a time (s).

        Raises
        ------
        ServoError
            If nobody answers there, or who does is not to be trusted.
        """
        self.close()
        try:
            stream = connected(self.path, within_s, wait=False)
        except BlockingIOError:  # others are waiting: wait among them, which only the kernel can, in a thread
            stream = await asyncio.to_thread(connected, self.path, within_s)
        stream.setblocking(False)
        self._socket, self._protocol = stream, Protocol(self.path)

    async def reconnect(self, within_s: float) -> None:
        """Connect anew within a time (s)."""
        async with self._lock:
            await self.open(within_s)

    def close(self) -> None:
        """End the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    async def ask(self, request: Request, patience_s: float | None = None) -> JsonObject:
        """Send a request and return its answer.

        Raises
        ------
        ServoError
            If it is refused, or the service does not answer in time.
        """
        async with self._lock:
            number, line = self._protocol.send(request)
            try:
                async with asyncio.timeout(self._timeout_s if patience_s is None else patience_s):
                    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                        await asyncio.get_running_loop().sock_sendall(self._opened, line)
                    while (answer := self._protocol.answer_to(number)) is None:
                        await self._receive()
            except TimeoutError as error:
                raise self._protocol.silent() from error
            except OSError as error:
                raise self._protocol.lost(error) from error
            return answer

    async def snapshots(self, watch: WatchRequest) -> AsyncGenerator[Status, None]:
        """Yield a snapshot every so many ticks."""
        await self.ask(watch)
        while True:
            while not (kept := self._protocol.snapshots):
                try:
                    async with asyncio.timeout(longest_wait_s(self._timeout_s, watch)):
                        await self._receive()
                except TimeoutError as error:
                    raise self._protocol.silent() from error
                except OSError as error:
                    raise self._protocol.lost(error) from error
            yield status_in(checked(kept.popleft()), self.path)

    @property
    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise ConnectionResetError("it was closed")
        return self._socket

    async def _receive(self) -> None:
        self._protocol.receive(await asyncio.get_running_loop().sock_recv(self._opened, AT_ONCE))
