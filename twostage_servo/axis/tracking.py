"""Follows an axis that nothing drives, so that arming starts from its position and its speed."""

import math
from collections.abc import Callable

from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.control.observer import DisturbanceObserver


class Tracking:
    """Lets the observer follow the samples while no effort acts.

    Parameters
    ----------
    observer
        The estimate.
    drive
        What the drive reports.
    gate
        Returns how far a sample may lie from its prediction at a velocity, in axis unit.
    noise
        Standard deviation of a sample, in axis unit.

    Attributes
    ----------
    is_on
        Whether the observer follows the axis.
    was_outlier
        Whether the last sample was not where the model expects it.
    """

    __slots__ = (
        "_drive", "_gate", "_last", "_least_step", "_observer", "_samples", "_ticks_since_last", "is_on", "was_outlier",
    )  # fmt: skip

    def __init__(
        self, observer: DisturbanceObserver, drive: DriveReport, gate: Callable[[float], float], noise: float
    ) -> None:
        self._observer = observer
        self._drive = drive
        self._gate = gate
        self._least_step = math.sqrt(2.0) * noise
        self._samples = 0
        self._last = 0.0  # sample, in axis unit
        self._ticks_since_last = 0
        self.is_on = False
        self.was_outlier = False

    def step(self, effort: float, *, blind: bool) -> None:
        """Follow the axis for a tick.

        Parameters
        ----------
        effort
            What has acted on it, in effort unit.
        blind
            Whether the feedback up to now is not believed, so that the observer starts afresh.
        """
        observer = self._observer
        # Not dated: by the speed, which is what the samples have to tell in the first place.
        position = self._drive.position if self._drive.fresh else None
        self._ticks_since_last += 1
        if self._drive.is_stale or blind:
            self.lose()
        elif position is None:
            observer.predict(effort)
        elif not self.is_on:
            observer.reset(position)
            self.is_on, self._samples = True, 1
        elif self._samples > 1 and abs(position - observer.position) <= self._gate(observer.velocity):
            observer.update(position, effort)
            self.was_outlier = False
        elif self._samples > 1 and not self.was_outlier:
            observer.predict(effort)  # one is a spike
            self.was_outlier = True
        else:
            # An axis that moves when it is first seen, or is knocked: two samples say how fast.
            step = self._drive.encoder.step(self._last, position)
            if abs(step) > self._least_step:
                observer.start_moving(position - step, position, self._ticks_since_last)
            else:  # the noise of two samples of an axis at rest makes a speed, which lasts for ten samples
                observer.reset(position)
            self._samples += 1
            self.was_outlier = False
        if position is not None:
            self._last, self._ticks_since_last = position, 0

    @property
    def knows_speed(self) -> bool:
        """Whether enough samples have been seen in a row to say how fast the axis goes."""
        return self.is_on and self._samples > 1

    def lose(self) -> None:
        """Start the observer afresh at the next sample: its estimate is invalid."""
        self.is_on = False
        self.forget_outlier()

    def forget_outlier(self) -> None:
        """Treat the next implausible sample as the first one."""
        self.was_outlier = False

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self._last += distance
