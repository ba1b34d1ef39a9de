"""Which requests an axis carries out: each check refuses with a code, the numbers, and what to do instead."""

import math

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.moves import LARGEST_OVERRIDE
from twostage_servo.axis.refusals import Obstacle, RefusalCode, Refused
from twostage_servo.axis.state import OVERRIDABLE, Event, State, next_state
from twostage_servo.axis.trips import Trip
from twostage_servo.exact import exact

_STANDSTILL_S = 3600.0
"""An axis that does not go a step of its encoder in this time stands still, whatever speed it was asked for."""
_STANDSTILL_SHARE = 1e-12
"""Share of the velocity limit that is no speed either, where the encoder has no steps."""


class Admission:
    """The checks that stand before every request.

    Parameters
    ----------
    design
        Limits and units.
    drive
        What the drive reports.
    resolution
        Step in which the encoder's position is reported, in axis unit; 0 if it has none.

    Attributes
    ----------
    slowest
        Smallest speed that is one, in axis unit/s.
    """

    def __init__(self, design: AxisDesign, drive: DriveReport, resolution: float = 0.0) -> None:
        self.slowest = slowest_velocity(design, resolution)
        self._unit = design.settings.unit
        limits = self._limits = design.settings.limits
        self._drive = drive
        # An axis at rest may have the speed that still counts as rest, and must be able to stop from it.
        speed = design.rest_velocity
        to_stop = design.certain_stopping_distance(speed, limits.quick_stop_deceleration) + speed * design.period_s
        self._overrun_to_stand_in = max(0.0, limits.position_overrun - to_stop)

    def is_inside(self, position: float, overrun: float = 0.0) -> bool:
        """Whether a position (axis unit) is within the position limits, or past them by no more than the overrun."""
        return self._limits.position_minimum - overrun <= position <= self._limits.position_maximum + overrun

    def obstacle_to_arming(self, *, referenced: bool) -> Obstacle | None:
        """Return what keeps a disarmed axis from being armed, or None."""
        if obstacle := self._drive.obstacle_to_arming():
            return obstacle
        position, limits, unit = self._drive.position, self._limits, self._unit
        if referenced and position is not None and not self.is_inside(position, limits.position_overrun):
            return (
                RefusalCode.POSITION_LIMIT,
                (
                    f"the axis stands at {position:.6g} {unit}, more than {limits.position_overrun:g} {unit} outside "
                    f"its limits {limits.position_minimum:g} to {limits.position_maximum:g}: move "
                    "it back by hand first; or, if it is not there, set its true position: `home --here POSITION`."
                ),
            )
        return None

    def check_state(self, state: State, event: Event, trip: Trip | None) -> None:
        """Refuse what the state machine does not admit."""
        if next_state(state, event) is not None:
            return
        if trip is not None:
            raise Refused(RefusalCode.TRIPPED, f"{tripped_text(trip)} {trip.next_action}")
        if state is State.DISARMED and event in {Event.STOP, Event.QUICK_STOP}:
            raise Refused(
                RefusalCode.DISARMED,
                "the axis is disarmed and its drive was told to disable, so there is nothing to stop.",
            )
        if state is State.DISARMED:
            raise Refused(RefusalCode.DISARMED, "the axis is disarmed: `arm` it first.")
        raise Refused(RefusalCode.BUSY, f"the axis is {state}: wait until it holds.")

    def check_velocity(self, velocity: float, largest: float) -> None:
        """Refuse a speed that is no positive number, too large, or so small that it is none; both in axis unit/s."""
        if not (math.isfinite(velocity) and 0.0 < velocity <= largest):
            raise Refused(
                RefusalCode.VELOCITY_LIMIT,
                f"velocity {exact(velocity)} {self._unit}/s: it must be greater than 0 and at most {largest:g} "
                f"{self._unit}/s.",
            )
        if velocity < self.slowest:
            raise Refused(
                RefusalCode.VELOCITY_LIMIT,
                f"velocity {exact(velocity)} {self._unit}/s: at less than {self.slowest:.3g} {self._unit}/s the axis "
                "would not move one encoder step in an hour.",
            )

    def check_override(self, percent: float, state: State, trip: Trip | None) -> None:
        """Refuse a speed override that is no percentage, or that would not outlast the next arming."""
        if not (math.isfinite(percent) and 0.0 <= percent <= LARGEST_OVERRIDE):
            raise Refused(
                RefusalCode.BAD_REQUEST,
                f"override {exact(percent)} %: it must be from 0, which holds the axis, to {LARGEST_OVERRIDE:g} %.",
            )
        if state in OVERRIDABLE:
            return
        if trip is not None:
            raise Refused(RefusalCode.TRIPPED, f"{tripped_text(trip)} {trip.next_action}")
        if state is State.ARMING:
            raise Refused(RefusalCode.BUSY, "the axis is arming, and the override is 100 % then: wait until it holds.")
        raise Refused(
            RefusalCode.DISARMED,
            f"the axis is {state}, and the override is 100 % again after each arming: `arm` it first.",
        )

    def check_target(self, target: float, *, referenced: bool, lost_because: str = "") -> None:
        """Refuse a set-point (axis unit) outside the limits, and any on an axis that does not know its position.

        The operator is told why it does not.
        """
        if not (math.isfinite(target) and self.is_inside(target)):
            raise Refused(
                RefusalCode.POSITION_LIMIT,
                f"set-point {exact(target)} {self._unit}: it must lie from {self._limits.position_minimum:g} to "
                f"{self._limits.position_maximum:g} {self._unit}.",
            )
        if not referenced:
            why = f" ({lost_because})" if lost_because else ""
            raise Refused(
                RefusalCode.NOT_HOMED, f"the axis does not know its position{why}: `home` it first, or `jog`."
            )

    def check_switches(self, direction: float) -> None:
        """Refuse motion (its sign counts) towards a limit switch that is active."""
        if switch := self._drive.blocks(direction):
            raise Refused(
                RefusalCode.LIMIT_SWITCH, f"the {switch} limit switch is active: only motion away from it is possible."
            )

    def check_place(self, position: float, velocity: float | None, rest_velocity: float) -> None:
        """Refuse to call the place where the axis stands `position` (axis unit) unless it is seen, and at rest.

        One at which the axis would trip as soon as it is armed is refused as well. Both velocities in axis unit/s; that
        of the axis is None where it has only just been seen.
        """
        limits, unit = self._limits, self._unit
        overrun = self._overrun_to_stand_in
        if not (math.isfinite(position) and self.is_inside(position, overrun)):
            raise Refused(
                RefusalCode.POSITION_LIMIT,
                f"the axis cannot stand at {exact(position)} {unit}: with limits of {limits.position_minimum:g} to "
                f"{limits.position_maximum:g} {unit} and an overrun of {limits.position_overrun:g} {unit} its position "
                f"must lie from {limits.position_minimum - overrun:.6g} to "
                f"{limits.position_maximum + overrun:.6g} {unit}.",
            )
        if self._drive.position is None or self._drive.is_stale:
            raise Refused(RefusalCode.NO_FEEDBACK, "there is no fresh feedback from the drive.")
        if not self._drive.is_recent:  # it may be elsewhere by now
            raise Refused(RefusalCode.BUSY, "a sample of the axis is missing just now: try again.")
        if velocity is None:
            raise Refused(RefusalCode.BUSY, "it is not known yet whether the axis is at rest: try again.")
        if abs(velocity) > rest_velocity:
            raise Refused(
                RefusalCode.BUSY,
                f"the axis moves at {velocity:.4g} {self._unit}/s: bring it to rest before you set its position.",
            )


def tripped_text(trip: Trip) -> str:
    """Return the sentence that an operator is refused with after a trip."""
    return f"the axis has tripped ({trip.code}): {trip.cause.rstrip('.')}."


def slowest_velocity(design: AxisDesign, resolution: float) -> float:
    """Return the smallest speed that an axis can be asked for, in axis unit/s; `resolution` in axis unit."""
    return max(resolution / _STANDSTILL_S, _STANDSTILL_SHARE * design.settings.limits.velocity)
