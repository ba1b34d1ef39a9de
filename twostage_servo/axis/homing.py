"""Homing: finding the place from which positions are counted, step by step."""

import enum

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.settings import HomingSettings
from twostage_servo.control.laws.law import Stage

_AHEAD_S = 0.03
"""Time by which an index mark may be ahead of the samples, in s, and three ticks at least: one, and a period of the
drive's, which may be longer than a short tick."""

_TICKS_AHEAD = 3


class _Phase(enum.Enum):
    SEEK = "seeking"
    STOP_BEYOND = "stopping beyond the reference"
    BACK_OFF = "backing off"
    LEAVE = "leaving the hard stop"
    STOP = "stopping"
    DONE = "done"


class HomingFailed(Exception):  # noqa: N818 - not a fault of the program: what the search came to
    """The reference was not found; the text has the numbers."""


class Homing:
    """One search for the reference; :meth:`step` is called once a tick until :attr:`done`.

    A switch is passed at the search velocity, then left slowly: the edge at which it opens is the reference, from the
    same side each time. A hard stop is where the axis stands still under the homing effort; it is left by a little, or
    the law would go on pushing for good against what it takes for a load. An index mark is what the drive latches on
    the way: one that does not lie there contradicts the feedback, and one of the two is wrong.

    Parameters
    ----------
    design
        Settings of the axis.
    motion, drive
        What moves the axis, and what its drive reports.

    Attributes
    ----------
    direction
        Where it is looking now: 1 or -1.
    reference
        Where the reference was found, in axis unit by the former origin; None until then.
    """

    def __init__(self, design: AxisDesign, motion: Motion, drive: DriveReport) -> None:
        settings = self._settings = design.settings.homing
        self._unit = design.settings.unit
        self._deceleration = design.settings.limits.acceleration
        self._effort_limit = design.settings.limits.effort
        self._rest_velocity = design.rest_velocity
        # A mark may be told of before the sample that shows the axis there: a tick, and a period of the drive's.
        self._way_ahead = max(_AHEAD_S, _TICKS_AHEAD * design.period_s) * settings.slow_velocity
        self._motion = motion
        self._drive = drive
        self._sign = _sign(settings)
        self.direction = 0.0
        self._still_ticks = 0
        self._back_off = design.settings.back_off
        self._stop_ticks = design.ticks(settings.stop_time_ms)
        self._ticks_left = design.ticks(1e3 * (2.0 * settings.travel / settings.slow_velocity + 10.0))
        self.reference: float | None = None
        self._start = motion.law.observer.position
        drive.forget_index()
        if self.first_direction(settings, drive) != self._sign:
            self._phase = _Phase.BACK_OFF
            self._go(-self._sign, settings.slow_velocity)
        else:
            self._phase = _Phase.SEEK
            self._go(self._sign, settings.velocity if settings.method == "switch" else settings.slow_velocity)
        if settings.method == "hard_stop":
            motion.law.limit_effort(settings.effort)

    @staticmethod
    def first_direction(settings: HomingSettings, drive: DriveReport) -> float:
        """Return the direction, 1 or -1, in which a search sets out: away from a switch that is active already."""
        backs_off = settings.method == "switch" and drive.home_switch
        return -_sign(settings) if backs_off else _sign(settings)

    @property
    def done(self) -> bool:
        """Whether the reference has been found and the axis has come to rest."""
        return self._phase is _Phase.DONE

    def end(self) -> None:
        """Give the axis its own effort limit back; also after a search that was broken off."""
        self._motion.law.limit_effort(self._effort_limit)

    def step(self) -> None:
        """Check this tick.

        Raises
        ------
        HomingFailed
            If the reference has not been found within the travel or the time, or what it needs is not there.
        """
        self._check()
        at_rest = self._motion.law.stage is Stage.POSITION
        match self._phase:
            case _Phase.SEEK:
                self._seek()
            case _Phase.STOP_BEYOND if at_rest and not self._drive.home_switch:
                raise HomingFailed(
                    "the home switch is not active where the axis came to rest: the axis overran it, or the "
                    f"switch only flickered; lower axis.homing.velocity, now {self._settings.velocity:g} {self._unit}/s"
                )
            case _Phase.STOP_BEYOND if at_rest:
                self._phase = _Phase.BACK_OFF
                self._go(-self._sign, self._settings.slow_velocity)
            case _Phase.BACK_OFF if self._drive.fresh and not (self._drive.home_switch or self._motion.doubts_sample):
                self._find(self._drive.position)
            case _Phase.LEAVE if self._has_left():
                self._phase = _Phase.STOP
                self._motion.stop(self._deceleration, smooth=True)
            case _Phase.STOP if at_rest:
                self._phase = _Phase.DONE

    def _seek(self) -> None:
        drive = self._drive
        if self._settings.method == "switch" and drive.home_switch:
            self._motion.stop(self._deceleration, smooth=True)
            self._phase = _Phase.STOP_BEYOND
        elif self._settings.method == "index" and drive.index is not None:
            self._check_on_the_way(drive.index)
            self._find(drive.index)
        elif self._settings.method == "hard_stop":
            observer = self._motion.law.observer
            still = abs(observer.velocity) <= min(self._rest_velocity, 0.1 * self._settings.slow_velocity)
            pushing = self._sign * self._motion.law.effort * self._motion.law.observer.plant.b2 > 0.0
            self._still_ticks = self._still_ticks + 1 if still and pushing and self._motion.law.saturated else 0
            if self._still_ticks >= self._stop_ticks:
                self.reference = observer.position
                self._phase = _Phase.LEAVE
                self._go(-self._sign, self._settings.slow_velocity)

    def _check_on_the_way(self, mark: float) -> None:
        """Refuse an index mark (axis unit) that the search has not passed."""
        place, unit = self._motion.law.observer.position, self._unit
        allowed = self._motion.innovation_gate + self._way_ahead
        if not min(self._start, place) - allowed <= mark <= max(self._start, place) + allowed:
            raise HomingFailed(
                f"the drive reports an index mark at {mark:.6g} {unit}, where the axis has not been: the search "
                f"went from {self._start:.6g} to {place:.6g} {unit}. Check that the index message has the scale of the "
                "feedback, and that no other node sends it"
            )

    def _has_left(self) -> bool:
        assert self.reference is not None  # noqa: S101 - it is found before it is left
        return self._sign * (self.reference - self._motion.law.observer.position) >= self._back_off

    def _find(self, position: float | None) -> None:
        self.reference = position
        self._phase = _Phase.STOP
        self._motion.stop(self._deceleration, smooth=True)

    def _go(self, sign: float, velocity: float) -> None:
        self.direction = sign
        # Twice the travel: the search ends at the travel, and must not slow down before.
        self._motion.set_target(self._motion.law.observer.position + sign * 2.0 * self._settings.travel, velocity)

    def _check(self) -> None:
        self._ticks_left -= 1
        travelled = abs(self._motion.law.observer.position - self._start)
        if self._drive.home_switch is None and self._settings.method == "switch":
            raise HomingFailed(
                "the drive does not report a home switch; name its signal in protocol.feedback.home_switch"
            )
        if travelled > self._settings.travel or self._ticks_left <= 0:
            raise HomingFailed(
                f"no {self._settings.method.replace('_', ' ')} within {travelled:.4g} {self._unit} while "
                f"{self._phase.value}; axis.homing.travel is {self._settings.travel:g} {self._unit}"
            )


def _sign(settings: HomingSettings) -> float:
    return 1.0 if settings.direction == "positive" else -1.0
