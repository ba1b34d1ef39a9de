"""A bus as the service runs it: opened again after it was lost, and read for all who share it."""

import asyncio
import errno
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final, NamedTuple

import can
import structlog

from twostage_servo.canbus.link import Link, LinkError
from twostage_servo.timing.ticks import Tick

_MOST_MISSED_MADE_UP_FOR: Final = 10
"""Missed ticks whose frames are read in the tick after them. Their reading takes a tenth of the time that was missed on
a bus that is full; what is left then does not count as fresh."""

_LONGEST_CLOSING_S: Final = 1.0

FrameObserver = Callable[[int, str, int, bytes], None]
"""Called with tick index, ``sent`` or ``received``, identifier and data of each frame; must not wait."""


class Subscriber(NamedTuple):
    """What somebody who shares a bus is called for.

    Attributes
    ----------
    receivers
        Called with each frame, by its identifier.
    fall_behind
        Called where a read has left frames on the bus: with the number of such reads in a row, and of frames read.
    lose
        Called when the bus is lost, with the reason.
    """

    receivers: Mapping[int, Callable[[can.Message], None]]
    fall_behind: Callable[[int, int], None]
    lose: Callable[[str], None]


class BusConnection:
    """One bus, for all who subscribe to it.

    Parameters
    ----------
    link
        The bus, not yet open.
    period_s
        Length of a tick in s.
    observers
        Are shown each frame.

    Attributes
    ----------
    link
        As given.
    error
        Why the bus is not open; None while it is.
    """

    def __init__(self, link: Link, period_s: float, observers: Sequence[FrameObserver] = ()) -> None:
        self.link = link
        self.error: str | None = "not opened yet"
        self._observers = tuple(observers)
        self._subscribers: list[Subscriber] = []
        self._receivers: dict[int, Callable[[can.Message], None]] = {}
        self._opening: asyncio.Task[None] | None = None
        self._rejected = 0
        self._overflowed = self._overruns = 0
        self._frames_a_tick = link.settings.frames_read(period_s)
        self._reads_behind = 0
        self._lacked_carrier = False
        self._next_opening_s = 0.0
        self._ticks_a_report = round(1.0 / period_s)
        self._next_report = 0
        self._controller = "active"
        self._log = structlog.get_logger().bind(bus=link.settings.channel)

    def subscribe(self, subscriber: Subscriber) -> None:
        """Call somebody for the frames that are for him, and for what becomes of the bus."""
        self._subscribers.append(subscriber)
        self._receivers |= subscriber.receivers

    def start(self) -> None:
        """Begin to open the bus."""
        self._opening = asyncio.create_task(self._keep_trying_to_open())

    async def close(self) -> None:
        """Close the bus for good; one that does not open or close just now is not waited for, or for a moment only."""
        if self._opening is not None:
            self._opening.cancel()
            await asyncio.gather(self._opening, return_exceptions=True)
        closing = self.link.close_in_thread()
        if closing is not None and not (await asyncio.wait([closing], timeout=_LONGEST_CLOSING_S))[0]:
            self._log.warning("the bus does not close", waited_s=_LONGEST_CLOSING_S)

    def read(self, tick: Tick) -> None:
        """Hand what has arrived to those who have subscribed to it.

        After missed ticks as much more is read as they would have; up to a bound, since that delays this one.
        """
        if self.error is not None:
            return
        most = self._frames_a_tick * (1 + min(tick.missed, _MOST_MISSED_MADE_UP_FOR))
        try:
            messages = self.link.drain(most)
        except LinkError as error:
            self._lose(error)
            return
        self._reads_behind = self._reads_behind + 1 if self.link.is_behind else 0
        if self._reads_behind:
            for subscriber in self._subscribers:
                subscriber.fall_behind(self._reads_behind, most)
        for message in messages:
            for observe in self._observers:
                observe(tick.index, "received", message.arbitration_id, bytes(message.data))
            self._receivers[message.arbitration_id](message)

    def send(self, tick_index: int, messages: Iterable[can.Message]) -> bool | None:
        """Send frames of :meth:`Link.prepare`, up to the first that the bus does not take.

        Returns
        -------
        bool or None
            Whether it has taken all of them; None if the bus is gone.
        """
        if self.error is not None:
            return None
        for message in messages:
            try:
                sent = self.link.send(message)
            except LinkError as error:
                self._lose(error)
                return None
            if not sent:
                return False
            for observe in self._observers:
                observe(tick_index, "sent", message.arbitration_id, bytes(message.data))
        return True

    def look_after(self, tick: Tick) -> None:
        """Tell the log what has changed; once a second, look after the bus and tell what was rejected or lost."""
        link = self.link
        if link.controller_state != self._controller:
            self._controller = link.controller_state
            counters = link.error_counters
            self._log.warning("bus controller", tick=tick.index, state=self._controller, error_counters=counters)
        if tick.index >= self._next_report:  # a remainder of the index could be one that is always missed
            self._next_report = tick.index + self._ticks_a_report
            self._check(tick)

    def _check(self, tick: Tick) -> None:
        link = self.link
        if self.error is None:
            try:
                link.check()
            except LinkError as error:
                self._lose_unless_it_goes_down(error, tick)
            else:
                self._lacked_carrier = False
        rejected, overflowed, overruns = link.counters.rejected, link.counters.overflowed, link.counters.overruns
        if rejected != self._rejected:
            self._log.warning("frames rejected", tick=tick.index, new=rejected - self._rejected, total=rejected)
            self._rejected = rejected
        if overflowed != self._overflowed:
            new = overflowed - self._overflowed
            self._log.warning(
                "frames were lost in the kernel before they were read", tick=tick.index, new=new, total=overflowed
            )
            self._overflowed = overflowed
        if overruns != self._overruns:
            new = overruns - self._overruns
            text = "more frames arrive than a tick reads: those that have to wait do not count as fresh"
            self._log.warning(text, tick=tick.index, new=new, total=overruns, frames_a_tick=self._frames_a_tick)
            self._overruns = overruns

    def _lose_unless_it_goes_down(self, error: LinkError, tick: Tick) -> None:
        """Look again in the next tick: an interface that is taken down loses its carrier first, as in bus-off."""
        cause = error.__cause__
        if isinstance(cause, OSError) and cause.errno == errno.ENOLINK and not self._lacked_carrier:
            self._lacked_carrier, self._next_report = True, tick.index + 1
        else:
            self._lose(error)

    def _lose(self, error: LinkError) -> None:
        self.error = str(error)
        self._log.error("the bus failed", error=self.error)
        for subscriber in self._subscribers:
            subscriber.lose(self.error)
        self._lacked_carrier = False
        self.link.close_in_thread()
        self.start()

    async def _keep_trying_to_open(self) -> None:
        """Open the bus, in a thread since that may take seconds; the axes are disarmed or tripped meanwhile.

        Attempts are the reopen interval apart, also those that succeed: a bus that opens and fails at once, again and
        again, must cost neither the processor nor the log more than one that does not open.
        """
        loop, interval_s = asyncio.get_running_loop(), self.link.settings.reopen_interval_ms / 1e3
        while True:
            await asyncio.sleep(max(0.0, self._next_opening_s - loop.time()))
            self._next_opening_s = loop.time() + interval_s
            try:
                await self.link.open_in_thread()
            except LinkError as error:
                if str(error) != self.error:
                    self._log.warning("the bus does not open, trying again", error=str(error))
                self.error = str(error)
            else:
                self.error = None
                self._log.info("the bus is open", interface=self.link.settings.interface)
                return
