"""The law of an axis with the response that it is designed to have beside it, and the feedback that it may believe."""

import math
from collections import deque

from twostage_servo.axis.acted_effort import ActedEffort
from twostage_servo.axis.braking_estimate import BrakingEstimate
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.learned_plant import LearnedPlant
from twostage_servo.axis.sample_date import SampleDate
from twostage_servo.axis.sample_gap import SampleGap
from twostage_servo.axis.standing_load import StandingLoad
from twostage_servo.axis.tracking import Tracking
from twostage_servo.control.laws.law import SmoothLaw, Stage
from twostage_servo.control.per_time import kept_in

IMPLAUSIBLE_SAMPLES = 2
"""Samples in a row beyond the innovation gate that are a fault: one is a spike, two are not."""

_LONG_GAP_MS = 20.0
"""Time of missed ticks, in ms, after which the model is tested afresh, once the estimate is right again: what they hid
would count as evidence against it."""

_NO_SURPRISE = 0.25
"""Share of the surprise below which nothing is decided, below which what a gap has left over counts as none. An
estimate that is right to a thousandth of the innovation gate takes up to a second, all of it without a test."""

_LONGEST_PREDICTION_MS = 1000.0
"""Time for which missed ticks are predicted one by one: a tick after a suspension of hours must not take seconds."""

_NOISE_DEVIATIONS = 3.0
"""Standard deviations of the measured position by which an encoder has to go on for its axis to move."""

_FADING = 0.998
"""Share that is left 10 ms later of the speed by which the model is judged: a time constant of 5 s."""


class Motion:
    """Runs the law on what the drive reports.

    Parameters
    ----------
    design
        Gains, observer and settings.
    drive
        What the drive reports.
    resolution
        Step in which the encoder's position is reported, in axis unit; 0 if it has none.

    Attributes
    ----------
    law
        The law that drives the axis, with its observer.
    nominal
        The same law on a free-running model of the plant: the response that the axis is designed to give.
    blind
        Whether the feedback is no longer believed: the model alone brings the axis to rest.
    predicted
        Ticks in which the model had to stand in for a sample, so far.
    implausible
        Samples in a row, up to now, that lay farther from their prediction than the limit.
    implausible_distance
        How far the last of them did, in axis unit.
    model_monitor
        Whether the plant answers the effort as the model says.
    unchanged_effort
        By how much the effort (effort unit) has changed since the encoder last showed another position, and differs
        from what holds the axis at rest.
    plant
        What the law has found out of the plant.
    """

    def __init__(self, design: AxisDesign, drive: DriveReport, resolution: float) -> None:
        self.law = design.build_law()
        self.nominal = design.build_nominal_law()
        self.plant = LearnedPlant(design, self.law)
        self.predicted = 0
        self.implausible_distance = 0.0
        self.model_monitor = design.build_model_monitor()
        self._gap = SampleGap(design)
        self._braking = BrakingEstimate(design)
        self._load = StandingLoad(design)
        self._gain = design.settings.plant.gain
        self._friction = 0.0  # of the stop, in effort unit s/axis unit
        limits = design.settings.limits
        self._longest_prediction = max(limits.missed_ticks, design.ticks(_LONGEST_PREDICTION_MS))
        self._long_gap_ticks = design.ticks(_LONG_GAP_MS)
        self._fading = kept_in(_FADING, design.period_s)
        self._drive = drive
        self._rest_velocity = design.rest_velocity
        self._jerk = design.jerk
        self._limits = design.settings.limits
        self._date = SampleDate(self.law.observer, drive, design.period_s)
        # Of the law, taken for what acts: for one tick even if a trip held it back.
        self._effort = ActedEffort(self.law, self._date, design.period_s)
        self._resolution = 1.5 * resolution
        noise: float = design.noise.measurement_variance**0.5
        self._tracking = Tracking(self.law.observer, drive, self._gate, noise)
        self._least_motion = max(self._resolution, _NOISE_DEVIATIONS * noise)
        self._recent: deque[float] = deque(maxlen=design.ticks(design.settings.limits.stall_time_ms) + 1)
        self._forget()

    def _forget(self) -> None:
        """Begin with nothing seen of a motion."""
        self.blind = False
        self.implausible = 0
        self.unchanged_effort = 0.0
        # The last sample that was another, its effort, and the one that would have held the axis at rest then.
        self._unchanged: tuple[float, float, float] | None = None
        self._skipped = 0  # ticks missed since the last sample that was not from before them
        self._shown: float | None = None  # by the encoder, in axis unit
        self._stands = False  # whether it was the same a sample before
        self._stands_at: float | None = None  # where the encoder stood still when it was given up
        self._speed_of_late = 0.0
        self._tracking.forget_outlier()
        self._recent.clear()

    def start(self, effort: float = 0.0) -> None:
        """Hold from here on; the observer has been tracking the axis, on which `effort` (effort unit) acts."""
        self.law.start(effort)
        self._effort.start(effort)
        self.nominal.continue_from(self.law)
        self.model_monitor.start(self.law.observer, effort)
        self._gap.close()
        self._braking.start(self.law.observer, effort)
        self._load.start()
        self.law.limit_effort(self._limits.effort)
        self._forget()

    def set_target(self, target: float, velocity: float) -> None:
        """Set the target in axis unit, with a cruise velocity in axis unit/s."""
        if self.law.stage is Stage.POSITION and abs(self.law.observer.velocity) <= self._rest_velocity:
            self.model_monitor.forget_gains(self.law.observer)
        if self.law.stage is Stage.POSITION and abs(self.nominal.observer.velocity) <= self._rest_velocity:
            # What held a plant off its model at the speed of the last move is no load of this one.
            self.nominal.continue_from(self.law)
        self.law.set_target(target, velocity)
        self.nominal.set_target(target, velocity)

    def stop(self, deceleration: float, *, smooth: bool = False) -> None:
        """Come to rest with a deceleration in axis unit/s²; what the axis should do now is judged from here on.

        `smooth` is for a stop that has time for the jerk that the settings give: none after a trip, nor a quick one.
        """
        if not self.blind:
            self._braking.apply(self.law.observer, in_doubt=False)
        observer = self.law.observer
        friction = self._friction = self._load.friction(observer.velocity, observer.disturbance)
        if smooth and not self.blind and isinstance(self.law, SmoothLaw) and math.isfinite(self._jerk):
            self.law.stop(deceleration, friction, gradual=True, jerk=self._jerk)
        else:
            self.law.stop(deceleration, friction, gradual=not self.blind)
        if self._stands_at is not None:  # what holds the axis, if it is not the encoder, must bear no more than it does
            self.law.limit_effort(max(abs(self.law.effort), self._limits.stall_effort))
        self.nominal.continue_from(self.law)

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self.law.shift(distance)
        self.nominal.shift(distance)
        self.model_monitor.shift(distance)
        self._tracking.shift(distance)
        if self._unchanged is not None:
            position, effort, holding = self._unchanged
            self._unchanged = position + distance, effort, holding
        if self._shown is not None:
            self._shown += distance
        if self._stands_at is not None:
            self._stands_at += distance
        for _ in range(len(self._recent)):
            self._recent.append(self._recent.popleft() + distance)

    def expected_position(self, *, driven: bool) -> float | None:
        """Return where the axis is by the estimate, in axis unit; None while that follows nothing."""
        return self.law.observer.position if driven or self._tracking.is_on else None

    def begin_tick(self, missed: int) -> None:
        """Open a tick, before which some were missed."""
        self._date.begin_tick(missed)

    def act_late(self, share: float) -> None:
        """Account for the last effort having begun to act late, by a share of a period, in which the one before did."""
        self._effort.begin_late(share)

    def skip(self, periods: int) -> None:
        """Account for ticks that were missed.

        Where a long suspension has left the axis nobody can predict: beyond a second, and what the limits allow, the
        estimate stays as it is then.
        """
        law, periods = self.law, min(periods, self._longest_prediction)
        self._date.begin_gap()
        self._skipped += periods
        for _ in range(periods):
            acted = self._effort.mean
            self._gap.miss(law.observer, acted)
            self._effort.tell_law()
            law.skip(1)
            self._date.record_missed()
            self.model_monitor.predict(acted)
        self.nominal.skip(periods)

    def step(self) -> float:
        """Run the law for a tick and return the effort in effort unit."""
        acted = self._effort.mean
        sample = self._believed_sample(acted)
        if self._drive.fresh:
            shown, self._shown = self._shown, self._drive.position
            self._stands = shown is not None and abs(shown - (self._shown or 0.0)) <= self._resolution
        lag = self._date.lag_periods
        if sample is not None and lag:
            self._gap.reopen(lag, self.law.observer, acted)
        elif sample is not None:
            self._gap.accept()
        self._effort.tell_law()
        effort = self.law.step(sample)
        self._effort.give(effort)
        self.nominal.step(None)
        if sample is None:
            self.predicted += 1
        if sample is None or lag:  # one from before a gap says nothing of how the plant has answered since
            self.model_monitor.predict(acted)
        elif self._skipped >= self._long_gap_ticks:
            self.model_monitor.start(self.law.observer, acted)
            if self._gap.surprise <= _NO_SURPRISE * self.model_monitor.least:
                self._skipped = 0
        else:
            self._skipped = 0
            # By the speed of the whole move: what a wrong pole does shows while the axis slows down.
            self._speed_of_late = max(self._fading * self._speed_of_late, abs(self.law.observer.velocity))
            shown = self._drive.position
            assert shown is not None  # noqa: S101 - the sample is made from it
            self.model_monitor.update(shown, acted, self.law.observer, self._speed_of_late, self._date.lag_s)
        self.plant.tell(self.model_monitor)
        if sample is not None:
            self._compare_with_the_last()
        self._record_load()
        corrected = sample is not None and not lag
        self._braking.update(
            self.law.observer, effort, corrected=corrected, sure=corrected and self.model_monitor.is_sure
        )
        return effort

    def track(self) -> None:
        """Let the observer follow the axis while no effort acts, so that arming starts from its position and speed."""
        effort = self._effort.last
        self._effort.give(0.0)
        self.implausible = 0
        self._tracking.step(effort, blind=self.blind)
        self.blind = False

    @property
    def knows_speed(self) -> bool:
        """Whether enough samples have been seen in a row to say how fast the axis goes."""
        return self._tracking.knows_speed

    @property
    def doubts_sample(self) -> bool:
        """Whether the latest sample is not where the model expects it, and may be a spike."""
        return self._tracking.was_outlier or self.implausible > 0

    def ignore_feedback(self) -> None:
        """Believe no feedback from here on: the model alone brings the axis to rest."""
        self._braking.apply(self.law.observer, in_doubt=self.implausible > 0)
        self.blind = True
        self._stands_at = self._shown if self._stands else None

    def distrust(self) -> None:
        """Give up the estimate as well as the feedback, and go on from what the model says of the speed.

        An encoder that shows one and the same position is taken to stand still, whichever hypothesis has told it first.
        """
        factor = 0.0 if self._stands else self.model_monitor.better_factor or 0.0
        reckoning = self.model_monitor.reckon(factor)
        self.ignore_feedback()
        self.law.resume_at(reckoning.velocity, reckoning.disturbance)  # also where a stop has begun by the former one

    @property
    def moves_after_all(self) -> bool:
        """Whether an encoder that seemed to stand still shows motion: then the axis was stalled, and is free now."""
        position = self._drive.position if self._drive.fresh else None
        if self._stands_at is None or position is None:
            return False
        return abs(position - self._stands_at) > self._least_motion

    @property
    def cannot_stop(self) -> bool:
        """Whether, by the model alone, what a stop may give does not bring the axis to rest: a load pushes it on.

        That load has been estimated by an encoder that lied. Where there is none, the effort would drive the axis the
        other way for as long as a stop may take.
        """
        law, observer = self.law, self.law.observer
        if not self.blind or law.stage is not Stage.BRAKE:
            return False
        load = observer.disturbance - self._friction * observer.velocity  # what is left of it at rest
        return load * self._gain * observer.velocity > 0.0 and abs(load) >= law.effort_limit

    @property
    def recent_way(self) -> float:
        """How far apart the samples of the last stall time lie, in axis unit; infinity while there are not enough."""
        recent = self._recent
        return max(recent) - min(recent) if len(recent) == recent.maxlen else math.inf

    def lose_track(self) -> None:
        """Start the observer afresh at the next sample: what it holds is not to be built on."""
        self._tracking.lose()

    @property
    def innovation_gate(self) -> float:
        """How far a sample may lie from its prediction at the present speed and after a gap, in axis unit."""
        return self._gate(self.law.observer.velocity) + self._gap.allowance

    @property
    def following_error(self) -> float:
        """Estimated position minus the position that the axis is designed to have now, in axis unit."""
        return self.law.observer.position - self.nominal.observer.position

    @property
    def finite(self) -> bool:
        """Whether effort and estimate are numbers."""
        observer = self.law.observer
        return math.isfinite(self.law.effort + observer.position + observer.velocity + observer.disturbance)

    def _gate(self, velocity: float) -> float:
        return self._limits.innovation_gate + 1e-3 * self._limits.innovation_time_ms * abs(velocity)

    def _record_load(self) -> None:
        observer, stage = self.law.observer, self.law.stage
        if stage is Stage.POSITION:
            if self.model_monitor.is_sure:  # what a wrong encoder makes the observer hold is no load
                self._load.update(observer)
        elif self._stands and stage is Stage.BRAKE and not self.blind:
            # It stands by friction, or its encoder has frozen. What seems to hold it then must not be compensated: the
            # axis would creep on behind an encoder that shows nothing.
            observer.correct(observer.velocity, self._load.load)

    def _compare_with_the_last(self) -> None:
        """Compare what the encoder shows, not dated: an encoder that stands still has no speed to date it by.

        An effort that only holds the load drives nothing: with it an axis that has braked within its encoder's last
        step stays there.
        """
        sample, effort = self._drive.position, self._effort.last
        assert sample is not None  # noqa: S101 - the caller has one
        if self._unchanged is None or abs(sample - self._unchanged[0]) > self._resolution:
            self._unchanged = sample, effort, -self._load.load
        _, before, holding = self._unchanged
        self.unchanged_effort = min(abs(effort - before), abs(effort - holding))
        self._recent.append(sample)

    def _believed_sample(self, acted: float) -> float | None:
        """Return this tick's sample; None if there is none, or none that lies where the model expects it.

        `acted` is the effort of the period before, in effort unit.
        """
        sample, observer = self._date.sample(self._effort.before), self.law.observer
        if self.blind:
            return None
        if sample is None:
            self._gap.miss(observer, acted)
            return None
        distance, gate = sample - observer.position, self.innovation_gate
        if abs(distance) <= gate or self._is_expected(sample, gate):
            self.implausible = 0
            return sample
        self.implausible += 1
        self.implausible_distance = distance
        self._gap.doubt()
        return None

    def _is_expected(self, sample: float, gate: float) -> bool:
        """Whether a sample (axis unit) lies as near to where the plant that has been identified says that the axis is.

        One that is far off its model brakes by other distances than the model says.
        """
        expected = self.plant.expected_position
        return expected is not None and abs(sample - expected) <= gate
