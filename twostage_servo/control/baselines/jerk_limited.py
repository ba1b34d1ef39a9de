"""A profile of limited jerk, followed with feed-forward, state feedback and a disturbance observer.

The profile is that of Ruckig: L. Berscheid and T. Kröger, Jerk-limited Real-time Trajectory Generation with Arbitrary
Target States, Robotics: Science and Systems 2021. It needs the package ``ruckig``, of the extra ``bench``.
"""

from typing import Final

from ruckig import InputParameter, Result, Ruckig, Trajectory

from twostage_servo.control.baselines.profile_following import ProfileServo
from twostage_servo.control.baselines.state_feedback import FEEDBACK_PARAMETERS, OBSERVER_PARAMETERS
from twostage_servo.control.baselines.tunable import Parameter, TunableLawType, Values
from twostage_servo.control.laws.law import ControlTask

_PARAMETERS: Final = {
    "acceleration_share": Parameter(0.02, 0.3, 2.0, "acceleration, as a share of what the effort limit gives at rest"),
    "jerk_time_s": Parameter(0.002, 0.02, 0.2, "time in which the acceleration builds up, s"),
}


class JerkLimited:
    """Seven parts of constant jerk.

    Parameters
    ----------
    start, target
        In axis unit.
    velocity, acceleration, jerk
        Largest, in axis unit/s, axis unit/s² and axis unit/s³.
    period_s
        The tick, in s.

    Raises
    ------
    ValueError
        If Ruckig finds no profile, with its result.
    """

    def __init__(
        self, start: float, target: float, velocity: float, acceleration: float, jerk: float, period_s: float
    ) -> None:
        asked = InputParameter(1)
        asked.current_position, asked.target_position = [start], [target]
        asked.max_velocity, asked.max_acceleration, asked.max_jerk = [velocity], [acceleration], [jerk]
        self._trajectory = Trajectory(1)
        result = Ruckig(1).calculate(asked, self._trajectory)
        if result not in {Result.Working, Result.Finished}:
            raise ValueError(f"no profile of limited jerk from {start:g} to {target:g}: {result}")
        self._target, self._period_s = target, period_s
        self._end = self._trajectory.duration

    def at(self, tick: int) -> tuple[float, float]:
        """Return position and velocity, so many ticks after the beginning."""
        time_s = tick * self._period_s
        if time_s >= self._end:
            return self._target, 0.0
        (position,), (velocity,), _ = self._trajectory.at_time(time_s)
        return position, velocity


def _build(task: ControlTask, values: Values) -> ProfileServo:
    most = abs(task.plant.gain) * task.effort_limit
    acceleration = min(values["acceleration_share"] * most, task.acceleration_limit)
    jerk = acceleration / values["jerk_time_s"]

    def plan(start: float, target: float, velocity: float) -> JerkLimited:
        return JerkLimited(start, target, velocity, acceleration, jerk, task.period_s)

    return ProfileServo(task, values, plan)


JERK_LIMITED: Final = TunableLawType({**_PARAMETERS, **FEEDBACK_PARAMETERS, **OBSERVER_PARAMETERS}, _build)
