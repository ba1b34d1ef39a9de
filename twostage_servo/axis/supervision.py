"""What an axis under control is held to on every tick: limits, position window, and the response it is designed for."""

import math
from collections.abc import Iterator

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.motion import IMPLAUSIBLE_SAMPLES, Motion
from twostage_servo.axis.state import BRAKING, State
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.laws.law import Stage

Violation = tuple[TripCode, str]

_QUICK = frozenset({State.QUICK_STOPPING, State.TRIPPED_QUICK_STOP})

_CERTAIN_STALL_SHARE = 0.5
"""Share of the stall time that is enough where nothing explains the samples but an encoder that stands still."""

_BRAKING_PATIENCE = 2.0
"""How many times its designed duration a braking may take."""


class Supervision:
    """Compares the axis with its limits and with its nominal law, which runs on a model of the plant beside it.

    The following error is the distance between the two. It may be as large as the minimum, or proportional to the
    speed of the move: in the speed stage, which does not feed the position back, a plant that differs from its model
    drifts off in proportion to the speed.

    Parameters
    ----------
    design
        Limits, position window, units and gains.
    motion
        The law that drives the axis, and the same law on the model.
    """

    __slots__ = (
        "_braking_ticks",
        "_braking_ticks_allowed",
        "_changeover_time_s",
        "_design",
        "_effort_before",
        "_motion",
        "_saturation_ticks",
        "_settings",
        "_speed_of_move",
        "_stall_ticks",
        "_ticks_frozen",
        "_ticks_in_window",
        "_ticks_saturated",
        "_ticks_stalled",
        "_window_ticks",
    )  # fmt: skip

    def __init__(self, design: AxisDesign, motion: Motion) -> None:
        self._design = design
        settings = self._settings = design.settings
        self._motion = motion
        self._saturation_ticks = design.ticks(settings.limits.effort_saturation_ms)
        self._stall_ticks = design.ticks(settings.limits.stall_time_ms)
        self._window_ticks = design.ticks(settings.window.time_ms)
        self._changeover_time_s = design.law.changeover_time_s
        self._ticks_in_window = 0
        self.start()

    def start(self) -> None:
        """Begin afresh: at arming, and when a stop takes over."""
        self._ticks_saturated = self._ticks_stalled = self._ticks_frozen = 0
        self._braking_ticks = 0
        self._braking_ticks_allowed: float = math.inf
        self.forget_move()
        self.begin_move()

    def forget_move(self) -> None:
        """Allow no more than at standstill from here on: the axis has arrived or come to rest."""
        self._speed_of_move = 0.0

    def begin_move(self) -> None:
        """Begin a move from rest: wait for the position window, and compare the effort with that of now."""
        self.change_move()
        self._effort_before = self._motion.law.effort

    def change_move(self) -> None:
        """Begin to wait for the position window anew: the set-point is another one, in mid-move."""
        self._ticks_in_window = 0

    def begin_braking(self, deceleration: float, *, smooth: bool = False) -> None:
        """Begin to wait for the axis to come to rest with a deceleration in axis unit/s²; smoothed, if it is."""
        self.start()
        duration_s = self._design.stopping_time_s(self._motion.law.observer.velocity, deceleration, smooth=smooth)
        self._braking_ticks_allowed = _BRAKING_PATIENCE * duration_s / self._design.period_s

    def has_arrived(self, position: float) -> bool:
        """Whether a fresh measured position (axis unit) has been in the position window for its time; once a tick."""
        window = self._settings.window.position
        target, designed = self._motion.law.target, self._motion.nominal.observer
        # A slow response may cross the window for longer than its dwell: the designed one has to be at rest there too.
        inside = (
            abs(target - position) <= window
            and abs(target - designed.position) <= window
            and abs(designed.velocity) * self._changeover_time_s <= window
        )
        self._ticks_in_window = self._ticks_in_window + 1 if inside else 0
        return self._ticks_in_window > self._window_ticks

    def violations(self, state: State, *, referenced: bool) -> Iterator[Violation]:
        """Yield code and cause of each limit that the axis breaks in this tick; call it once a tick.

        Parameters
        ----------
        state
            What the axis is doing: a search for a hard stop is meant to be stopped by it, and a quick stop is already
            the best that can be done near a position limit.
        referenced
            Whether positions can be trusted; else the position limits mean nothing.
        """
        yield from self._speed()
        seeks_a_stop = state is State.HOMING and self._settings.homing.method == "hard_stop"
        if not self._motion.blind:
            yield from self._innovation_gate()
            yield from self._model(seeks_a_stop=seeks_a_stop)
        if state in BRAKING:
            yield from self._braking()
            if referenced and not self._motion.blind and state not in _QUICK:  # which could do no better
                yield from self._position()
            if state is State.TRIPPED_STOPPING and not self._motion.blind:
                yield from self._following()  # it ends disabled in any case: rather by a quick stop than late
            return
        if seeks_a_stop:
            return
        if referenced and state is not State.HOMING:
            yield from self._position()
        yield from self._stall()
        yield from self._frozen()
        yield from self._following()
        yield from self._saturation()

    def _speed(self) -> Iterator[Violation]:
        velocity, limit = self._motion.law.observer.velocity, self._settings.limits.overspeed
        if not abs(velocity) <= limit:
            unit = self._settings.unit
            yield (
                TripCode.OVERSPEED,
                f"the estimated velocity is {velocity:.4g} {unit}/s; axis.limits.overspeed is {limit:g}",
            )

    def _braking(self) -> Iterator[Violation]:
        self._braking_ticks += 1
        if self._braking_ticks > self._braking_ticks_allowed:
            observer, period_s = self._motion.law.observer, self._design.period_s
            yield (
                TripCode.BRAKING_FAILED,
                (
                    f"after {1e3 * self._braking_ticks * period_s:g} ms of braking the axis still moves at "
                    f"{observer.velocity:.4g} {self._settings.unit}/s; "
                    f"{1e3 * self._braking_ticks_allowed * period_s:.4g} ms are allowed"
                ),
            )

    def _innovation_gate(self) -> Iterator[Violation]:
        motion, unit = self._motion, self._settings.unit
        if motion.implausible >= IMPLAUSIBLE_SAMPLES:
            yield (
                TripCode.POSITION_JUMP,
                (
                    f"{motion.implausible} consecutive measured positions differ from their prediction by up to "
                    f"{motion.implausible_distance:+.4g} {unit}, at {motion.law.observer.position:.6g} {unit} and "
                    f"{motion.law.observer.velocity:.4g} {unit}/s: the encoder jumped, froze or counts wrongly; "
                    f"{motion.innovation_gate:.3g} {unit} is allowed (axis.limits.innovation_gate)"
                ),
            )

    def _position(self) -> Iterator[Violation]:
        """Trip while a quick stop still ends within the overrun."""
        limits, unit = self._settings.limits, self._settings.unit
        position, velocity = self._motion.law.observer.position, self._motion.law.observer.velocity
        distance = self._design.certain_stopping_distance(velocity, limits.quick_stop_deceleration)
        distance += abs(velocity) * self._design.period_s  # until the next look
        ahead = math.copysign(distance, velocity)
        lowest, highest = min(position, position + ahead), max(position, position + ahead)
        overrun = limits.position_overrun
        if not (lowest >= limits.position_minimum - overrun and highest <= limits.position_maximum + overrun):
            yield (
                TripCode.POSITION_LIMIT,
                (
                    f"the axis is at {position:.6g} {unit}, moves at {velocity:.4g} {unit}/s and needs "
                    f"{abs(ahead):.4g} {unit} "
                    f"to stop; its limits are {limits.position_minimum:g} to "
                    f"{limits.position_maximum:g} {unit}, with an "
                    f"overrun of {limits.position_overrun:g} {unit}"
                ),
            )

    def _stall(self) -> Iterator[Violation]:
        """Watch for an axis that stands still against an effort, by the way that its samples show."""
        limits, law, motion = self._settings.limits, self._motion.law, self._motion
        rest, unit, effort_unit = self._design.rest_velocity, self._settings.unit, self._settings.effort_unit
        stuck = (
            abs(law.effort - self._effort_before) >= limits.stall_effort  # without the load that it held before
            and motion.recent_way <= rest * self._stall_ticks * self._design.period_s
            and abs(motion.nominal.observer.velocity) > rest
        )
        self._ticks_stalled = self._ticks_stalled + 1 if stuck else 0
        if self._ticks_stalled >= self._stall_ticks:
            yield (
                TripCode.STALL,
                (
                    f"the axis has not moved from {law.observer.position:.6g} {unit} for "
                    f"{limits.stall_time_ms:g} ms, although the effort has changed from "
                    f"{self._effort_before:.4g} to {law.effort:.4g} {effort_unit}; "
                    f"axis.limits.stall_effort is {limits.stall_effort:g}"
                ),
            )

    def _frozen(self) -> Iterator[Violation]:
        """Watch for an encoder that shows one position while the effort changes; half the time where certain."""
        limits, motion = self._settings.limits, self._motion
        unit, effort_unit = self._settings.unit, self._settings.effort_unit
        frozen = motion.unchanged_effort >= limits.stall_effort
        self._ticks_frozen = self._ticks_frozen + 1 if frozen else 0
        if self._ticks_frozen >= self._stall_ticks or (
            self._ticks_frozen >= _CERTAIN_STALL_SHARE * self._stall_ticks and motion.model_monitor.seems_to_stand
        ):
            yield (
                TripCode.STALL,
                (
                    f"the encoder has reported the same position, {motion.law.observer.position:.6g} {unit}, "
                    f"while the effort changed by {motion.unchanged_effort:.4g} {effort_unit}; "
                    f"axis.limits.stall_effort is {limits.stall_effort:g}"
                ),
            )

    def _model(self, *, seeks_a_stop: bool) -> Iterator[Violation]:
        """Watch whether encoder and plant do what they should; an axis that seeks a hard stop may be held up by it."""
        test, unit = self._motion.model_monitor, self._settings.unit
        factor = test.better_factor
        if factor is None or (seeks_a_stop and 0.0 <= factor < 1.0):
            return
        surprise = f"the model and plants like it have recently been off by {test.surprise:.3g} {unit}"
        if factor == 0.0:
            at = f"{self._motion.law.observer.position:.6g} {unit}"
            yield TripCode.STALL, f"the encoder froze at {at} from one sample to the next: {surprise}"
            return
        what = "the sign" if factor < 0.0 else "the scale"
        yield (
            TripCode.SIGN_REVERSED if factor < 0.0 else TripCode.MODEL_MISMATCH,
            (
                f"{factor:g} times the motion that the model predicts fits the samples far better: {surprise}; "
                f"{what} of encoder or effort is wrong, or the model in [axis.plant]"
            ),
        )

    def _following(self) -> Iterator[Violation]:
        limits, unit = self._settings.limits, self._settings.unit
        error = self._motion.following_error
        self._speed_of_move = max(self._speed_of_move, abs(self._motion.nominal.observer.velocity))
        at_speed = limits.following_error_time_s * self._speed_of_move
        allowed = max(limits.following_error_minimum, at_speed)
        if not abs(error) <= allowed:
            by_speed = f" in a motion at up to {self._speed_of_move:.4g} {unit}/s" if allowed == at_speed else ""
            yield (
                TripCode.FOLLOWING_ERROR,
                (
                    f"the following error at {self._motion.law.observer.position:.6g} {unit} is {error:.4g} {unit}; "
                    f"{allowed:.4g} {unit} is allowed{by_speed}"
                ),
            )

    def _saturation(self) -> Iterator[Violation]:
        limits, law = self._settings.limits, self._motion.law
        self._ticks_saturated = self._ticks_saturated + 1 if law.saturated else 0
        if self._ticks_saturated >= self._saturation_ticks:
            in_speed = law.stage is Stage.SPEED
            what = (
                f"{law.cruise_velocity:.4g} {self._settings.unit}/s cannot be reached"
                if in_speed
                else "look for a load or an obstacle"
            )
            yield (
                TripCode.SPEED_UNREACHABLE if in_speed else TripCode.EFFORT_SATURATED,
                (
                    f"the effort has been at its limit of {limits.effort:g} {self._settings.effort_unit} for "
                    f"{limits.effort_saturation_ms:g} ms, "
                    f"at {law.observer.velocity:.4g} {self._settings.unit}/s: {what}"
                ),
            )
