"""How far an axis goes until a change of its encoder is certain, found with its own law and its own tests.

A turned or rescaled encoder is told by what it surprises the model by: ``(f - 1) v T`` in the first sample after it
counts f times as much. Against the noise that the observer is set up for, that takes a speed, and then a few ticks. So
the travel follows from speed, gain, noise and tick, and not from how wide the innovation gate is.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from twostage_servo.axis.design import AxisDesign, DesignError
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.messages import DriveTraits, Feedback
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.state import State
from twostage_servo.axis.supervision import Supervision
from twostage_servo.axis.trips import RULES

CHANGES = {"reversed": -1.0, "half the scale": 0.5, "twice the scale": 2.0}
"""What the encoder counts after the change, as a multiple of what it should."""

_SETTLING_TICKS = 30
"""Samples of the cruise before the change. Few on a short tick: what is said here has to hold for an axis that has only
just come up to speed, whose estimate is not yet that of the cruise."""

_STOPPING_S = 0.02
"""How long the axis has been stopping when its encoder changes."""

_LONGEST_S = 2.0
"""How long it is waited for certainty."""

_SLOWEST_SHARE = 1e-3
"""Share of the velocity limit below which it is not looked for the slowest speed at which a change is certain."""


_ROUNDING = 1e-9
"""Share by which two travels that are the same may differ where an axis is written in another unit."""


@dataclass(frozen=True, slots=True)
class Detection:
    """One change, and what it costs.

    Attributes
    ----------
    change
        One of :data:`CHANGES`.
    phase
        What the axis did: "cruising" or "stopping".
    velocity
        At which speed, in axis unit/s.
    travel
        How far the axis goes until the change is certain, or until it has come to rest, in axis unit; infinity if it
        goes on and nothing is noticed.
    certain
        Whether the change was told.
    """

    change: str
    phase: str
    velocity: float
    travel: float
    certain: bool


def detections(design: AxisDesign) -> list[Detection]:
    """Return what each change costs at the velocity limit and at the cruise velocity, or what there is room for."""
    settings = design.settings
    limits = settings.limits
    room = limits.position_maximum - limits.position_minimum
    fastest = min(limits.velocity, math.sqrt(limits.acceleration * room))
    speeds = dict.fromkeys((fastest, min(settings.cruise_velocity, fastest)))
    return [
        _detect(design, change, phase, velocity)
        for velocity in speeds
        for phase in ("cruising", "stopping")
        for change in CHANGES
    ]


def slowest_certain_velocity(design: AxisDesign) -> float:
    """Return the speed (axis unit/s) from which on each change in a cruise is told, found by halving.

    On the model's own plant, and slower ones may be told of that. What tells a change of every plant that is accepted
    is that it comes as a jump.
    """
    fastest = design.settings.limits.velocity
    jumps_from = _Run(design, fastest).least_jump_velocity
    slowest, velocity = math.inf, fastest
    while velocity > max(_SLOWEST_SHARE * fastest, jumps_from) and all(
        _detect(design, change, "cruising", velocity).certain for change in CHANGES
    ):
        slowest, velocity = velocity, 0.5 * velocity
    return slowest


def allowed_travel(design: AxisDesign) -> float:
    """Return how far the axis may go by its settings until a change of its encoder is certain, in axis unit."""
    limits = design.settings.limits
    return limits.position_overrun if limits.undetected_travel is None else limits.undetected_travel


def check_detection(design: AxisDesign) -> None:
    """Tell whether a change of the encoder becomes certain soon enough.

    Raises
    ------
    DesignError
        If the axis could go farther than that.
    """
    worst = max(detections(design), key=lambda one: one.travel)
    allowed, unit = allowed_travel(design), design.settings.unit
    if worst.travel <= allowed * (1.0 + _ROUNDING):
        return
    how_far = f"{worst.travel:.4g} {unit}" if math.isfinite(worst.travel) else "any distance"
    noise = design.noise.measurement_variance**0.5
    raise DesignError(
        ("axis", "limits", "position_overrun"),
        f"a change of the encoder ({worst.change}) while the axis is {worst.phase} at {worst.velocity:g} {unit}/s "
        f"would be detected only after {how_far}, and {allowed:.4g} {unit} is allowed. The change is hidden by the "
        f"configured noise, {noise:.3g} {unit} (root of axis.observer.measurement_variance), and by "
        f"axis.limits.innovation_time_ms = {design.settings.limits.innovation_time_ms:g}: lower both to their true "
        f"values, {_remedy(worst, design.period_s)}",
    )


def _remedy(worst: Detection, period_s: float) -> str:
    """Return what else helps: no distance can be stated where the axis goes on for ever."""
    if math.isfinite(worst.travel):
        return "lower the velocity, or state the distance that is acceptable as axis.limits.undetected_travel"
    step = abs(CHANGES[worst.change] - 1.0) * worst.velocity * period_s
    return (
        f"or set axis.limits.innovation_gate below {step:.3g}, the error of such an encoder in one tick; no distance "
        "can be stated here"
    )


class _Run:
    """An axis that cruises, and what its encoder shows."""

    def __init__(self, design: AxisDesign, velocity: float) -> None:
        settings = design.settings
        self._design = design
        self._drive = DriveReport(settings, design.period_s, DriveTraits())
        self._motion = Motion(design, self._drive, 0.0)
        self._supervision = Supervision(design, self._motion)
        self._factor = 1.0
        self._changed_at = self._sample = 0.0
        self.position, self.velocity = velocity * design.period_s, velocity  # a tick after the first sample
        law, cruise_effort = self._motion.law, velocity * settings.plant.pole / settings.plant.gain
        law.observer.correct(velocity, 0.0)
        self._supervision.start()
        self._motion.start(cruise_effort)
        self._motion.set_target(2.0 * velocity * (_LONGEST_S + _SETTLING_TICKS * design.period_s) + 1.0, velocity)
        self._state = State.SPEED_STAGE

    @property
    def least_jump_velocity(self) -> float:
        return self._motion.model_monitor.least_jump_velocity

    def change(self, factor: float) -> None:
        self._factor, self._changed_at = factor, self.position

    def stop(self) -> None:
        self._state = State.STOPPING
        self._motion.stop(self._design.settings.limits.acceleration)

    def tick(self) -> bool:
        """Go on by a tick; return whether the axis has noticed that its encoder is not to be trusted."""
        motion = self._motion
        self._drive.begin_tick(0)
        self._drive.accept_feedback(Feedback(self._sample))
        motion.begin_tick(0)
        effort = motion.step()
        found = any(RULES[code].unreferenced for code, _ in self._supervision.violations(self._state, referenced=False))
        self._sample = self._changed_at + self._factor * (self.position - self._changed_at)
        plant = self._design.plant
        self.position += plant.a12 * self.velocity + plant.b1 * effort
        self.velocity = plant.a22 * self.velocity + plant.b2 * effort
        return found


def _detect(design: AxisDesign, change: str, phase: str, velocity: float) -> Detection:
    run = _Run(design, velocity)
    for _ in range(_SETTLING_TICKS):
        if run.tick():
            unit = design.settings.unit
            raise DesignError(
                ("axis", "law", "type"),
                f"with this law an undisturbed cruise at {velocity:g} {unit}/s looks like one with a faulty encoder, "
                "and the axis would trip: choose another law, or other keys of it",
            )
    if phase == "stopping":
        run.stop()
        for _ in range(design.ticks(1e3 * _STOPPING_S)):
            run.tick()
    run.change(CHANGES[change])
    travel = 0.0
    for position, found in _ticks(run, design.ticks(1e3 * _LONGEST_S), run.position):
        travel = max(travel, position)
        if found:
            return Detection(change, phase, velocity, travel, certain=True)
    at_rest = phase == "stopping" and abs(run.velocity) <= design.rest_velocity
    return Detection(change, phase, velocity, travel if at_rest else math.inf, certain=False)


def _ticks(run: _Run, count: int, start: float) -> Iterator[tuple[float, bool]]:
    for _ in range(count):
        found = run.tick()
        yield abs(run.position - start), found
