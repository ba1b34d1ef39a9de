"""One opened bus: a python-can interface that never waits, never keeps an old command and fails in one way only."""

import functools
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Final

import can

from twostage_servo.canbus import error_frames
from twostage_servo.canbus.bus_opening import BusOpening, OpeningAttempt
from twostage_servo.canbus.bus_settings import BusSettings
from twostage_servo.canbus.error_frames import ControllerState
from twostage_servo.canbus.frame_age import FrameAge, stamp_clock
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.canbus.link_counters import LinkCounters
from twostage_servo.canbus.link_error import LinkError, is_full, link_error
from twostage_servo.canbus.open_interface import open_interface
from twostage_servo.canbus.socketcand import SocketcandBus

if TYPE_CHECKING:
    import asyncio

    from twostage_servo.canbus.network_interface import NetworkInterface

__all__ = ["BusSettings", "ControllerState", "Link", "LinkCounters", "LinkError"]

_USUAL_TICK_S: Final = 0.01


class Link:
    """A bus that one party opens for itself.

    Not for concurrent calls; :meth:`open` may run in another thread while nothing else is called.

    Parameters
    ----------
    settings
        The bus.
    accepted
        Identifiers to receive. Frames with the same number of the other kind (11 or 29 bits) come through as well, so
        that they can be rejected and counted.
    opener
        Makes the bus, in place of python-can's interface that the settings name; they go on naming it in texts, and
        say what its error frames mean.

    Attributes
    ----------
    settings : BusSettings
        As given.
    counters : LinkCounters
        What went over the link.
    controller_state : {"active", "warning", "passive"}
        What the controller's latest error frame says; "active" from each opening on. Stays so where the interface hands
        on no error frames with their data: all but socketcan.
    is_behind : bool
        Whether the drain before the latest ended at its bound and left frames behind. What the latest one returned has
        then waited for an unknown time. What comes behind a drain that found no more is newer than that drain.
    error_counters : tuple of two int, or None
        The controller's counters of transmit and of receive errors, as its latest error frame tells them: it is passive
        from 128 on, and bus-off from 256 transmit errors. None where none has told them since the bus was opened.
    """

    def __init__(
        self,
        settings: BusSettings,
        accepted: Iterable[Identifier],
        opener: Callable[[], can.BusABC] | None = None,
    ) -> None:
        self.settings = settings
        self.counters = LinkCounters()
        self.controller_state: ControllerState = "active"
        self.error_counters: tuple[int, int] | None = None
        self.is_behind = False
        self._has_left_some = False
        self._interface: NetworkInterface | None = None
        self._is_sending = False
        self._overflowed = 0
        self._age: FrameAge | None = None
        self._most = settings.frames_read(_USUAL_TICK_S)
        self._accepted = frozenset(identifier.identifier for identifier in accepted)
        self._opening = BusOpening(settings, opener or functools.partial(open_interface, settings, self._accepted))
        self._bus: can.BusABC | None = None

    @property
    def is_open(self) -> bool:
        """Whether the bus is open."""
        return self._bus is not None

    def open(self) -> None:
        """Open the bus. May block for a second or more; does nothing when it is open already.

        Raises
        ------
        LinkError
            When it cannot be opened.
        """
        if self._bus is not None:
            return
        bus, interface = self._opening.open()
        self.controller_state = "active"
        self.error_counters = None
        self._interface = interface
        self._is_sending = False
        self.is_behind = self._has_left_some = False
        self._overflowed = 0
        clock = stamp_clock(bus, self.settings.interface)
        self._age = FrameAge(*clock) if clock else None
        self._bus = bus

    async def open_in_thread(self) -> None:
        """Open the bus without holding up the running loop. Does nothing when it is open already.

        An attempt that is cancelled is given up at once, since an interface of python-can may take minutes: what comes
        of it is shut down by the thread.

        Raises
        ------
        LinkError
            When it cannot be opened.
        """
        await self._opening.open_in_thread(OpeningAttempt(self.open, self.close))

    def close(self) -> None:
        """Close the bus. Never raises, and does nothing when it is closed already."""
        bus, self._bus, self._interface = self._bus, None, None
        if bus is not None:
            self._opening.shut_down(bus)

    def close_in_thread(self) -> "asyncio.Future[None] | None":
        """Give up the bus, for a running loop that must not wait: an interface of python-can may block in its shutdown.

        Returns
        -------
        asyncio.Future or None
            Done when the thread has shut the bus down; None when that is done already. An opening comes after it.
        """
        bus, self._bus, self._interface = self._bus, None, None
        return None if bus is None else self._opening.shut_down_in_thread(bus)

    def check(self) -> None:
        """See whether the bus can still carry frames, and count what the kernel has thrown away; for now and then.

        Without it, an interface that loses its carrier (bus-off) while no error frame comes through would take every
        command and send none. Does nothing with other interfaces than SocketCAN.

        Raises
        ------
        LinkError
            When the bus is not open, or its interface is gone, down or bus-off.
        """
        self._opened()
        if self._interface is None:
            return
        try:
            self._interface.check()
            overflowed = self._interface.overflowed()
        except OSError as error:
            raise self._error("failed", error) from error
        self.counters.overflowed += overflowed - self._overflowed
        self._overflowed = overflowed

    def drain(self, most: int | None = None) -> list[can.Message]:
        """Read the frames that have arrived, oldest first, without waiting; see :attr:`is_behind`.

        Parameters
        ----------
        most
            How many frames are read at most, foreign ones included; the rest stays for the next call. None for what
            the settings say of a tick of 10 ms.

        Raises
        ------
        LinkError
            When the bus is not open, failed, or went bus-off.
        """
        bus = self._opened()
        messages: list[can.Message] = []
        counters = self.counters
        self.is_behind, self._has_left_some = self._has_left_some, True
        try:
            if self._interface is not None:
                self._is_sending = self._interface.is_sending()
            self._read(bus, messages, self._most if most is None else most)
        except Exception as error:  # an interface may raise anything
            for _ in messages:  # what was read before is as stale as the bus is gone
                counters.received += 1
                counters.count_rejection("bus_failed")
            if isinstance(error, LinkError):
                raise
            raise self._error("failed while receiving", error) from error
        if self._age is not None:
            self._age.drained()
        counters.received += len(messages)
        return messages

    def age_s(self, message: can.Message) -> float | None:
        """Tell how old a message was when the latest :meth:`drain`, which returned it, ended.

        Returns
        -------
        float or None
            Time since its arrival, s. None where the interface's time stamps say nothing about that, or cannot be
            believed: the wall clock, which stamps on SocketCAN, may have been set meanwhile.
        """
        return None if self._age is None else self._age.age_s(message.timestamp)

    def waited_s(self, message: can.Message) -> float | None:
        """Tell how long a message of the latest :meth:`drain` had been there, unread, at the drain before; s.

        None where its age is not known.
        """
        return None if self._age is None else self._age.waited_s(message.timestamp)

    def prepare(self, identifier: Identifier, data: bytes) -> can.Message:
        """Make a frame ready, so that nothing but handing it over is left for :meth:`send`."""
        message = can.Message(
            arbitration_id=identifier.identifier,
            is_extended_id=identifier.extended,
            data=data,
            is_fd=self.settings.fd,
            bitrate_switch=self.settings.bit_rate_switch,
            check=True,
        )
        if isinstance(self._bus, SocketcandBus):
            self._bus.prepare(message)
        return message

    def send(self, message: can.Message) -> bool:
        """Hand a frame over, without waiting.

        Parameters
        ----------
        message
            From :meth:`prepare`.

        Returns
        -------
        bool
            False when the queue was full just now, or what was sent before the latest :meth:`drain` has not left yet:
            the frame is dropped and counted, not kept. Send a newer one in the next tick. So no more than the frames of
            one tick ever wait in the kernel's queue, however long it is; beside those in the controller itself.

        Raises
        ------
        LinkError
            When the bus is not open, or failed.
        """
        bus = self._opened()
        if self._is_sending:
            self.counters.dropped += 1
            return False
        try:
            # The default time-out, None, would wait for ever with some interfaces.
            bus.send(message, timeout=0)
        except Exception as error:  # an interface may raise anything
            if is_full(error):
                self.counters.dropped += 1
                return False
            raise self._error("failed while sending", error) from error
        self.counters.sent += 1
        return True

    def _read(self, bus: can.BusABC, messages: list[can.Message], most: int) -> None:
        for _ in range(most):
            message = bus.recv(0)
            if message is None:
                self._has_left_some = False
                return
            if message.is_error_frame:
                self._take_error_frame(message)
            elif message.arbitration_id in self._accepted:
                messages.append(message)
        self.counters.overruns += 1
        if isinstance(bus, SocketcandBus):
            bus.look_again()

    def _opened(self) -> can.BusABC:
        if self._bus is None:
            raise LinkError(f"{self._opening.name} is not open. Open it first.")
        return self._bus

    def _take_error_frame(self, message: can.Message) -> None:
        if self.settings.interface not in error_frames.INTERFACES:
            self.counters.count_error("other")
            return
        error = error_frames.read_error_frame(message)
        self.error_counters = error.counters or self.error_counters
        self.counters.count_error(error.kind)
        if error.is_bus_off:
            raise LinkError(
                f"{self._opening.name} went bus-off: too many transmit errors. Check cable, termination and bit rate, "
                f"restart the controller with 'ip link set {self.settings.channel} type can restart', then reset the "
                "axis."
            )
        self.controller_state = error.state or self.controller_state

    def _error(self, what: str, error: Exception) -> LinkError:
        return link_error(self._opening.name, self.settings, what, error)
