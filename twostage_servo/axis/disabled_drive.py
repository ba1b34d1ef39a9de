"""Watches a drive that has been told to disable: whether it says that it is off, and whether the axis stays in place.

Two things are told apart. A drive that still reports that it is enabled does not obey, and nothing that is sent to it
can be relied on. An axis that moves although its drive is off may be pushed by a hand or drawn by its weight.
"""

import math
from dataclasses import dataclass, replace

from twostage_servo.axis.design import DISABLING_TICKS, AxisDesign

_SPEED_SAMPLES = DISABLING_TICKS
"""Samples from which the speed at the beginning is taken: the drive takes the command between the first of them."""

_SAMPLES_BEYOND = 2
"""Samples in a row that are motion: one is a spike."""

_LONGEST_GAP = 0.2
"""Share of the drive's time that may lie between two reports and count in full."""

_ROUND_TRIP_TICKS = 2
"""Ticks that a report needs in any case, beside the time that the drive has: until the command leaves, and back."""


@dataclass(slots=True)
class DisabledMotion:
    """What has been seen of the motion: all of it goes on when the settings change.

    Attributes
    ----------
    speed
        Largest speed of the coasting axis, `ticks` ago, in axis unit/s.
    anchor
        Where it is measured from, in axis unit; None before the first sample.
    last
        The last sample, in axis unit.
    samples, ticks, ticks_since_last
        Samples since the beginning; ticks since the speed was taken, and since the last sample.
    beyond
        Samples in a row, up to now, that coasting does not explain.
    settled
        Whether the axis has come to rest.
    moved
        How far it has moved beyond what coasting explains, in axis unit; None where nothing shows that.
    """

    speed: float = 0.0
    anchor: float | None = None
    last: float = 0.0
    samples: int = 0
    ticks: int = 0
    ticks_since_last: int = 0
    beyond: int = 0
    settled: bool = False
    moved: float | None = None


@dataclass(slots=True)
class DisabledReports:
    """What the drive has said since it was told to disable: all of it goes on when the settings change.

    Attributes
    ----------
    reported
        What it said last: whether it is enabled; None before it has.
    ticks_silent, ticks_since_report
        Ticks in which it said nothing, and those since the last report that were not missed.
    ticks_told
        Ticks since it was told to disable; None while it is told to be enabled.
    ticks_enabled
        Ticks since then in which it said that it is enabled.
    ticks_disabled
        Ticks in a row in which it said that it is not.
    """

    reported: bool | None = None
    ticks_silent: int = 0
    ticks_since_report: int = 0
    ticks_told: int | None = None
    ticks_enabled: int = 0
    ticks_disabled: int = 0


class MotionWhileDisabled:
    """Finds out whether an axis moves though nothing drives it.

    An axis that was moving coasts: by ``speed / pole``, with a plant that is off its model by as much as it may be, and
    what it goes before the drive has taken the command. Motion beyond that, and beyond what a sample may be off
    (``axis.limits.innovation_gate``), is not explained. When it should have come to rest, its place is taken anew.

    Parameters
    ----------
    design
        The axis.
    resolution
        Step in which the encoder's position is reported, in axis unit; 0 if it has none.

    Attributes
    ----------
    known
        What it has seen so far.
    """

    __slots__ = ("_coasting_s", "_overspeed", "_period_s", "_pole", "_tolerance", "known")

    def __init__(self, design: AxisDesign, resolution: float) -> None:
        self._period_s = design.period_s
        self._pole = design.least_pole
        self._coasting_s = design.coasting_s
        self._overspeed = design.settings.limits.overspeed
        self._tolerance = design.sample_tolerance(resolution)
        self.known = DisabledMotion()

    def begin(self, velocity: float) -> None:
        """Begin anew: the drive is told to disable now, at an estimated velocity in axis unit/s."""
        self.known = DisabledMotion(speed=abs(velocity))

    def update(self, missed: int, position: float | None) -> None:
        """Check a tick, before which so many were missed, with its sample in axis unit, None if there is none."""
        known = self.known
        known.ticks += 1 + missed
        known.ticks_since_last += 1 + missed
        if position is None:
            return
        last, ticks = known.last, known.ticks_since_last
        known.last, known.ticks_since_last = position, 0
        known.samples += 1
        if known.anchor is None:
            known.anchor = position
            return
        if known.samples <= _SPEED_SAMPLES:
            # It has been slowing down between the two samples: a mean speed over a gap is not that at its beginning.
            slowing = self._pole * ticks * self._period_s
            known.speed = max(known.speed, abs(position - last) * self._pole / -math.expm1(-slowing))
            known.ticks = 0
        known.beyond = known.beyond + 1 if abs(position - known.anchor) > self._allowed() else 0
        if known.beyond >= _SAMPLES_BEYOND or known.moved is not None:
            known.moved = position - known.anchor
        elif not known.settled and self._is_at_rest():
            known.settled, known.anchor = True, position

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self.known.last += distance
        if self.known.anchor is not None:
            self.known.anchor += distance

    def continue_from(self, former: "MotionWhileDisabled") -> None:
        """Continue from the state of a former one on the same axis."""
        self.known = replace(former.known)

    @property
    def _start_speed(self) -> float:
        """Largest speed of the coasting axis, `_ticks` ago, in axis unit/s; beyond the limit it is the encoder's."""
        return min(self.known.speed, self._overspeed)

    def _allowed(self) -> float:
        """Return how far the axis may be from its anchor, in axis unit."""
        if self.known.settled:
            return self._tolerance
        return self._start_speed * self._coasting_s + self._tolerance

    def _is_at_rest(self) -> bool:
        """Whether an axis that coasts is at rest by now: what it has yet to go cannot be told from a bad sample."""
        to_go = self._start_speed / (self._pole * 0.5 * self._tolerance)
        long_enough = self.known.ticks * self._period_s >= math.log(max(1.0, to_go)) / self._pole
        return long_enough and self.known.samples > _SPEED_SAMPLES and self.known.beyond == 0


class DisabledDriveWatch:
    """Looks, once a tick, at a drive that is told to be disabled.

    The drive has ``axis.arming_timeout_ms`` to report that it is off. The time in which it reports that it is enabled
    adds up until it has reported for as long that it is disabled, so that one which enables itself again and again is
    told as well. Time counts when the next report comes, up to a fifth of what the drive has: of a drive that is
    silent, or whose bus is held up, nothing is known.

    Parameters
    ----------
    design
        The axis.
    resolution
        Step in which the encoder's position is reported, in axis unit; 0 if it has none.
    report_period_ms
        Time between two reports where they do not come with the feedback, in ms; else 0.

    Attributes
    ----------
    known
        What the drive has said so far.
    motion
        Whether the axis moves meanwhile.
    """

    __slots__ = ("_longest_gap", "_patience", "_period_s", "_silence_allowed", "known", "motion")

    def __init__(self, design: AxisDesign, resolution: float = 0.0, report_period_ms: float = 0.0) -> None:
        settings = design.settings
        self.motion = MotionWhileDisabled(design, resolution)
        self._period_s = design.period_s
        self._patience = design.ticks(settings.arming_timeout_ms + report_period_ms) + _ROUND_TRIP_TICKS
        self._silence_allowed = design.ticks(max(settings.limits.stale_feedback_ms, report_period_ms))
        self._longest_gap = max(1, design.ticks(report_period_ms or _LONGEST_GAP * settings.arming_timeout_ms))
        self.known = DisabledReports()

    def release(self, report: bool | None) -> None:
        """Watch no longer: the drive is told to be enabled. What it says of itself is remembered, None if nothing."""
        if report is not None:
            self.known.reported, self.known.ticks_silent = report, 0
        if self.known.ticks_told is not None:
            self.known.ticks_told = None
            self.known.ticks_enabled = self.known.ticks_disabled = 0
            self.motion.begin(0.0)

    def update(self, missed: int, report: bool | None, position: float | None, velocity: float) -> None:
        """Check a tick in which the drive is told to be disabled.

        Parameters
        ----------
        missed
            Ticks that were missed just before it.
        report
            Whether the drive has said in this tick that it is enabled; None if it has said nothing.
        position
            This tick's sample in axis unit; None if there is none.
        velocity
            Estimated velocity, in axis unit/s; looked at in the first tick only.
        """
        if self.known.ticks_told is None:  # the command leaves at the end of this tick
            self.known.ticks_told = self.known.ticks_since_report = 0
            self.known.reported = self.known.reported if report is None else report
            self.motion.begin(velocity)
        else:
            self.known.ticks_told += 1 + missed
            self._record_report(missed, report)
        self.motion.update(missed, position)

    def continue_from(self, former: "DisabledDriveWatch") -> None:
        """Continue from a former watch on the same drive: the settings may have changed, the drive has not."""
        self.known = replace(former.known)
        self.motion.continue_from(former.motion)

    def _record_report(self, missed: int, report: bool | None) -> None:
        self.known.ticks_since_report += 1  # a tick that was missed told the drive nothing
        if report is None:
            self.known.ticks_silent += 1 + missed
            return
        ticks = min(self.known.ticks_since_report, self._longest_gap)
        self.known.reported, self.known.ticks_silent, self.known.ticks_since_report = report, 0, 0
        if report:
            self.known.ticks_enabled += ticks
            self.known.ticks_disabled = 0
        else:
            self.known.ticks_disabled += ticks
            if self.known.ticks_disabled >= self._patience:
                self.known.ticks_enabled = 0

    @property
    def not_disabled(self) -> bool:
        """Whether the drive has reported for too long that it is enabled, and has not reported otherwise since."""
        return bool(self.known.reported and self.known.ticks_enabled > self._patience)

    @property
    def waits(self) -> bool:
        """Whether the drive, once told to disable, still has time to report it; a silent one is not waited for."""
        return bool(self.known.reported and self.known.ticks_silent < self._silence_allowed and not self.not_disabled)

    @property
    def silent_while_enabled(self) -> bool:
        """Whether nobody knows if the drive is off: enabled by its last report, told to disable, and silent since."""
        known = self.known
        is_silent = known.ticks_told is not None and known.ticks_silent >= self._silence_allowed
        return is_silent and self.seen_enabled

    @property
    def silent_ms(self) -> float:
        """How long it has said nothing, in ms, as far as it has been told to disable."""
        return 1e3 * self._period_s * self.known.ticks_silent

    @property
    def seen_enabled(self) -> bool:
        """Whether the last that the drive has said is that it is enabled, however long ago."""
        return bool(self.known.reported)

    @property
    def told_ms(self) -> float:
        """How long ago the drive was told to disable, in ms; 0 while it is told to be enabled."""
        return 1e3 * self._period_s * (self.known.ticks_told or 0)

    @property
    def enabled_ms(self) -> float:
        """How long it has reported since then that it is enabled, in ms."""
        return 1e3 * self._period_s * self.known.ticks_enabled

    @property
    def moved(self) -> float | None:
        """How far the axis has moved since then beyond what coasting explains, in axis unit; None: nothing shows it."""
        return self.motion.known.moved
