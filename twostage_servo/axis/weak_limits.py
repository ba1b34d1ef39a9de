"""Limits that are valid, and so wide that what they stand for is not protected: each against the axis' own scale.

And one that may be so narrow that a healthy axis trips. Nothing is refused here: a limit may be wide on purpose. Two
scales serve: how far the axis goes at its largest velocity (against ``position_overrun``, in which it must come to
rest), and how long it takes to cross its whole travel.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

from twostage_servo.axis.admission import slowest_velocity
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.feedback import WINDOW_TICKS
from twostage_servo.control.plant import MODEL_ERROR

_CROSSED: Final = "at its largest velocity the axis crosses its whole travel in {0:.4g} ms"
_LARGE_SHARE: Final = 0.5
"""Share of the travel that is no longer a tolerance or a way to stop."""


class WeakLimit(NamedTuple):
    """A limit that protects from nothing.

    Attributes
    ----------
    key
        The key below ``axis``.
    value
        What it is set to.
    disables
        What it should tell or prevent, and does not.
    do
        What to do.
    """

    key: tuple[str, ...]
    value: float
    disables: str
    do: str


def weak_limits(
    design: AxisDesign, resolution: float, *, heartbeat: bool, is_cyclic: bool = False
) -> Iterator[WeakLimit]:
    """Yield the limits of an axis that disable what they stand for.

    Parameters
    ----------
    design
        The axis.
    resolution
        Step in which the encoder's position is reported, in axis unit; 0 if it has none.
    heartbeat
        Whether the drive has a heartbeat.
    is_cyclic
        Whether the drive samples on its own clock.
    """
    if is_cyclic:
        yield from _dates(design)
    yield from _unseen_travel(design)
    yield from _times(design, heartbeat=heartbeat)
    yield from _stops(design)
    yield from _motion(design)
    yield from _moves(design, resolution)


def _travel(design: AxisDesign) -> float:
    """Return how far it is from one position limit to the other, in axis unit."""
    limits = design.settings.limits
    return limits.position_maximum - limits.position_minimum


def _unseen_travel(design: AxisDesign) -> Iterator[WeakLimit]:
    """Yield what lets the axis go farther unseen than the overrun in which it has to come to rest."""
    settings = design.settings
    limits, unit, travel = settings.limits, settings.unit, _travel(design)
    allowed, speed = min(limits.position_overrun, travel), limits.velocity
    if limits.position_overrun > travel:
        text = f"the position limits: the axis may overrun them by more than its whole travel of {travel:g} {unit}"
        yield WeakLimit(
            ("limits", "position_overrun"), limits.position_overrun, text, f"set the free distance there, in {unit}"
        )
    if limits.undetected_travel is not None and limits.undetected_travel > travel:
        text = f"the bound on travel with a wrong encoder: it exceeds the whole travel of {travel:g} {unit}"
        yield WeakLimit(("limits", "undetected_travel"), limits.undetected_travel, text, "remove it, or lower it")
    for name, duration_s in (
        ("missed_ticks", limits.missed_ticks * design.period_s),
        ("stale_feedback_ms", 1e-3 * limits.stale_feedback_ms),
    ):
        way = speed * duration_s
        if way > allowed:
            what = "a suspended host" if name == "missed_ticks" else "a silent drive"
            per = 1e3 * design.period_s if name == "missed_ticks" else 1.0
            yield WeakLimit(
                ("limits", name),
                getattr(limits, name),
                f"the trip for {what}: at {speed:g} {unit}/s the axis moves {way:.4g} {unit} in that time, and must "
                f"come to rest within {allowed:g} {unit} past its limits",
                f"lower it to {int(1e3 * allowed / speed / per)} at most",
            )
    for name, gate in (
        ("innovation_gate", limits.innovation_gate),
        ("innovation_time_ms", 1e-3 * limits.innovation_time_ms * speed),
    ):
        if gate > allowed:
            yield WeakLimit(
                ("limits", name),
                getattr(limits, name),
                f"the trip for an encoder that jumps: up to {gate:.4g} {unit} are accepted, more than the {allowed:g} "
                f"{unit} in which the axis must come to rest past its limits",
                "set a few times the usual error of a sample",
            )


def _dates(design: AxisDesign) -> Iterator[WeakLimit]:
    """Yield the time by which samples may be misdated, where a frame that misses its tick takes more of it."""
    limits, unit, half_ms = design.settings.limits, design.settings.unit, 500.0 * design.period_s
    if limits.innovation_time_ms < half_ms:
        way = 1e-3 * half_ms * limits.velocity
        yield WeakLimit(
            ("limits", "innovation_time_ms"),
            limits.innovation_time_ms,
            f"moves whose frames come late: the drive samples on its own clock, so that a frame which just misses its "
            f"tick may be dated wrongly by {half_ms:g} ms, {way:.4g} {unit} at {limits.velocity:g} {unit}/s, and a "
            "healthy axis then trips",
            f"set at least {half_ms:g}",
        )


def _times(design: AxisDesign, *, heartbeat: bool) -> Iterator[WeakLimit]:
    """Yield times in which the axis may have gone anywhere."""
    settings, limits = design.settings, design.settings.limits
    crossing_ms = 1e3 * _travel(design) / limits.velocity
    longest: dict[tuple[str, ...], str] = {
        ("limits", "effort_saturation_ms"): "the trip for an effort that stays at its limit",
        ("limits", "stall_time_ms"): "the trip for a stall",
        ("arming_timeout_ms",): "the trip for a drive that does not disable",
        ("jog_timeout_ms",): "the end of a jog whose operator has disconnected",
    }
    if settings.homing.method == "hard_stop":
        longest["homing", "stop_time_ms"] = "the end of the push against a hard stop"
    if heartbeat:
        longest["limits", "heartbeat_ms"] = "the trip for a drive whose firmware hangs"
    for key, what in longest.items():
        value = _value(settings, key)
        if value > crossing_ms:
            yield WeakLimit(key, value, f"{what}: {_CROSSED.format(crossing_ms)}", "lower it well below that")
    if min(crossing_ms, limits.effort_saturation_ms) < limits.stall_time_ms <= crossing_ms:
        text = "the trip for a stall: effort_saturation_ms is shorter, so the trip for saturation comes first"
        yield WeakLimit(("limits", "stall_time_ms"), limits.stall_time_ms, text, "lower it below effort_saturation_ms")
    stale_ticks = design.ticks(limits.stale_feedback_ms)
    most = WINDOW_TICKS * (stale_ticks - 1) / stale_ticks
    if most < limits.feedback_errors and stale_ticks > 1:
        text = f"the trip for bad frames: with more than {most:.0f} in {WINDOW_TICKS} ticks the feedback is stale first"
        yield WeakLimit(("limits", "feedback_errors"), limits.feedback_errors, text, f"lower it to {int(most)} at most")


def _stops(design: AxisDesign) -> Iterator[WeakLimit]:
    """Yield what makes a stop take so long that it is none."""
    limits, unit, half = design.settings.limits, design.settings.unit, _LARGE_SHARE * _travel(design)
    for name, what in (("acceleration", "a stop"), ("quick_stop_deceleration", "a quick stop")):
        deceleration = getattr(limits, name)
        distance = design.stopping_distance(limits.velocity, deceleration)
        if distance <= half:
            continue
        at_once = limits.velocity**2 / (2.0 * deceleration)
        slow_effort = at_once <= half  # it is not the ramp that is too long
        key = "effort_rate" if slow_effort else name
        yield WeakLimit(
            ("limits", key),
            getattr(limits, key),
            f"{what}: from {limits.velocity:g} {unit}/s it takes {distance:.4g} {unit}, and the whole travel is "
            f"{2.0 * half:g} {unit}",
            "raise it to what drive and machine can take",
        )
        if slow_effort:
            return


def _motion(design: AxisDesign) -> Iterator[WeakLimit]:
    """Yield bounds that no motion of this axis comes to."""
    settings = design.settings
    limits, unit, travel = settings.limits, settings.unit, _travel(design)
    fastest = abs(settings.plant.gain) * limits.effort / settings.plant.pole
    if limits.overspeed > (1.0 + MODEL_ERROR) * fastest:
        yield WeakLimit(
            ("limits", "overspeed"),
            limits.overspeed,
            f"the trip for overspeed: at full effort the axis reaches {fastest:.4g} {unit}/s, and "
            f"{100.0 * MODEL_ERROR:.0f} % more if its plant is off its model",
            f"lower it; about {1.25 * limits.velocity:g} is usual",
        )
    for name, error in (
        ("following_error_minimum", limits.following_error_minimum),
        ("following_error_time_s", limits.following_error_time_s * limits.velocity),
    ):
        if error > _LARGE_SHARE * travel:
            yield WeakLimit(
                ("limits", name),
                getattr(limits, name),
                f"the trip for following error: {error:.4g} {unit} are allowed, and the whole travel is "
                f"{travel:g} {unit}",
                "set a few times the following error of an ordinary move",
            )


def _moves(design: AxisDesign, resolution: float) -> Iterator[WeakLimit]:
    """Yield what makes the end of a move, or its way, say nothing."""
    settings = design.settings
    unit, travel = settings.unit, _travel(design)
    window, changeover = settings.window.position, design.changeover_distance(settings.cruise_velocity)
    if window > min(changeover, travel):
        text = (
            f"the outcome `reached`: the position stage of a move begins {changeover:.4g} {unit} before the set-point, "
            "so it counts as reached immediately"
        )
        yield WeakLimit(("window", "position"), window, text, "set the largest error that your work tolerates")
    if window < 0.5 * resolution:
        text = f"the outcome `reached`: the encoder has steps of {resolution:g} {unit}, so few moves end in the window"
        yield WeakLimit(("window", "position"), window, text, f"set at least {resolution:g}")
    approach, homing = settings.approach, settings.homing
    if approach.direction != "either" and approach.distance > _LARGE_SHARE * travel:
        text = f"short moves: from the other side they first overshoot by this; the whole travel is {travel:g} {unit}"
        yield WeakLimit(("approach", "distance"), approach.distance, text, "set a few times the backlash")
    if homing.method != "set_here" and homing.travel > 2.0 * (travel + settings.limits.position_overrun):
        text = f"the end of a search that finds nothing: the whole travel is {travel:g} {unit}"
        yield WeakLimit(("homing", "travel"), homing.travel, text, "set the longest search that may be needed")
    slowest = slowest_velocity(design, resolution)
    for key in (("cruise_velocity",), ("homing", "velocity"), ("homing", "slow_velocity")):
        if _value(settings, key) < slowest:
            text = f"motion: at less than {slowest:.3g} {unit}/s the axis does not move one encoder step in an hour"
            yield WeakLimit(key, _value(settings, key), text, "raise it")


def _value(settings: object, key: tuple[str, ...]) -> float:
    for name in key:
        settings = getattr(settings, name)
    assert isinstance(settings, float)  # noqa: S101 - all of them are declared so
    return settings
