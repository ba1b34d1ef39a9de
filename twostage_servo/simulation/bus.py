"""A CAN bus inside one process and in simulated time: no thread, no waiting, and every fault of a bus on demand."""

import copy
import errno
import heapq
import math
import os
from collections.abc import Callable, Iterable
from typing import Final, TypeAlias

import can

Disturbance: TypeAlias = Callable[[str, can.Message, float], Iterable[tuple[float, can.Message]]]
"""``disturb(sender, message, now in s)`` gives what arrives of a frame: pairs of delay in s and message."""

_QUEUE_LENGTH: Final = 1024
"""Of each node, unless it is told another; the frames of 50 ms on a classic bus at 1 Mbit/s."""
_ROUNDING_S: Final = 1e-9
"""A frame whose delay ends just now has arrived, whatever the sum of the two rounds to."""


class Wire:
    """The wire that joins the nodes. Frames take no time but the delay of the disturbance.

    Parameters
    ----------
    clock : callable
        Gives the present time, s; it stamps the frames. For instance ``loop.time`` of a simulated clock.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self.clock = clock
        self._disturbance: Disturbance | None = None
        self._nodes: dict[str, WireNode] = {}

    def disturb(self, disturbance: Disturbance) -> None:
        """Let a function decide what arrives of each frame that a node sends, in place of the one before.

        Parameters
        ----------
        disturbance : callable
            See :data:`Disturbance`. It gives nothing (lost), two pairs (doubled), a delay (late, and behind later
            frames), or another message (damaged). It may change the message that it is given.
        """
        self._disturbance = disturbance

    def restore(self) -> None:
        """Let each frame arrive at once, as without a disturbance."""
        self._disturbance = None

    def clock_was_set(self, by_s: float) -> None:
        """Let frames on their way arrive when they would have, now that the clock shows so many s more.

        Their stamps are those of before.
        """
        for node in self._nodes.values():
            node.delay(by_s)

    def node(self, name: str) -> "WireNode":
        """Return the node of this name, which outlives the buses that are attached at it; made when it is new."""
        if name not in self._nodes:
            self._nodes[name] = WireNode(self)
        return self._nodes[name]

    def attach(self, name: str) -> "WireBus":
        """Open a bus at a node, with an empty queue.

        Raises
        ------
        OSError
            ENETDOWN when the node is down, EBUSY when it has an open bus already.
        """
        node = self.node(name)
        if node.down:
            raise OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))
        if node.is_attached:
            raise OSError(errno.EBUSY, f"{os.strerror(errno.EBUSY)}: node {name} has an open bus")
        return WireBus(self, name)

    def transmit(self, sender: str, message: can.Message) -> None:
        """Bring a frame to all nodes but its sender, as the disturbance wills.

        Each of them makes its own copy when it receives it: listening nodes cost the sender next to nothing.
        """
        now_s = self.clock()
        disturb = self._disturbance
        arrivals = [(0.0, message)] if disturb is None else disturb(sender, _copy(message), now_s)
        for delay_s, frame in arrivals:
            arriving = _arriving(frame, now_s + delay_s)
            for name, node in self._nodes.items():
                if name != sender:
                    node.enqueue(arriving)


class WireNode:
    """A node's place on the wire: its receive queue, and its faults.

    Attributes
    ----------
    send_error, receive_error : BaseException or None
        Raised by each ``send`` and each ``recv`` of the node's bus.
    is_attached : bool
        Whether a bus is open at this node.
    dropped : int
        Oldest frames lost because nobody read them and the queue was full.
    queue_length : int
        Frames that wait to be read at most.
    """

    def __init__(self, wire: Wire) -> None:
        self.send_error: BaseException | None = None
        self.receive_error: BaseException | None = None
        self.is_attached = False
        self.dropped = 0
        self.queue_length = _QUEUE_LENGTH
        self._listeners: list[Callable[[], None]] = []
        self._wire = wire
        self._down = False
        self._queue: list[tuple[float, int, can.Message]] = []  # a heap: (time of arrival, number, message)
        self._frames_queued = 0

    @property
    def down(self) -> bool:
        """Whether the interface is down: no bus can be attached, an open one fails, and what arrives is lost."""
        return self._down

    def take_down(self) -> None:
        """Take the interface down; what waits to be read is lost."""
        self._down = True
        self._queue.clear()

    def bring_up(self) -> None:
        """Bring the interface up again, with an empty queue."""
        self._down = False
        self._queue.clear()

    def fail_to_send(self, error: BaseException | None) -> None:
        """Raise an error at each ``send`` of the node's bus; None: send again."""
        self.send_error = error

    def fail_to_receive(self, error: BaseException | None) -> None:
        """Raise an error at each ``recv`` of the node's bus; None: receive again."""
        self.receive_error = error

    def set_queue_length(self, frames: int) -> None:
        """Let so many frames wait to be read at most, from the next one on."""
        self.queue_length = frames

    def listen(self, listener: Callable[[], None]) -> None:
        """Call a listener for each frame that is on its way to this node, from now on."""
        self._listeners.append(listener)

    def inject(self, message: can.Message) -> None:
        """Let a frame of any kind arrive at this node alone, now: an error frame, a foreign command, babble."""
        self.enqueue(_arriving(message, self._wire.clock()))

    def enqueue(self, arriving: can.Message) -> None:
        """Let a frame, which other nodes may share, arrive at the time of its stamp; lost when nobody can take it."""
        if self._down or not self.is_attached:
            return
        self._frames_queued += 1
        heapq.heappush(self._queue, (arriving.timestamp, self._frames_queued, arriving))
        if len(self._queue) > self.queue_length:
            heapq.heappop(self._queue)
            self.dropped += 1
        for listener in self._listeners:
            listener()

    def delay(self, by_s: float) -> None:
        """Let all frames on their way arrive so many s later by the clock; their stamps stay."""
        self._queue = [(arrival_s + by_s, number, message) for arrival_s, number, message in self._queue]

    @property
    def next_arrival_s(self) -> float:
        """When the next frame arrives, or has arrived, s; infinity when none is on its way."""
        return self._queue[0][0] if self._queue else math.inf

    def next_arrived(self) -> can.Message | None:
        """Remove the frame that arrived first and return a copy; None when none has arrived."""
        if self._queue and self._queue[0][0] <= self._wire.clock() + _ROUNDING_S:
            return _copy(heapq.heappop(self._queue)[2])
        return None

    def attached(self, is_attached: bool) -> None:
        """Note that a bus was opened or closed."""
        self.is_attached = is_attached
        self._queue.clear()


class WireBus(can.BusABC):
    """One node's bus, in the manner of python-can. Made by :meth:`Wire.attach`.

    Attributes
    ----------
    clock : callable
        The clock that stamps the frames, s.
    """

    def __init__(self, wire: Wire, name: str) -> None:
        self.clock = wire.clock
        self.channel_info = f"node {name} of a simulated bus"
        self._wire = wire
        self._name = name
        self._node = wire.node(name)
        self._node.attached(True)
        super().__init__(channel=name)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if timeout != 0:
            raise ValueError(f"recv({timeout}) on a simulated bus: time stands still while it waits, use recv(0)")
        self._check(self._node.receive_error)
        return self._node.next_arrived(), False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 - never waits
        """Bring a frame to all other nodes.

        Raises
        ------
        can.CanOperationError
            When the bus is closed, or its node is down.
        """
        self._check(self._node.send_error)
        self._wire.transmit(self._name, msg)

    def _check(self, error: BaseException | None) -> None:
        if self._is_shutdown:
            raise can.CanOperationError("the bus is closed", errno.EBADF)
        if self._node.down:
            raise can.CanOperationError(os.strerror(errno.ENETDOWN), errno.ENETDOWN)
        if error is not None:
            raise error

    def shutdown(self) -> None:
        """Leave the wire."""
        if not self._is_shutdown:
            self._node.attached(False)
        super().shutdown()


def _arriving(message: can.Message, arrival_s: float) -> can.Message:
    """Return a frame as it arrives at a time, which is its time stamp."""
    arriving = _copy(message)
    arriving.timestamp = arrival_s
    arriving.is_rx = True
    return arriving


def _copy(message: can.Message) -> can.Message:
    copied = copy.copy(message)
    copied.data = bytearray(message.data)  # python-can's copy shares them
    return copied
