"""A reference that moves along a profile, feed-forward, state feedback and a disturbance observer.

What almost every industrial controller does. The profile is computed at the set-point's arrival; at each tick

``u = u_ff + f1 (x_r - x1) + f2 (v_r - x2) - x3`` with ``u_ff = (v_r(k+1) - a22 v_r(k)) / b2``,

so the model of the plant follows the reference's speed exactly from tick to tick.
"""

from collections.abc import Callable
from typing import Protocol

from twostage_servo.control.baselines.state_feedback import (
    linear_controller,
    tuned_feedback,
    tuned_observer,
    tuned_observer_gain,
)
from twostage_servo.control.baselines.tunable import Values
from twostage_servo.control.laws.effort_limits import limited_effort
from twostage_servo.control.laws.law import Controller, ControlTask


class Profile(Protocol):
    """A reference from rest to rest."""

    def at(self, tick: int) -> tuple[float, float]:
        """Return position in axis unit and velocity in axis unit/s, so many ticks after its beginning."""


class AtRest:
    """A reference that stays where it is, at a position in axis unit."""

    def __init__(self, position: float) -> None:
        self._position = position

    def at(self, tick: int) -> tuple[float, float]:  # noqa: ARG002 - it is the same at each
        """Return the position and no velocity."""
        return self._position, 0.0


Planner = Callable[[float, float, float], Profile]
"""From start and target in axis unit and the cruise velocity in axis unit/s to a profile."""


class ProfileServo:
    """Follows profiles with feed-forward, state feedback and a disturbance observer.

    Parameters
    ----------
    task
        What it is designed for.
    values
        Of :data:`~twostage_servo.control.baselines.state_feedback.OBSERVER_PARAMETERS` and ``FEEDBACK_PARAMETERS``.
    planner
        Plans a move.
    """

    def __init__(self, task: ControlTask, values: Values, planner: Planner) -> None:
        self._task = task
        self._planner = planner
        self._gain = tuned_observer_gain(task, values)
        self._observer = tuned_observer(task, values)
        self._f1, self._f2 = tuned_feedback(task, values)
        self._largest_step = task.effort_rate_limit * task.period_s
        self._effort = self._target = 0.0
        self._profile: Profile = AtRest(0.0)
        self._tick = 0

    def set_target(self, target: float, velocity: float) -> None:
        """Plan a move from the last set-point to another."""
        self._profile = self._planner(self._target, target, velocity)
        self._target = target
        self._tick = 0

    def step(self, sample: float) -> float:
        """Process ``y(k-1)``; return ``u(k)``."""
        observer, plant = self._observer, self._task.sampled
        observer.update(sample, self._effort)
        position, velocity = self._profile.at(self._tick)
        self._tick += 1
        ahead = self._profile.at(self._tick)[1]
        wanted = (
            (ahead - plant.a22 * velocity) / plant.b2
            + self._f1 * (position - observer.position)
            + self._f2 * (velocity - observer.velocity)
            - observer.disturbance
        )
        self._effort = limited_effort(wanted, self._effort, self._task.effort_limit, self._largest_step).effort
        return self._effort

    def controller(self) -> Controller:
        """Return observer and feedback."""
        return linear_controller(self._task.sampled, self._gain, (self._f1, self._f2, 1.0))
