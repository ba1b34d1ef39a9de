"""Poles and stability margins of the paper's loop as it really runs: observer, transport of one period, sum and all.

With ``z = [x_o; I]`` the controller is ``z(k+1) = A_c z(k) + B_c y(k)`` and ``u(k) = C_c z(k)``, equations (26), (29)
and (30).
"""

from typing import TYPE_CHECKING

from twostage_servo.control.laws.law import Controller, Stage
from twostage_servo.control.laws.margins import FREQUENCIES, Control, Margins, margins_of, poles_of
from twostage_servo.control.laws.stop import braking_gain
from twostage_servo.control.observer import KalmanGain, NoiseModel, extended_model
from twostage_servo.control.optimal import ServoGains
from twostage_servo.control.plant import DiscretePlant

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Matrix = NDArray[np.float64]


def controller(
    model: DiscretePlant, gains: ServoGains, kalman: KalmanGain, noise: NoiseModel, stage: Stage
) -> "tuple[Matrix, Matrix, Matrix]":
    """Return A_c (4x4), B_c (4x1) and C_c (1x4) from position to effort, for a set-point of zero; 3 for 4 in a stop."""
    import numpy as np  # noqa: PLC0415 - see servo_gains

    state, effort, output = extended_model(model, noise.disturbance_memory)
    predictor = np.array(kalman.predictor).reshape(3, 1)
    if stage is Stage.BRAKE:
        feedback = np.array([[0.0, braking_gain(model), 1.0]])
        return state - predictor @ output - effort @ feedback, predictor, -feedback
    in_position = stage is Stage.POSITION
    feedback = np.array([[gains.f11 if in_position else 0.0, gains.f12, 0.0]])
    a_c = np.zeros((4, 4))
    a_c[:3, :3] = state - predictor @ output - effort @ feedback
    a_c[:3, 3:] = effort
    a_c[3, 3] = 1.0
    if not in_position:
        a_c[3, 1] = -gains.f22
    b_c = np.vstack([predictor, [[-gains.f22 if in_position else 0.0]]])
    return a_c, b_c, np.hstack([-feedback, [[1.0]]])


def stage_control(
    model: DiscretePlant, gains: ServoGains, kalman: KalmanGain, noise: NoiseModel, stage: Stage
) -> Control:
    """Return a stage's controller as one whose loop can be looked at."""
    return Control(*controller(model, gains, kalman, noise, stage), feeds_position=stage is Stage.POSITION)


def stage_controller(
    model: DiscretePlant, gains: ServoGains, kalman: KalmanGain, noise: NoiseModel, stage: Stage
) -> Controller:
    """Return a stage's controller in plain numbers, with the place where its set-point enters: the sum of the error."""
    control = stage_control(model, gains, kalman, noise, stage)
    if stage is Stage.BRAKE:
        return control.in_numbers()
    follows = "position" if stage is Stage.POSITION else "velocity"
    return control.in_numbers((0.0, 0.0, 0.0, gains.f22), follows)


def closed_loop_poles(
    model: DiscretePlant,
    gains: ServoGains,
    kalman: KalmanGain,
    noise: NoiseModel,
    stage: Stage,
    plant: DiscretePlant | None = None,
) -> list[complex]:
    """Return the poles of a stage's closed loop: 6 in the position stage, 5 in the speed stage, 4 in a stop.

    Parameters as in :func:`loop_margins`.
    """
    return poles_of(stage_control(model, gains, kalman, noise, stage), plant or model)


def loop_margins(
    model: DiscretePlant,
    gains: ServoGains,
    kalman: KalmanGain,
    noise: NoiseModel,
    stage: Stage,
    plant: DiscretePlant | None = None,
    frequencies: int = FREQUENCIES,
) -> Margins:
    """Compute poles and margins of a stage's loop.

    Parameters
    ----------
    model
        The plant that the observer believes in.
    gains, kalman, noise
        Servo gains, Kalman gain and the noise model that it was designed with.
    stage
        Which stage's loop.
    plant
        The plant that closes the loop; the model itself if absent.
    frequencies
        Points at which the frequency response is looked at; a tenth of the default is within 1 %.
    """
    return margins_of(stage_control(model, gains, kalman, noise, stage), plant or model, frequencies)
