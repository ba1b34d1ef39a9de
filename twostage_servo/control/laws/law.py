"""What an axis needs of a law, and of the design that a law comes from.

A law turns position samples into efforts. It is told what to do by :meth:`Law.set_target` and :meth:`Law.stop`; what it
does is told by its attributes. The estimate is the observer's, which an axis makes and hands to its law: where nothing
is driven, the axis lets it follow by itself.
"""

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, Protocol, runtime_checkable

from twostage_servo.control.estimate import Estimate
from twostage_servo.control.laws.rejection import Rejection
from twostage_servo.control.observer import DisturbanceObserver, KalmanGain, NoiseModel
from twostage_servo.control.plant import DiscretePlant, Plant
from twostage_servo.portable_error import PortableError


class Stage(enum.IntEnum):
    """What makes the effort: a law with one stage only is in the position stage but for its stops."""

    SPEED = 1
    POSITION = 2
    BRAKE = 3


class Law(Protocol):
    """One axis' law; all positions in axis unit, speeds in axis unit/s, efforts in effort unit.

    Attributes
    ----------
    observer
        Estimates position, velocity and disturbance; :meth:`step` updates it.
    stage
        What made the last effort.
    effort
        The last effort.
    target, cruise_velocity
        The set-point r, and the magnitude of the velocity v that goes with it.
    speed_reference
        The velocity that is asked for now, ramped; 0 where none is.
    saturated
        Whether the effort limit cut the last effort.
    changeovers
        How often it has gone over to the position stage, from a cruise or a stop.
    effort_limit
        Largest magnitude of the effort.
    """

    observer: DisturbanceObserver
    stage: Stage
    effort: float
    target: float
    cruise_velocity: float
    speed_reference: float
    saturated: bool
    changeovers: int
    effort_limit: float

    def start(self, effort: float = 0.0) -> None:
        """Hold the estimated position, as if it had given `effort` so far; the observer has been tracking the axis."""

    def set_target(self, target: float, velocity: float) -> None:
        """Go to a set-point with a cruise velocity greater than 0; the effort stays continuous.

        At rest, in mid-move, and in a stop that has not ended: so a speed override changes the velocity at any time.
        Ends in the position stage.
        """

    def stop(self, deceleration: float, friction: float = 0.0, *, gradual: bool = False) -> None:
        """Come to rest in the brake stage, then hold in the position stage where that is.

        Parameters
        ----------
        deceleration
            In axis unit/s².
        friction
            By how much the disturbance changes with the speed, in effort unit s/axis unit.
        gradual
            Whether the speed falls by a share only at the end, so that a plant off its model does not reverse.
        """

    def step(self, sample: float | None) -> float:
        """Process the sample of the last effort's instant, None where the model must suffice; return the next effort.

        It lies within the limits. What is no number is returned as it is: the axis trips by it.
        """

    def skip(self, periods: int) -> None:
        """Account for periods in which no step was made: the last effort acted on, unseen."""

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` lower; nothing moves."""

    def limit_effort(self, limit: float) -> None:
        """Keep the magnitude of the effort within a limit from the next step on."""

    def resume_at(self, velocity: float, disturbance: float) -> None:
        """Go on from another estimate of velocity and disturbance, in a stop that has begun as well."""

    def continue_from(self, other: Any) -> None:
        """Copy the whole state of another law of the same design, its estimate included."""


@runtime_checkable
class SmoothLaw(Law, Protocol):
    """A law that keeps the jerk of its reference within that of its task: its type says that it smooths."""

    def stop(self, deceleration: float, friction: float = 0.0, *, gradual: bool = False, jerk: float = inf) -> None:
        """Come to rest; as :meth:`Law.stop`.

        Parameters
        ----------
        deceleration, friction, gradual
            As there.
        jerk
            By how much the deceleration changes at most, in axis unit/s³; infinity where the stop has no time for it.
        """


@dataclass(frozen=True, slots=True)
class Learned:
    """What a law has found out of its plant.

    Attributes
    ----------
    gain, pole
        Of the plant that it believes in, in axis unit/s² per effort unit and 1/s.
    delay_ticks
        How many ticks later than designed an effort acts.
    gain_share, pole_share
        Spread of these two with which the next move begins, as shares.
    delay_evidence
        What speaks against that delay (negative) or for it, as twice the logarithm of a ratio of likelihoods.
    load
        What acts against each direction, friction included, in effort unit: forward and backward; None where not known.
    moves
        How many moves it has learned from.
    is_sure
        Whether it controls by that plant as by one that is known.
    rejection
        Why what the last move has shown was not accepted; None where it was, or nothing has been shown yet.
    """

    gain: float
    pole: float
    gain_share: float
    pole_share: float
    delay_ticks: int
    delay_evidence: float
    load: tuple[float | None, float | None]
    moves: int
    is_sure: bool
    rejection: Rejection | None = None


@runtime_checkable
class LearningLaw(Law, Protocol):
    """A law that identifies its plant as it moves it."""

    @property
    def learns(self) -> bool:
        """Whether its settings let it."""

    @property
    def learned(self) -> Learned:
        """What is known by now."""

    @property
    def identified(self) -> Plant | None:
        """The plant that it controls by as by one that is known, the same object until it finds another; None: none."""

    @property
    def plant_estimate(self) -> Estimate:
        """Where the axis is by that plant, a tick after the last sample."""

    def forget(self) -> None:
        """Forget all of it: something was wrong that may have been taken for the plant's own."""

    def recall(self, learned: Learned) -> None:
        """Go on from what a law of the same design has learned, while the axis is not driven.

        Raises
        ------
        ValueError
            If that is nothing that this law could have learned by itself; nothing has changed then.
        """


@dataclass(frozen=True, slots=True)
class ControlTask:
    """What a law is designed for.

    Attributes
    ----------
    plant, sampled
        The model of the plant, and the same sampled.
    period_s
        The tick, in s.
    noise, kalman
        What the observer assumes, and its gain.
    velocity_limit, acceleration_limit
        In axis unit/s and axis unit/s².
    effort_limit, effort_rate_limit
        In effort unit and effort unit/s.
    rest_velocity
        Speed at or below which an axis counts as at rest, in axis unit/s.
    jerk
        Largest slope of the reference's acceleration, in axis unit/s³; infinity for none.
    encoder_step
        Step in which the encoder's position is reported, in axis unit; 0 if it has none.
    """

    plant: Plant
    sampled: DiscretePlant
    period_s: float
    noise: NoiseModel
    kalman: KalmanGain
    velocity_limit: float
    acceleration_limit: float
    effort_limit: float
    effort_rate_limit: float
    rest_velocity: float
    jerk: float = inf
    encoder_step: float = 0.0


class DesignError(PortableError, ValueError):
    """No law can be designed for this task.

    Attributes
    ----------
    key
        The key at fault, below the law's own table.
    """

    def __init__(self, key: tuple[str, ...], message: str) -> None:
        super().__init__(message)
        self.key = key


Rows = tuple[tuple[float, ...], ...]
"""A matrix, row by row."""


@dataclass(frozen=True, slots=True)
class Controller:
    """One stage of a law without its limits, as a linear system from the position to the effort, sampled.

    ``z(k+1) = a z(k) + b y(k) + set_point r(k)``, ``u(k) = c z(k)``.

    Attributes
    ----------
    a, b, c
        Its matrices.
    set_point
        The column by which the set-point enters; empty where there is none, as in a stop.
    follows
        What follows the set-point: ``"position"`` or ``"velocity"``; empty where there is none.
    """

    a: Rows
    b: Rows
    c: Rows
    set_point: Rows = ()
    follows: str = ""


@dataclass(frozen=True, slots=True)
class Loop:
    """How stable one stage's loop is.

    Attributes
    ----------
    gain_margin, gain_reduction_margin
        Factors by which the loop gain may grow, and to which it may fall.
    phase_margin_deg, delay_margin_s
        Phase in degrees, and delay in s, that would make it unstable.
    modulus_margin
        Smallest distance of the loop's frequency response from -1.
    poles
        Of the closed loop, the slowest first.
    controller
        The law of the stage, to be looked at more closely; None where the law does not say.
    """

    gain_margin: float
    gain_reduction_margin: float
    phase_margin_deg: float
    delay_margin_s: float
    modulus_margin: float
    poles: tuple[complex, ...]
    controller: Controller | None = None


class LawDesign(Protocol):
    """What follows from the settings of a law for a task, computed once when they are loaded.

    Attributes
    ----------
    changeover_time_s
        Distance from the set-point at which the position stage begins, for each axis unit/s of the speed, in s.
    settling_time_s
        How long the end of a stop takes to die down to a hundredth, in s.
    """

    @property
    def changeover_time_s(self) -> float: ...  # noqa: D102 - see the class

    @property
    def settling_time_s(self) -> float: ...  # noqa: D102 - see the class

    def changeover_distance(self, velocity: float) -> float:
        """Return how far before the set-point the position stage begins after a cruise, in axis unit.

        Parameters
        ----------
        velocity
            Of the cruise, in axis unit/s, not negative.
        """

    def build(self, observer: DisturbanceObserver) -> Law:
        """Return a law within the task's limits, that holds where the observer says that the axis is."""

    def move_duration_s(self, distance: float, velocity: float, window: float) -> float:
        """Return how long a move from rest takes until it is within a window of its set-point for good, in s.

        Parameters
        ----------
        distance, window
            In axis unit; the distance is larger than the window.
        velocity
            Cruise velocity in axis unit/s.
        """

    def stopping_distance(self, velocity: float, deceleration: float) -> float:
        """Return how far the plant of the model goes in a stop, in axis unit, not negative.

        Parameters
        ----------
        velocity
            Speed from which it stops, in axis unit/s.
        deceleration
            In axis unit/s².
        """

    def certain_stopping_distance(self, velocity: float, deceleration: float) -> float:
        """Return how far an axis goes at most whose plant is off its model; as :meth:`stopping_distance`."""

    def stopping_time_s(self, velocity: float, deceleration: float) -> float:
        """Return how long a stop takes until the axis rests, in s."""

    def gains(self) -> Mapping[str, float]:
        """Return the law's gains by their names, to be shown."""

    def origin(self) -> str:
        """Return what the gains follow from, in a few words; empty if nothing has to be said."""

    def loops(self) -> Mapping[str, Loop]:
        """Return how stable each stage is by its name; none where the law does not say."""
