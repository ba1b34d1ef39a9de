"""One client's connection: what was read and not served, what was answered and not taken, and since when."""

import asyncio
import contextlib
import math
import select
import socket
import struct
from collections import deque
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from twostage_servo.api.requests import Request
    from twostage_servo.service.request_age import RequestAge

_CREDENTIALS: Final = struct.Struct("3i")  # ucred of unix(7): process, user, group
_DISCARDED: Final = 4
"""Reads of 64 KiB that are thrown away at the end: with unread data the kernel would take back what was said last."""
_LOOKS_SHARE: Final = 0.1
"""Share of the age at which a command expires, after which it is worth a look whether there is nothing to be read."""
_CLOSED: Final = "this side has closed the connection"


class ConnectionClosedError(ConnectionError):
    """The connection has been closed on this side."""


class Connection:
    """A socket that never waits, with bounded buffers.

    Parameters
    ----------
    stream
        The connected socket.
    number
        Tells connections of one process apart.
    longest
        Bytes of the longest line.
    age
        Tells the time.
    empty_s
        Until when there was nothing to be read: the connection did not exist then.

    Attributes
    ----------
    descriptor
        Of its socket.
    peer
        Process and user at the other end, as the kernel tells them, and the number; empty before it is identified.
    arrived_after_s
        The newest bytes that were read came after this time, on the clock of `age`.
    ended
        The other side sends no more.
    closed
        This side has closed it.
    read_s
        When it was read the last time, on the loop's clock in s.
    busy
        In the middle of an answer.
    urgent
        A request that has been read, is not carried out yet, and must be.
    unsent
        Snapshots that it was not sent, because it did not read.
    """

    def __init__(self, stream: socket.socket, number: int, longest: int, age: "RequestAge", empty_s: float) -> None:
        self._stream = stream
        self._number = number
        self.descriptor = stream.fileno()  # the loop's own look at a socket costs more than this
        self._longest = longest
        self._age = age
        self._empty_s = self.arrived_after_s = empty_s
        self._incoming = bytearray()
        self._outgoing: deque[memoryview] = deque()
        self._broken = False
        self._readers: set[asyncio.Future[None]] = set()  # those who wait for something to read
        self._takers: set[asyncio.Future[None]] = set()  # those who wait until all is taken
        self.ended = self.closed = self.busy = False
        self.unsent = 0
        self.read_s = -math.inf
        self.urgent: Request | None = None
        self.peer = ""

    def identify(self) -> None:
        """Ask the kernel who is at the other end; one that leaves without a request is not worth it."""
        credentials = self._stream.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        process, user, _ = _CREDENTIALS.unpack(credentials)
        self.peer = f"pid {process} uid {user} #{self._number}"

    # Requests --------------------------------------------------------------------------------------------------------

    def begin_reading(self) -> None:
        """Note that it is read now."""
        self.read_s = asyncio.get_running_loop().time()

    def hold_urgent(self, request: "Request") -> None:
        """Keep a request that must be carried out, even if this connection has to end."""
        self.urgent = request

    def release_urgent(self) -> None:
        """Note that such a request, if there was one, is carried out now."""
        self.urgent = None

    def begin_answer(self) -> None:
        """Note that an answer has begun."""
        self.busy = True

    def end_answer(self) -> None:
        """Note that the answer is whole."""
        self.busy = False

    # Reading ---------------------------------------------------------------------------------------------------------

    @property
    def has_line(self) -> bool:
        """Whether a line can be taken; one that is too long, or is cut off by the end, counts as one."""
        return b"\n" in self._incoming or self.too_long or (self.ended and bool(self._incoming))

    @property
    def too_long(self) -> bool:
        """Whether the next line is longer than it may be."""
        return len(self._incoming) > self._longest and b"\n" not in self._incoming[: self._longest]

    def pop_line(self) -> bytes:
        """Return the next line, and forget it."""
        line, _, rest = self._incoming.partition(b"\n")
        self._incoming = rest
        return bytes(line)

    def next_line_names(self, words: tuple[bytes, ...], longest: int) -> bool:
        """Return whether the next line is no longer than so many bytes, and has one of these words in it."""
        end = self._incoming.find(b"\n", 0, longest)
        end = len(self._incoming) if end < 0 else end
        return end < longest and any(self._incoming.find(word, 0, end) >= 0 for word in words)

    def drop_lines_without(self, words: tuple[bytes, ...]) -> bool:
        """Forget the lines before the first that has one of these words in it; return whether there is none such."""
        places = [place for word in words if (place := self._incoming.find(word)) >= 0]
        if not places and self.ended:
            self._incoming.clear()
        else:
            del self._incoming[: self._incoming.rfind(b"\n", 0, min(places, default=len(self._incoming))) + 1]
        return not places

    def was_empty(self, at_s: float) -> None:
        """Record that nothing could be read from it at a time, s."""
        self._empty_s = max(self._empty_s, at_s)

    def end(self) -> None:
        """Read no more from it, and forget what was read."""
        self._incoming.clear()
        self.ended = True

    def receive(self) -> None:
        """Read what there is, up to one line of the greatest length; never waits."""
        now_s = self._age.now_s()
        wanted = self._longest + 1 - len(self._incoming)
        try:
            data = self._stream.recv(wanted)
        except BlockingIOError:
            self._empty_s = now_s
            return
        except OSError:
            self._broken = self.ended = True
            for future in self._readers:
                wake(future)
            return
        self._incoming += data
        self.arrived_after_s = self._empty_s
        if len(data) < wanted:
            self._empty_s = now_s
        self.ended = not data
        for future in self._readers:  # where it was not they who read
            wake(future)

    def probe(self) -> None:
        """Record that there is nothing to read, if so; for use in the middle of an answer, when nobody waits for more.

        An answer may take long, and a client that has had it asks for the next thing at once: that has not waited for
        as long as the answer took.
        """
        now_s = self._age.now_s()
        if now_s - self._empty_s < _LOOKS_SHARE * self._age.longest_s or self.closed or self._broken:
            return
        try:
            self._stream.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            self._empty_s = now_s
        except OSError:
            return  # which shows when it is read

    async def readable(self) -> None:
        """Wait until there is something to read, or the end.

        Raises
        ------
        ConnectionClosedError
            If this side closes it meanwhile.
        """
        if self.closed:
            raise ConnectionClosedError(_CLOSED)
        loop, watched_since_s = asyncio.get_running_loop(), self._age.now_s()
        future = loop.create_future()
        loop.add_reader(self.descriptor, wake, future)
        try:
            await _among(self._readers, future)
        finally:
            if not self.closed:
                loop.remove_reader(self.descriptor)
        empty_until_s = self._age.was_empty_until_s(watched_since_s)
        if empty_until_s is not None:
            self._empty_s = max(self._empty_s, empty_until_s)

    @property
    def gone(self) -> bool:
        """Whether nobody is there any more: the other side has closed both directions."""
        if self._broken or self.closed:
            return True
        hangup = select.poll()
        hangup.register(self.descriptor, 0)  # POLLHUP and POLLERR come unasked
        return bool(hangup.poll(0))

    # Writing ---------------------------------------------------------------------------------------------------------

    @property
    def has_unsent(self) -> bool:
        """Whether some of what was written is not taken yet."""
        return bool(self._outgoing)

    def write(self, data: bytes) -> None:
        """Send what the other side takes, keep the rest; what is written to nobody is lost."""
        if not data or self.closed or self._broken:
            return
        self._outgoing.append(memoryview(data))
        if len(self._outgoing) == 1:
            self._flush()

    def send_snapshot(self, line: bytes) -> bool:
        """Send a snapshot, unless something older still waits to be taken; return whether it was sent."""
        if self._outgoing or self.closed or self._broken:
            self.unsent += 1
            return False
        self.write(line)
        return True

    async def flushed(self) -> None:
        """Wait until the other side has read all that was written, or has gone.

        Raises
        ------
        ConnectionClosedError
            If this side closes it meanwhile.
        """
        while self._outgoing and not self._broken:
            await _among(self._takers, asyncio.get_running_loop().create_future())

    def close(self) -> None:
        """Close it at once; what was not taken is lost."""
        if self.closed:
            return
        self.closed = True
        loop = asyncio.get_running_loop()
        loop.remove_reader(self.descriptor)
        loop.remove_writer(self.descriptor)
        self._outgoing.clear()
        for future in self._readers | self._takers:
            if not future.done():
                future.set_exception(ConnectionClosedError(_CLOSED))
        with contextlib.suppress(OSError):  # nothing is left, or nobody is there
            for _ in range(_DISCARDED):
                if not self._stream.recv(65_536):
                    break
        self._stream.close()

    # Small parts -----------------------------------------------------------------------------------------------------

    def _flush(self) -> None:
        """Send what is taken now; go on as soon as more is."""
        while self._outgoing:
            data = self._outgoing[0]
            try:
                sent = self._stream.send(data)
            except BlockingIOError:
                asyncio.get_running_loop().add_writer(self.descriptor, self._flush)
                return
            except OSError:
                self._broken = True
                self._outgoing.clear()
                break
            if sent < len(data):
                self._outgoing[0] = data[sent:]
            else:
                self._outgoing.popleft()
        asyncio.get_running_loop().remove_writer(self.descriptor)
        for future in self._takers:
            wake(future)


async def _among(waiting: "set[asyncio.Future[None]]", future: "asyncio.Future[None]") -> None:
    waiting.add(future)
    try:
        await future
    finally:
        waiting.discard(future)


def wake(future: "asyncio.Future[None]") -> None:
    """Let whoever waits for a future go on, unless he goes on already."""
    if not future.done():
        future.set_result(None)
