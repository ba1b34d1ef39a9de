"""A PID controller on a trapezoid, with feed-forward of velocity and acceleration.

As in industrial drives; K. J. Åström and T. Hägglund, Advanced PID Control, ISA 2006: derivative with a filter of first
order, the integral stops where the effort is limited. The reference is that of the sample's own instant.
"""

from math import exp
from typing import Final

from twostage_servo.control.baselines.profile_following import AtRest, Profile
from twostage_servo.control.baselines.trapezoid import ACCELERATION_PARAMETERS, Trapezoid, accelerations
from twostage_servo.control.baselines.tunable import Parameter, TunableLawType, Values
from twostage_servo.control.laws.effort_limits import limited_effort
from twostage_servo.control.laws.law import Controller, ControlTask

_PARAMETERS: Final = {
    "frequency": Parameter(
        5.0, 9.0, 80.0, "ω: the gains for three poles there are the measure of the next three, rad/s"
    ),
    "proportional": Parameter(0.2, 1.0, 5.0, "Kp beside 3 ω²/b"),
    "integral": Parameter(0.05, 1.0, 5.0, "Ki beside ω³/b"),
    "derivative": Parameter(0.2, 1.0, 5.0, "Kd beside 3 ω/b"),
    "filter_s": Parameter(0.001, 0.01, 0.1, "time constant of the derivative's filter, s"),
    "feed_forward": Parameter(0.8, 1.0, 1.2, "share of the feed-forward that the model needs"),
}


class ProfilePid:
    """The law of the module, for a task, with a value for each parameter."""

    def __init__(self, task: ControlTask, values: Values) -> None:
        self._task = task
        self._accelerations = accelerations(task, values)
        frequency, gain = values["frequency"], task.plant.gain
        self._kp = values["proportional"] * 3.0 * frequency**2 / gain
        self._ki = values["integral"] * frequency**3 / gain * task.period_s
        self._kd = values["derivative"] * 3.0 * frequency / gain / task.period_s
        self._keeps = exp(-task.period_s / values["filter_s"])
        self._feed_forward = values["feed_forward"]
        self._largest_step = task.effort_rate_limit * task.period_s
        self._effort = self._target = self._error = self._derivative = self._integral = 0.0
        self._profile: Profile = AtRest(0.0)
        self._tick = 0
        self._reference = 0.0  # of the tick before

    def set_target(self, target: float, velocity: float) -> None:
        """Plan a move from the last set-point to another."""
        self._profile = Trapezoid(self._target, target, velocity, *self._accelerations, self._task.period_s)
        self._target, self._tick = target, 0

    def step(self, sample: float) -> float:
        """Process ``y(k-1)``; return ``u(k)``."""
        plant = self._task.sampled
        error = self._reference - sample
        change = (1.0 - self._keeps) * (error - self._error)
        self._derivative = self._keeps * self._derivative + self._kd * change
        self._error = error
        self._reference, velocity = self._profile.at(self._tick)
        self._tick += 1
        ahead = self._profile.at(self._tick)[1]
        forward = self._feed_forward * (ahead - plant.a22 * velocity) / plant.b2
        wanted = forward + self._kp * error + self._integral + self._ki * error + self._derivative
        effort = limited_effort(wanted, self._effort, self._task.effort_limit, self._largest_step).effort
        if effort == wanted:
            self._integral += self._ki * error
        self._effort = effort
        return effort

    def controller(self) -> Controller:
        """Return the PID; its states are the last sample, the integral and the derivative."""
        gain, keeps = self._kd * (1.0 - self._keeps), self._keeps
        return Controller(
            ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (gain, 0.0, keeps)),
            ((1.0,), (-self._ki,), (-gain,)),
            ((-self._kp, 1.0, 1.0),),
        )


PROFILE_PID: Final = TunableLawType({**_PARAMETERS, **ACCELERATION_PARAMETERS}, ProfilePid)
