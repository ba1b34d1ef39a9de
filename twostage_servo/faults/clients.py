"""The clients of the running service in simulated time: those who keep to the protocol, and those who do not."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twostage_servo.api.request_reading import parse_request, read_request
from twostage_servo.api.requests import AxisRequest, BadRequestError
from twostage_servo.app.closed_loop import ClosedLoop
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.client.async_connection import AsyncConnection

if TYPE_CHECKING:
    from twostage_servo.service.control_socket import ControlSocket

OPERATOR = "operator"
"""The client who commands the axis."""

_LONGEST_ANSWER_S = 30.0
"""How long an answer may take, in simulated time: longer than anything that holds the service up."""


class Clients:
    """Those who ask something of the service, by its control socket or without it.

    Parameters
    ----------
    loop
        The service.
    axis_name
        The axis that they ask something of.
    folder
        Gives the folder of the control socket, which is made when it is first asked for.
    """

    def __init__(self, loop: ClosedLoop, axis_name: str, folder: Callable[[], Path]) -> None:
        self._loop = loop
        self._axis_name = axis_name
        self._folder = folder
        self._tasks: set[asyncio.Task[None]] = set()
        self._socket: ControlSocket | None = None

    @property
    def socket_path(self) -> Path:
        """The path of the control socket."""
        return self._folder() / "control.sock"

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Let a client work beside the service, until it is done or :meth:`close` ends it."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    @asynccontextmanager
    async def connect(self) -> AsyncIterator[AsyncConnection]:
        """Connect to the service's control socket as a client that keeps to the protocol.

        Raises
        ------
        ServoError
            If no service answers there.
        """
        await self._serve()
        connection = AsyncConnection(self.socket_path, _LONGEST_ANSWER_S)
        await connection.open(_LONGEST_ANSWER_S)
        try:
            yield connection
        finally:
            connection.close()

    @asynccontextmanager
    async def open_socket(self) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
        """Open a socket to the service for one who sends what no client of ours does, or does not read."""
        await self._serve()
        reader, writer = await asyncio.open_unix_connection(str(self.socket_path), limit=1 << 20)
        try:
            yield reader, writer
        finally:
            writer.close()

    async def _serve(self) -> None:
        """Serve the control socket, from the first client on."""
        if self._socket is None:
            self._socket = self._loop.control_socket(self.socket_path)
            await self._socket.start()

    def ask(self, request: str | dict[str, Any], client: str = OPERATOR) -> str | None:
        """Make a request of a client; return the code with which it is refused, or None if it was carried out.

        Where there are several axes, what is asked of an axis is asked of the one that these clients are for.
        """
        line = request if isinstance(request, str) else json.dumps(request)
        try:
            asked = parse_request(line.encode())
            if len(self._loop.axes) > 1 and isinstance(asked, AxisRequest):
                asked = read_request(asked.to_json() | {"axis": self._axis_name})
            self._loop.requests.handle(asked, client)
        except BadRequestError:
            return RefusalCode.BAD_REQUEST
        except Refused as refused:
            return refused.code
        return None

    async def close(self) -> None:
        """End the clients, and the control socket after them."""
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._socket is not None:
            await self._socket.stop()
