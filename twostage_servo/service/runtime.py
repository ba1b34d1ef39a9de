"""What a service gets from where it runs: its ticks, who uses its idle time, and who hears that it is alive."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from twostage_servo.api.status import RealtimeStatus
from twostage_servo.timing.output_offset import OutputOffset
from twostage_servo.timing.ticks import Ticks


class IdleTime(Protocol):
    """Somebody who works in what a tick leaves of its period."""

    def open(self, until_s: float) -> None:
        """Begin to work after a tick; the loop has to be free from `until_s` on, on its clock in s."""

    def end(self) -> None:
        """End: there are no more ticks."""


@dataclass(frozen=True, slots=True)
class Runtime:
    """What surrounds a service.

    Attributes
    ----------
    ticks
        The ticks, which nobody has begun to run through.
    output_offset
        How long after the deadline of a tick its commands leave; None lets them leave as soon as they are ready.
    idle
        Who works between the ticks.
    sign_of_life
        Called with the loop's time in s after each tick that was completed, and after no other.
    report
        Tells how punctual the host lets the service be; None where it runs in simulated time.
    """

    ticks: Ticks
    output_offset: OutputOffset | None = None
    idle: tuple[IdleTime, ...] = ()
    sign_of_life: Callable[[float], None] | None = None
    report: Callable[[], RealtimeStatus] | None = None
