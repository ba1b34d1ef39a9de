"""The control socket: a Unix socket on which each line is a JSON request and each answer a JSON line.

Whoever may open the socket may command the axis: its folder and file permissions decide. A client that does not read is
sent no more snapshots until it does; nothing here ever makes a tick wait. Nor do idle clients keep anybody from `stop`:
when there are too many, the one that has been idle the longest makes room.
"""

import asyncio
import contextlib
import itertools
import json
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import structlog
from pydantic import ValidationError

from twostage_servo.axis.messages import Refused
from twostage_servo.service.requests import READING, REQUESTS, JogRequest, WatchRequest
from twostage_servo.service.snapshot import ready_for_json, report_service
from twostage_servo.service.socket_file import SocketFile, SocketInUseError
from twostage_servo.service.turns import Rank

if TYPE_CHECKING:
    from twostage_servo.service.loop import ServoService

__all__ = ["ControlSocket", "SocketInUseError", "encode", "encode_in_pieces"]

Answer = dict[str, Any]

_LONGEST_LINE = 65_536
_MOST_CLIENTS = 64
_MOST_UNREAD = 262_144
_RECORDS_A_PIECE = 50
_PAUSE_S = 1.0
"""After a client that could not be let in."""
_TOO_MANY = (
    f"{_MOST_CLIENTS} clients are the most, and this one was idle the longest. Connect again; "
    "`ss -xp` shows which processes hold the others"
)
_URGENT = (b'"stop"', b'"disarm"')
"""What makes a line urgent, whatever else it says: it is looked for before the line has been read as JSON."""


class ControlSocket:
    """Serves requests and streams snapshots.

    Parameters
    ----------
    path
        Path of the socket.
    service
        What the requests are for; it says when they may be served.
    """

    def __init__(self, path: Path, service: "ServoService") -> None:
        self.path = path
        self._service = service
        self._connections = itertools.count(1)
        self._moments = itertools.count()
        self._file = SocketFile(path, _MOST_CLIENTS)
        self._keeping: asyncio.Task[None] | None = None
        self._listening: set[asyncio.Task[None]] = set()
        self._clients: set[_Client] = set()
        self._serving: set[asyncio.Task[None]] = set()
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
        turns = self._service.turns
        keeping = self._file.keep(lambda: turns.turn(Rank.CONNECTION), self._listen, listening, listener)
        self._keeping = asyncio.create_task(keeping)

    async def stop(self) -> None:
        """Stop listening, end all connections, remove the socket."""
        self._file.remove()
        for task in (working := [*self._listening, self._keeping]):
            if task is not None:
                task.cancel()
        await asyncio.gather(*filter(None, working), return_exceptions=True)
        for client in list(self._clients):
            client.abort()
        await asyncio.gather(*self._serving, return_exceptions=True)
        self._keeping = None

    def _listen(self, listener: socket.socket) -> "asyncio.Task[None]":
        task = asyncio.create_task(self._accept(listener))
        self._listening.add(task)
        task.add_done_callback(self._listening.discard)
        task.add_done_callback(lambda _: listener.close())  # also where it has not even begun
        return task

    def publish(self, tick: int) -> None:
        """Send a snapshot to the watchers for which one is due; make it only if there are any."""
        lines: dict[str | None, bytes] = {}
        common: Answer | None = None
        for client in list(self._clients):
            if client.every and tick >= client.due and not client.busy:
                client.due = tick + client.every
                if client.axis not in lines:
                    common = report_service(self._service) if common is None else common
                    lines[client.axis] = encode({"event": "snapshot", **self._service.snapshot(client.axis, common)})
                if client.send_unless_behind(lines[client.axis]):
                    client.active = next(self._moments)

    async def _accept(self, listener: socket.socket) -> None:
        """Let clients in, each in a turn of its own; the kernel keeps the others waiting.

        An asyncio server lets them in as they come: a client that does nothing but connect then has the service busy
        all of the time, and with a real-time priority whatever else should run on that core waits.
        """
        with listener:
            while True:
                try:
                    streams = await self._let_in(listener)
                except Exception as error:  # noqa: BLE001 - no descriptor is left, or a defect: nobody is shut out for good
                    self._log.warning("no client can be let in", error=repr(error), retry_s=_PAUSE_S)
                    await asyncio.sleep(_PAUSE_S)
                else:
                    task = asyncio.create_task(self._serve(*streams))
                    self._serving.add(task)
                    task.add_done_callback(self._serving.discard)

    async def _let_in(self, listener: socket.socket) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        connection, _ = await asyncio.get_running_loop().sock_accept(listener)
        try:
            async with self._service.turns.turn(Rank.CONNECTION):
                return await asyncio.open_unix_connection(sock=connection, limit=_LONGEST_LINE)
        except BaseException:
            connection.close()
            raise

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._clients) >= _MOST_CLIENTS:
            self._make_room()
        client = _Client(writer, next(self._connections))
        client.active = next(self._moments)
        self._clients.add(client)
        try:
            while line := await self._read_line(client, reader):
                client.active = next(self._moments)
                urgent = any(word in line for word in _URGENT)
                # A turn for each request, and for each piece of a long answer: a tick may come between.
                async with self._service.turns.turn(Rank.URGENT if urgent else Rank.REQUEST):
                    if client not in self._clients and not urgent:
                        break  # it has been told that its connection ends, and must not set an axis moving after that
                    answer = self._answer(client, line)
                    pieces = encode_in_pieces(answer)
                    client.busy = True
                    client.send(next(pieces))
                await self._let_others_go(writer)
                is_long = "records" in answer
                while is_long:
                    async with self._service.turns.turn(Rank.REQUEST):
                        is_long = bool(piece := next(pieces, b""))
                        client.send(piece)
                    await self._let_others_go(writer)
                client.busy = False
        except ConnectionError as error:
            self._log.info("client lost", peer=client.peer, error=str(error))
        except Exception as error:  # noqa: BLE001 - a defect in one answer ends this connection, and nothing else
            self._log.error("a client could not be served", peer=client.peer, exc_info=error)
        finally:
            self._clients.discard(client)
            self._service.desk.leave(client.peer)
            client.close()
            with contextlib.suppress(OSError):  # the other side may be gone already, which ends it as well
                await writer.wait_closed()

    def _make_room(self) -> None:
        """End the connection that has been idle the longest, but not that of the client which commands.

        A watcher that takes its snapshots is not idle. One in the middle of a long answer goes last.
        """
        holder = self._service.desk.lease.holder
        client = min((one for one in self._clients if one.peer != holder), key=lambda one: (one.busy, one.active))
        self._log.warning("a client had to make room", peer=client.peer, clients=len(self._clients))
        self._clients.discard(client)
        client.end(encode(_failure("too_many_clients", _TOO_MANY)))

    @staticmethod
    async def _let_others_go(writer: asyncio.StreamWriter) -> None:
        """Wait until the client has read most of what it was sent, and for a pass of the loop in any case."""
        await writer.drain()
        await asyncio.sleep(0)

    async def _read_line(self, client: "_Client", reader: asyncio.StreamReader) -> bytes:
        """Return the next line; nothing at the end of the connection, or where it must end."""
        try:
            return await reader.readline()
        except ValueError:  # asyncio's answer to a line beyond the limit
            client.send(encode(_failure("bad_request", f"a request must fit in {_LONGEST_LINE} bytes")))
            return b""

    def _answer(self, client: "_Client", line: bytes) -> Answer:
        try:
            request = REQUESTS.validate_json(line)
        except ValidationError as error:
            return _failure("bad_request", _explain(error))
        except RecursionError:
            return _failure("bad_request", "the request is nested too deeply")
        if not isinstance(request, (*READING, JogRequest)):  # a jog is asked for several times a second
            self._log.info("request", peer=client.peer, **request.model_dump(exclude_none=True))
        try:
            answer = self._service.handle(request, client.peer)
        except Refused as error:
            self._log.warning("refused", peer=client.peer, op=request.op, code=error.code, reason=str(error))
            return _failure(error.code, str(error))
        if isinstance(request, WatchRequest):
            client.every, client.axis = request.every, request.axis
        return {"ok": True, **answer}


class _Client:
    """One connection, with who it is and what it watches."""

    def __init__(self, writer: asyncio.StreamWriter, number: int) -> None:
        self._writer = writer
        self.every = 0
        self.axis: str | None = None
        self.active = 0
        self.due = 0
        self.unsent = 0
        self.busy = False
        credentials = writer.get_extra_info("socket").getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        process, user, _ = struct.unpack("3i", credentials)
        self.peer = f"pid {process} uid {user} #{number}"

    def send(self, data: bytes) -> None:
        if not self._writer.is_closing():
            self._writer.write(data)

    def send_unless_behind(self, line: bytes) -> bool:
        if self._writer.is_closing():
            return False
        if self._writer.transport.get_write_buffer_size() > _MOST_UNREAD:
            self.unsent += 1
            return False
        self._writer.write(line)
        return True

    def close(self) -> None:
        self._writer.close()

    def abort(self) -> None:
        self._writer.transport.abort()

    def end(self, line: bytes) -> None:
        """Say a last line and close, if that can be done without waiting for the client; else cut it off."""
        if self.busy or self._writer.transport.get_write_buffer_size():
            self.abort()
            return
        self.send(line)
        if self._writer.transport.get_write_buffer_size():
            self.abort()
        else:
            self.close()


def encode(answer: Answer) -> bytes:
    """Return an answer as a JSON line; NaN and infinity never leave."""
    return json.dumps(answer, allow_nan=False, separators=(",", ":")).encode() + b"\n"


def encode_in_pieces(answer: Answer) -> Iterator[bytes]:
    """Yield the same line in pieces of less than a millisecond's work each: a recording may hold thousands of ticks."""
    if "records" not in answer:
        yield encode(answer)
        return
    records = answer["records"]
    head = {key: value for key, value in answer.items() if key != "records"}
    yield encode(head).removesuffix(b"}\n") + b',"records":['
    for start in range(0, len(records), _RECORDS_A_PIECE):
        piece = [ready_for_json(record) for record in records[start : start + _RECORDS_A_PIECE]]
        yield (b"," if start else b"") + encode({"": piece})[5:-3]
    yield b"]}\n"


def _failure(code: str, message: str) -> Answer:
    return {"ok": False, "error": {"code": code, "message": message}}


def _explain(error: ValidationError) -> str:
    parts = []
    for detail in error.errors(include_url=False, include_context=False)[:5]:
        place = ".".join(str(part) for part in detail["loc"])
        parts.append(f"{place}: {detail['msg']}" if place else detail["msg"])
    return "; ".join(parts)
