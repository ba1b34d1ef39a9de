"""Section IV in the paper's own matrices, with a switch for each way to read its print.

This is the proposed law a second time, written for the reader who has the paper beside it: equations in their order and
their matrices, no limit, no stop, moves from rest only. Read as corrected it gives the efforts of
:class:`~twostage_servo.control.laws.paper.TwoStageLaw` to rounding, which the tests hold; read as printed it shows what
each slip would do. What drives machines is the former alone.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from twostage_servo.control.laws.law import Stage
from twostage_servo.control.observer import KalmanGain, NoiseModel, extended_model, kalman_gain
from twostage_servo.control.optimal import WEIGHTS, ServoGains, incremental_model, servo_gains
from twostage_servo.control.plant import DiscretePlant, Triple

Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Reading:
    """How the print is read. Every default is the corrected form; numbers are those of the list of errata.

    Attributes
    ----------
    cost
        What (11) weighs: the state ``x_p``, which is incremental already, or as printed its increment (erratum 1).
    feedback_sign
        -1, or +1 as printed in (12), (14), (15), (29), (30), (33) and (34) (erratum 2).
    weights
        Diagonal of Q / q (erratum 3).
    disturbance_memory
        Lower right entry of A_o in (25): 1, or 0 as printed (erratum 5).
    observer_form
        ``predictor``: (26) with A_o K. ``filter``: K, applied to the sample of the same tick, before the effort leaves.
        ``mixed``: as printed, K of (27) in (26) (erratum 6).
    covariance
        (28) with ``- X``, or as printed without (erratum 7).
    process_variance
        Diagonal of G W G' (erratum 8).
    speed_stage_sum
        What the integrator adds up in the speed stage: ``v - x_o2``, or as printed in (14) ``r - y`` (erratum 10).
    offset_gain
        What M is multiplied with in (33): F_1, or as printed F_2 (erratum 11).
    offset
        M: minus the estimate at the tick of the change-over, or as printed in (32) ``-(r - p)`` (erratum 12).
    changeover_on
        What (18) takes the distance from: the estimate of this tick, or as printed the last sample (erratum 17).
    """

    cost: Literal["state", "increment"] = "state"
    feedback_sign: Literal[-1, 1] = -1
    weights: Triple = WEIGHTS
    disturbance_memory: float = 1.0
    observer_form: Literal["predictor", "filter", "mixed"] = "predictor"
    covariance: Literal["steady state", "as printed"] = "steady state"
    process_variance: Triple = (0.1, 0.1, 0.1)
    speed_stage_sum: Literal["velocity error", "position error"] = "velocity error"
    offset_gain: Literal["F1", "F2"] = "F1"
    offset: Literal["estimate", "set-point"] = "estimate"
    changeover_on: Literal["estimate", "sample"] = "estimate"


class UnsolvableError(ValueError):
    """Read in this way, an equation of the paper has no solution."""


def read_gains(plant: DiscretePlant, ratio: float, reading: Reading) -> ServoGains:
    """Solve (11) as it is read.

    Raises
    ------
    UnsolvableError
        For the cost on the increment. With Δx_p in place of x_p only changes of e are weighed, so a constant error
        costs nothing: f22 comes out as 0, and the pole of the sum stays at z = 1.
    """
    if reading.cost == "state":
        return servo_gains(plant, ratio, reading.weights)
    state, effort = incremental_model(plant)
    # x_p(k+1) - x_p(k) = (A_p - I) x_p(k) + B_p Δu(k): a cost on state and effort with a cross term.
    change = state - np.eye(3)
    weight = ratio * np.diag(reading.weights)
    effort_cost, cross_cost = 1.0 + effort.T @ weight @ effort, change.T @ weight @ effort
    try:
        cost = solve_discrete_are(state, effort, change.T @ weight @ change, effort_cost, s=cross_cost)
    except ValueError as error:  # the pole of the sum cannot be put inside the circle, nor outside
        raise UnsolvableError(
            f"(11) with the cost on the increment of x_p cannot be solved: a constant error costs nothing ({error})"
        ) from error
    f = np.linalg.solve(effort_cost + effort.T @ cost @ effort, effort.T @ cost @ state + cross_cost.T)
    slowest = float(np.max(np.abs(np.linalg.eigvals(state - effort @ f))))
    raise UnsolvableError(
        f"(11) with the cost on the increment of x_p gives f22 = {abs(f[0, 2]):.0e} and a pole of magnitude "
        f"{slowest:.6f}: a constant error costs nothing, so nothing removes it"
    )


def read_kalman_gain(plant: DiscretePlant, measurement_variance: float, reading: Reading) -> KalmanGain:
    """Solve (28) and (27) as they are read.

    Raises
    ------
    UnsolvableError
        For (28) without ``- X`` when G W G' > 0: for any covariance X >= 0 its left side is what a filter predicts,
        ``A_o P A_o' + G W G'`` with P >= 0, and that is not 0.
    """
    if reading.covariance == "as printed":
        raise UnsolvableError("(28) without - X has no solution X >= 0: its left side is at least G W G', and never 0")
    return kalman_gain(plant, NoiseModel(reading.process_variance, measurement_variance, reading.disturbance_memory))


class TranscribedLaw:
    """The law of Fig. 1, equations (22)-(34), for a move from rest.

    Parameters
    ----------
    model
        The sampled plant of (1).
    ratio
        Performance index ratio q/R.
    measurement_variance
        R_o, in (axis unit)².
    reading
        How the print is read.

    Attributes
    ----------
    stage
        The stage that made the last effort.
    velocity
        x_o2, in axis unit/s.

    Raises
    ------
    UnsolvableError
        If, read in this way, there are no gains.
    """

    def __init__(
        self, model: DiscretePlant, ratio: float, measurement_variance: float, reading: Reading | None = None
    ) -> None:
        reading = reading or Reading()
        gains = read_gains(model, ratio, reading)
        kalman = read_kalman_gain(model, measurement_variance, reading)
        self._reading = reading
        self._a_o, self._b_o, self._c_o = extended_model(model, reading.disturbance_memory)
        self._k = np.array(kalman.predictor if reading.observer_form == "predictor" else kalman.current).reshape(3, 1)
        self._f1_speed = np.array([[0.0, gains.f12, 0.0]])
        self._f1_position = np.array([[gains.f11, gains.f12, 0.0]])
        self._f2 = gains.f22
        self._f1_of_offset = gains.f11 if reading.offset_gain == "F1" else gains.f22
        self._changeover_time = gains.changeover_time_s(model.period_s)
        self._x_o = np.zeros((3, 1))
        self._effort = self._sum = self._offset = self._target = self._reference = self._distance = 0.0
        self.sample_age = 0 if reading.observer_form == "filter" else 1
        self.changeovers = 0
        self.stage = Stage.SPEED

    @property
    def velocity(self) -> float:
        """Estimated velocity x_o2 that the last effort was made with, in axis unit/s."""
        return float(self._x_o[1, 0])

    def set_target(self, target: float, velocity: float) -> None:
        """Set the set-point r (axis unit) and the magnitude of v (axis unit/s) of a move from rest."""
        distance = target - float(self._x_o[0, 0])
        self._target = target
        self._reference = float(np.copysign(velocity, distance))
        self._distance = velocity * self._changeover_time
        short = abs(distance) <= self._distance
        self.stage = Stage.POSITION if short else Stage.SPEED
        self._offset = -float(self._x_o[0, 0])

    def step(self, sample: float) -> float:
        """Process ``y(k-1)``, in the filter form ``y(k)``, in axis unit; return the effort ``u(k)`` in effort unit.

        The sum that acts at tick k ends with ``e(k-1)``, whichever sample that is.
        """
        filter_form = self._reading.observer_form == "filter"
        self._observe(sample)
        if self.stage is Stage.POSITION and not filter_form:
            self._sum += self._target - sample
        if self.stage is Stage.SPEED and self._at_changeover(sample):
            self._change_over()
        self._effort = self._feedback() + self._f2 * self._sum
        if self.stage is Stage.SPEED:
            velocity_error = self._reading.speed_stage_sum == "velocity error"
            self._sum += self._reference - self.velocity if velocity_error else self._target - sample
        elif filter_form:
            self._sum += self._target - sample
        return self._effort

    def _feedback(self) -> float:
        """Equations (29) and (30), with the term of M of (33)."""
        if self.stage is Stage.SPEED:
            feedback = self._f1_speed @ self._x_o
        else:
            feedback = self._f1_position @ self._x_o + self._f1_of_offset * self._offset
        return self._reading.feedback_sign * float(feedback.item())

    def _observe(self, sample: float) -> None:
        """Equation (26), or the filter form with the same gain (27)."""
        if self._reading.observer_form == "filter":
            self._x_o = self._a_o @ self._x_o + self._b_o * self._effort
            self._x_o = self._x_o + self._k * (sample - self._c_o @ self._x_o)
        else:
            innovation = sample - self._c_o @ self._x_o
            self._x_o = self._a_o @ self._x_o + self._b_o * self._effort + self._k * innovation

    def _at_changeover(self, sample: float) -> bool:
        direction = float(np.copysign(1.0, self._reference))
        position = float(self._x_o[0, 0]) if self._reading.changeover_on == "estimate" else sample
        return direction * (self._target - position) <= self._distance  # (18)

    def _change_over(self) -> None:
        direction = float(np.copysign(1.0, self._reference))
        if self._reading.offset == "estimate":
            self._offset = -float(self._x_o[0, 0])
        else:
            self._offset = -(self._target - direction * self._distance)  # (32)
        self.stage = Stage.POSITION
        self.changeovers += 1
