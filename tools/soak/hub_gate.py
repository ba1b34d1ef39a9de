"""A gate between the service and the hub of its bus: open, shut, or as if the hub greeted slowly, or never."""

import asyncio
import contextlib
import enum
from typing import Final

_LONGEST_READ: Final = 65_536
_SLOW_BYTES: Final = 32
"""Of a greeting that is slow."""


class Mode(enum.Enum):
    """What a connection through the gate finds."""

    OPEN = "open"
    SHUT = "shut"
    """Nobody listens, and what was connected is cut off."""
    SLOW = "slow"
    """The first bytes come one by one."""
    SILENT = "silent"
    """Connections are taken, and nothing ever comes."""


class HubGate:
    """A gate on the loopback address.

    Parameters
    ----------
    hub_port
        TCP port of the hub behind it.
    """

    def __init__(self, hub_port: int) -> None:
        self.port = 0
        self.mode = Mode.OPEN
        self.slow_pause_s = 0.3
        self._hub_port = hub_port
        self._server: asyncio.Server | None = None
        self._passing: set[asyncio.Task[None]] = set()

    async def set_mode(self, mode: Mode) -> None:
        """Let connections find something else from now on; those that are there are cut off."""
        self.mode = mode
        for task in list(self._passing):
            task.cancel()
        await asyncio.gather(*self._passing, return_exceptions=True)
        if mode is Mode.SHUT:
            await self.close()
        elif self._server is None:
            self._server = await asyncio.start_server(self._pass, "127.0.0.1", self.port)
            self.port = self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """Listen no more."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
            await server.wait_closed()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is not None:
            self._passing.add(task)
        mode = self.mode
        try:
            if mode is Mode.SILENT:
                while await reader.read(_LONGEST_READ):
                    pass
                return
            there, back = await asyncio.open_connection("127.0.0.1", self._hub_port)
            try:
                slow = _SLOW_BYTES if mode is Mode.SLOW else 0
                both = [self._copy(there, writer, slow), self._copy(reader, back, 0)]
                await asyncio.wait([asyncio.ensure_future(one) for one in both], return_when=asyncio.FIRST_COMPLETED)
            finally:
                back.transport.abort()
        except (OSError, asyncio.CancelledError):
            pass  # the hub is not there, or the gate has changed
        finally:
            if task is not None:
                self._passing.discard(task)
            writer.transport.abort()

    async def _copy(self, source: asyncio.StreamReader, target: asyncio.StreamWriter, slow: int) -> None:
        with contextlib.suppress(OSError):
            while data := await source.read(1 if slow > 0 else _LONGEST_READ):
                if slow > 0:
                    slow -= len(data)
                    await asyncio.sleep(self.slow_pause_s)
                target.write(data)
                await target.drain()
