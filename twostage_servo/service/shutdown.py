"""How a service ends: the axes come to rest, their drives are told to disable, and have the time to report it."""

import contextlib
from collections.abc import Sequence
from typing import Final

import structlog

from twostage_servo.axis.state import BRAKING, ENABLED
from twostage_servo.axis.trips import TripCode
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.settings import ServiceSettings, with_time_to_stop

_PARTING_FRAMES: Final = 3
"""Disable commands sent before the service ends: one lost frame must not leave the drive to its time-out."""


class Shutdown:
    """Ends a service, on request or after a defect.

    Parameters
    ----------
    settings
        The table ``[service]``.
    axis_loops
        The axes of the service.

    Attributes
    ----------
    settings
        As given, with the time that the axes take to stop where no `shutdown_timeout_ms` is stated.
    failure
        The defect that ends the service, or None.
    not_disabled
        Names of the axes whose drives may have been enabled when the service ended.
    """

    def __init__(self, settings: ServiceSettings, axis_loops: Sequence[AxisLoop]) -> None:
        self._stated = settings
        self._axis_loops = axis_loops
        self.failure: Exception | None = None
        self.not_disabled: list[str] = []
        self._ticks_left: int | None = None
        self._parting_frames = 0
        self._log = structlog.get_logger()
        self.allow_for_stops()

    def allow_for_stops(self) -> None:
        """Find out how long the axes need to stop; for when they have other settings."""
        designs = (axis_loop.axis.design for axis_loop in self._axis_loops)
        self.settings = with_time_to_stop(self._stated, designs)

    @property
    def is_ending(self) -> bool:
        """Whether :meth:`begin` has been called."""
        return self._ticks_left is not None

    def begin(self) -> None:
        """Bring the axes to rest, disable the drives, and end the loop.

        They are told to disable within the shutdown time-out at the latest, and then have their own time to report it
        (``axis.arming_timeout_ms``).
        """
        if self._ticks_left is None:
            self._ticks_left = round(self.settings.shutdown_timeout_ms / self.settings.tick_ms)
            self._log.info("ending", states={one.name: one.axis.state for one in self._axis_loops})
            for axis_loop in self._axis_loops:
                axis_loop.axis.disarm("the service ends")

    def fail(self, error: Exception, *, in_control: bool = False) -> None:
        """Quick stop at the first defect, with which the service then ends.

        Parameters
        ----------
        error
            The defect.
        in_control
            Whether it is in what controls the axes: a second one there ends the loop at once.

        Raises
        ------
        Exception
            The first defect, where this is a second one in control.
        """
        if self.failure is not None:
            if in_control:
                raise self.failure
            return
        self.failure = error
        self._log.critical("the loop failed, the axes are being stopped", exc_info=error)
        for axis_loop in self._axis_loops:
            axis_loop.axis.raise_trip(TripCode.INTERNAL_ERROR, f"{type(error).__name__} in the loop: {error}")
        self.begin()

    def brake(self) -> None:
        """Let the axes brake, as part of each tick, until their time is over."""
        if self._ticks_left is None:
            return
        self._ticks_left -= 1
        for axis_loop in self._axis_loops:
            axis = axis_loop.axis
            axis.disarm()
            if self._ticks_left <= 0 and axis.state in BRAKING:
                self._report_if_coasting(axis_loop)
                axis.end_braking()

    def is_over(self) -> bool:
        """Whether the loop may end after this tick: asked once a tick."""
        if self._ticks_left is None or any(one.axis.state in ENABLED for one in self._axis_loops):
            return False
        self._parting_frames += 1
        # Each drive has its time to report that it is off: what was not seen is told, not taken for granted.
        waits = any(one.axis.is_disabling for one in self._axis_loops)
        return self._parting_frames >= _PARTING_FRAMES and not waits

    def disable_drives(self, tick_index: int) -> None:
        """Tell each drive to disable, as the last thing before the buses close."""
        with contextlib.ExitStack() as every_drive:  # a defect at one drive is not in the way of the others
            for axis_loop in self._axis_loops:
                every_drive.callback(axis_loop.disable_drive, tick_index)
        self.not_disabled = [one.name for one in self._axis_loops if one.report_if_not_disabled()]

    def _report_if_coasting(self, axis_loop: AxisLoop) -> None:
        velocity = axis_loop.axis.estimate.velocity
        if abs(velocity) > axis_loop.axis.design.rest_velocity:
            self._log.error(
                "the drive is disabled while the axis moves: the time to brake at the end of the service is over",
                axis=axis_loop.name,
                velocity=velocity,
                shutdown_timeout_ms=self.settings.shutdown_timeout_ms,
            )
