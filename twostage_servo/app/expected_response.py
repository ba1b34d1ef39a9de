"""What a move will be like before anything moves: a whole axis, on a plant that is as its model or is not."""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.messages import DriveTraits, Feedback
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.time_optimal import Capability
from twostage_servo.simulation.plant import TruePlant

CRUISE_S: Final = 4.0
"""How long the longest cruise is that is looked at: a longer one adds nothing."""
SHORT: Final = 50.0
"""Length of a short move, in position windows."""
_SETTLED_SHARE: Final = 1e-3
"""Of a move's length, within which it counts as settled, where that is more than the position window."""
_LONGEST_TICKS: Final = 60_000
"""A move that has not settled by then is not looked at any longer."""
_CALM_S: Final = 0.3
_CALM_SHARE: Final = 0.3
"""For how long, in s, an axis has to be nearer to its set-point than this share of the band, and not to leave it."""
_ARMING_TICKS: Final = 1_000
_HELD_TICKS: Final = 50
"""What an axis holds for before it moves."""


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """A move from rest.

    Attributes
    ----------
    distance, velocity
        In axis unit and axis unit/s; both greater than 0.
    """

    distance: float
    velocity: float

    def band(self, window: float) -> float:
        """Return within which distance of the set-point the move counts as settled, in axis unit."""
        return max(_SETTLED_SHARE * self.distance, window)


@dataclass(frozen=True, slots=True)
class Response:
    """What a move comes to; of several responses the worst value of each.

    Attributes
    ----------
    settling_time_s
        Until the true position stays within the band; None if it does not.
    overshoot
        Beyond the set-point, in axis unit.
    peak_velocity, peak_effort
        Magnitudes, in axis unit/s and effort unit.
    trip
        Code of the trip that ended the move; None for none.
    """

    settling_time_s: float | None
    overshoot: float
    peak_velocity: float
    peak_effort: float
    trip: TripCode | None = None


@dataclass(frozen=True, slots=True)
class Expectation:
    """A move, and what will become of it.

    Attributes
    ----------
    move
        The move.
    bound_s
        No law settles earlier on the plant of the model: speed, effort and acceleration do not allow it.
    nominal
        On the plant of the model.
    worst
        Over the plants of the stated uncertainty.
    """

    move: PlannedMove
    bound_s: float
    nominal: Response
    worst: Response


def configured_move(axis: AxisSettings, velocity: float) -> PlannedMove:
    """Return the move that `demo` makes from 0: four seconds of cruise, as far as the position limits allow.

    Parameters
    ----------
    axis
        Its settings.
    velocity
        Of the cruise, in axis unit/s.
    """
    return PlannedMove(_within_limits(axis, CRUISE_S * velocity), velocity)


def corner_moves(axis: AxisSettings) -> list[PlannedMove]:
    """Return a short and a long move, with the cruise velocity and with the velocity limit."""
    short = _within_limits(axis, SHORT * axis.window.position)
    moves = [
        PlannedMove(distance, velocity)
        for velocity in (axis.cruise_velocity, axis.limits.velocity)
        for distance in (short, _within_limits(axis, CRUISE_S * velocity))
    ]
    return [move for index, move in enumerate(moves) if move not in moves[:index]]


def _within_limits(axis: AxisSettings, distance: float) -> float:
    return min(distance, axis.limits.position_maximum - axis.limits.position_minimum)


def expect(design: AxisDesign, traits: DriveTraits, move: PlannedMove, uncertainty: float) -> Expectation:
    """Return what will become of a move.

    Parameters
    ----------
    design, traits
        The axis, and what is known of its drive.
    move
        The move.
    uncertainty
        By which share gain and pole may be off the model, at least 0 and less than 1.
    """
    nominal = respond(design, traits, move)
    others = [respond(design, traits, move, *factors) for factors in _corners(uncertainty)]
    return Expectation(move, bound_s(design, move), nominal, worst_of([nominal, *others]))


def _corners(uncertainty: float) -> Iterator[tuple[float, float]]:
    if uncertainty > 0.0:
        ends = (1.0 - uncertainty, 1.0 + uncertainty)
        yield from itertools.product(ends, ends)


def bound_s(design: AxisDesign, move: PlannedMove) -> float:
    """Return when the quickest move within speed, effort and acceleration reaches the band, in s."""
    settings = design.settings
    whole = abs(settings.plant.gain) * settings.limits.effort
    capability = Capability(whole, whole, settings.plant.pole, settings.limits.acceleration)
    return capability.quickest_move(move.distance, move.velocity, move.band(settings.window.position)).bound_s


def worst_of(responses: Iterable[Response]) -> Response:
    """Return the worst value of each figure."""
    found = list(responses)
    settling = [one.settling_time_s for one in found if one.settling_time_s is not None]
    return Response(
        settling_time_s=max(settling) if len(settling) == len(found) else None,
        overshoot=max(one.overshoot for one in found),
        peak_velocity=max(one.peak_velocity for one in found),
        peak_effort=max(one.peak_effort for one in found),
        trip=next((one.trip for one in found if one.trip is not None), None),
    )


def respond(
    design: AxisDesign, traits: DriveTraits, move: PlannedMove, gain_factor: float = 1.0, pole_factor: float = 1.0
) -> Response:
    """Return what a move comes to on a plant that is off its model by two factors.

    The axis is a whole one, with every limit, on an encoder without noise; its drive obeys and answers every command.

    Raises
    ------
    Refused
        If the axis takes no such move (:class:`twostage_servo.axis.refusals.Refused`).
    """
    return trace(design, traits, move, gain_factor, pole_factor)[0]


def trace(
    design: AxisDesign, traits: DriveTraits, move: PlannedMove, gain_factor: float = 1.0, pole_factor: float = 1.0
) -> "tuple[Response, list[TracePoint]]":
    """Return the same as :func:`respond`, and each tick of the move."""
    bench = _Bench(design, traits, move, gain_factor, pole_factor)
    bench.arm()
    return bench.run(), bench.points


def traces(
    design: AxisDesign, traits: DriveTraits, move: PlannedMove, uncertainty: float
) -> "dict[str, list[TracePoint]]":
    """Return each tick of a move on the plant of the model and on those at the corners of an uncertainty, by name."""
    found = {"as the model": trace(design, traits, move)[1]}
    for gain, pole in _corners(uncertainty):
        found[f"gain {100.0 * (gain - 1.0):+.0f} %, pole {100.0 * (pole - 1.0):+.0f} %"] = trace(
            design, traits, move, gain, pole
        )[1]
    return found


class TracePoint(NamedTuple):
    """A tick of a move: time in s, error of the position in axis unit, velocity in axis unit/s, effort."""

    time_s: float
    error: float
    velocity: float
    effort: float


class _Bench:
    """An axis at a drive that obeys."""

    def __init__(
        self, design: AxisDesign, traits: DriveTraits, move: PlannedMove, gain_factor: float, pole_factor: float
    ) -> None:
        settings = design.settings
        homing = settings.homing.model_copy(update={"required": False})
        unhomed = replace(design, settings=settings.model_copy(update={"homing": homing}))
        self._move = move
        self._window = settings.window.position
        self._period_s = design.period_s
        self._quantum = traits.position_quantum
        self._counter, self._modulus = 0, traits.counter_modulus
        self._tells_enabled = traits.tells_enabled
        self._ticks = 0
        self.points: list[TracePoint] = []
        # Where the encoder wraps round does not matter to a move.
        self._axis = Axis(unhomed, replace(traits, position_period=0.0, has_heartbeat=False))
        limits, plant = settings.limits, settings.plant
        start = max(limits.position_minimum, min(0.0, limits.position_maximum - move.distance))
        self._plant = TruePlant(plant.gain * gain_factor, plant.pole * pole_factor, position=start)
        self._sample = start
        self._enabled = False
        watched_s = 2.0 * design.law.move_duration_s(move.distance, move.velocity, self._window)
        self._watched_ticks = min(_LONGEST_TICKS, round(100.0 + watched_s / design.period_s))

    def arm(self) -> None:
        """Let the axis hold where it is."""
        self._tick()
        self._tick()
        self._axis.arm()
        for _ in range(_ARMING_TICKS):
            self._tick()
            if self._axis.state is State.HOLDING:
                break
        for _ in range(_HELD_TICKS):
            self._tick()

    def run(self) -> Response:
        """Move, and watch until the axis has come to rest; or in vain, for twice as long as that should take."""
        move, plant = self._move, self._plant
        start = plant.position
        target, band = start + move.distance, move.band(self._window)
        self._axis.move_to(target, move.velocity)
        outside = 0
        overshoot = peak_velocity = peak_effort = 0.0
        ticks, calm_ticks, enough = 0, 0, round(_CALM_S / self._period_s)
        while ticks < self._watched_ticks and calm_ticks < enough:
            ticks += 1
            way_to_go = abs(plant.position - target) + abs(plant.velocity) * _CALM_S
            calm_ticks = calm_ticks + 1 if way_to_go < _CALM_SHARE * band else 0
            effort = self._tick()
            self.points.append(TracePoint(ticks * self._period_s, plant.position - target, plant.velocity, effort))
            peak_effort = max(peak_effort, abs(effort))
            peak_velocity = max(peak_velocity, abs(plant.velocity))
            overshoot = max(overshoot, plant.position - target)
            if abs(plant.position - target) > band:
                outside = ticks
            if self._axis.trip is not None:
                return Response(None, overshoot, peak_velocity, peak_effort, self._axis.trip.code)
        settled = (outside + 1) * self._period_s if outside < ticks else None
        return Response(settled, overshoot, peak_velocity, peak_effort)

    def _tick(self) -> float:
        """Let a tick pass; return the effort that acted in it."""
        self._ticks += 1
        self._counter = (self._counter + 1) % self._modulus
        counter = self._counter if self._modulus > 1 else None
        self._axis.begin_tick(self._ticks, 0)
        self._axis.accept_feedback(Feedback(self._sample, counter, self._enabled if self._tells_enabled else None))
        command = self._axis.step()
        self._enabled = bool(command.enable)
        position = self._plant.position
        self._sample = self._quantum * round(position / self._quantum) if self._quantum else position
        effort = command.effort if self._enabled else 0.0
        self._plant.advance(self._period_s, effort)
        return effort
