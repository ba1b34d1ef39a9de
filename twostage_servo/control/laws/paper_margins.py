"""Poles and stability margins of the loop that really runs: observer, transport of one period, sum and all.

The loop is broken at the effort. With ``z = [x_o; I]`` the controller is ``z(k+1) = A_c z(k) + B_c y(k)`` and
``u(k) = C_c z(k)``, equations (26), (29) and (30); the plant closes it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from twostage_servo.control.laws.law import Controller, Stage
from twostage_servo.control.laws.stop import braking_gain
from twostage_servo.control.observer import KalmanGain, NoiseModel, extended_model
from twostage_servo.control.optimal import ServoGains
from twostage_servo.control.plant import DiscretePlant

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Matrix = NDArray[np.float64]

_FREQUENCIES = 20_000


@dataclass(frozen=True, slots=True)
class Margins:
    """Margins of one stage's loop.

    Attributes
    ----------
    gain_margin
        Factor by which the loop gain may grow before it becomes unstable; infinity if none does.
    gain_reduction_margin
        Factor (below 1) down to which the loop gain may fall before it becomes unstable; 0 if none does.
    phase_margin_deg
        Smallest phase in degrees that makes the loop unstable; infinity where the gain never passes 1.
    delay_margin_s
        Additional delay in s that makes the loop unstable; infinity where the gain never passes 1.
    modulus_margin
        Smallest distance of the loop's frequency response from -1, at most 1 for most loops.
    spectral_radius
        Largest magnitude of the closed loop's poles, apart from the position in the speed stage, which is not fed back.
    """

    gain_margin: float
    gain_reduction_margin: float
    phase_margin_deg: float
    delay_margin_s: float
    modulus_margin: float
    spectral_radius: float

    @property
    def stable(self) -> bool:
        """Whether every closed-loop pole lies inside the unit circle."""
        return self.spectral_radius < 1.0


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


def stage_controller(
    model: DiscretePlant, gains: ServoGains, kalman: KalmanGain, noise: NoiseModel, stage: Stage
) -> Controller:
    """Return a stage's controller in plain numbers, with the place where its set-point enters: the sum of the error."""
    a_c, b_c, c_c = (
        tuple(tuple(map(float, row)) for row in matrix) for matrix in controller(model, gains, kalman, noise, stage)
    )
    if stage is Stage.BRAKE:
        return Controller(a_c, b_c, c_c)
    enters = ((0.0,), (0.0,), (0.0,), (gains.f22,))
    return Controller(a_c, b_c, c_c, enters, "position" if stage is Stage.POSITION else "velocity")


def closed_loop_poles(
    model: DiscretePlant,
    gains: ServoGains,
    kalman: KalmanGain,
    noise: NoiseModel,
    stage: Stage,
    plant: DiscretePlant | None = None,
) -> list[complex]:
    """Return the poles of a stage's closed loop: 6 in the position stage, 5 in the speed stage, 4 in a stop.

    Only the position stage feeds the position back. In the others one pole at exactly 1 is left out: moving axis and
    estimate together changes nothing. Parameters as in :func:`loop_margins`.
    """
    import numpy as np  # noqa: PLC0415 - see servo_gains

    a_c, b_c, c_c = controller(model, gains, kalman, noise, stage)
    a_p, b_p, c_p = _plant_matrices(plant or model)
    poles = np.linalg.eigvals(np.block([[a_p, b_p @ c_c], [b_c @ c_p, a_c]]))
    if stage is not Stage.POSITION:
        poles = np.delete(poles, np.argmin(np.abs(poles - 1.0)))
    return [complex(pole) for pole in poles]


def loop_margins(
    model: DiscretePlant,
    gains: ServoGains,
    kalman: KalmanGain,
    noise: NoiseModel,
    stage: Stage,
    plant: DiscretePlant | None = None,
    frequencies: int = _FREQUENCIES,
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
    import numpy as np  # noqa: PLC0415 - see servo_gains

    a_c, b_c, c_c = controller(model, gains, kalman, noise, stage)
    a_p, b_p, c_p = _plant_matrices(plant or model)
    angles = np.geomspace(1e-5, np.pi, frequencies)
    response = -_frequency_response(a_p, b_p, c_p, angles) * _frequency_response(a_c, b_c, c_c, angles)
    magnitude, phase = np.abs(response), np.unwrap(np.angle(response))
    upper, lower = _gain_margins(magnitude, phase)
    phase_margin, delay = _phase_margins(magnitude, phase, angles)
    return Margins(
        gain_margin=upper,
        gain_reduction_margin=lower,
        phase_margin_deg=float(np.degrees(phase_margin)),
        delay_margin_s=float(delay * model.period_s),
        modulus_margin=float(np.min(np.abs(1.0 + response))),
        spectral_radius=max(abs(pole) for pole in closed_loop_poles(model, gains, kalman, noise, stage, plant)),
    )


def _plant_matrices(plant: DiscretePlant) -> "tuple[Matrix, Matrix, Matrix]":
    import numpy as np  # noqa: PLC0415 - see servo_gains

    a_p = np.array([[1.0, plant.a12], [0.0, plant.a22]])
    return a_p, np.array([[plant.b1], [plant.b2]]), np.array([[1.0, 0.0]])


def _frequency_response(a: "Matrix", b: "Matrix", c: "Matrix", angles: "Matrix") -> "NDArray[np.complex128]":
    import numpy as np  # noqa: PLC0415 - see servo_gains

    points = np.exp(1j * angles)[:, None, None]
    solved = np.linalg.solve(points * np.eye(len(a)) - a, np.broadcast_to(b, (len(angles), *b.shape)))
    return np.asarray((c @ solved)[:, 0, 0])


def _gain_margins(magnitude: "Matrix", phase: "Matrix") -> tuple[float, float]:
    import numpy as np  # noqa: PLC0415 - see servo_gains

    turns = (phase - np.pi) / (2.0 * np.pi)  # a whole number where the response is real and negative
    crossings = np.nonzero(np.floor(turns[:-1]) != np.floor(turns[1:]))[0]
    factors = []
    for index in crossings:
        level = max(np.floor(turns[index]), np.floor(turns[index + 1]))
        share = (level - turns[index]) / (turns[index + 1] - turns[index])
        factors.append(1.0 / float(magnitude[index] ** (1.0 - share) * magnitude[index + 1] ** share))
    return min((f for f in factors if f > 1.0), default=np.inf), max((f for f in factors if f < 1.0), default=0.0)


def _phase_margins(magnitude: "Matrix", phase: "Matrix", angles: "Matrix") -> tuple[float, float]:
    import numpy as np  # noqa: PLC0415 - see servo_gains

    logarithm = np.log(magnitude)
    crossings = np.nonzero(np.sign(logarithm[:-1]) != np.sign(logarithm[1:]))[0]
    margin, delay = np.inf, np.inf
    for index in crossings:
        share = -logarithm[index] / (logarithm[index + 1] - logarithm[index])
        angle = angles[index] + share * (angles[index + 1] - angles[index])
        at_crossing = phase[index] + share * (phase[index + 1] - phase[index])
        lag = (at_crossing - np.pi) % (2.0 * np.pi)  # how far the phase may fall before it meets -180 degrees
        margin = min(margin, lag, 2.0 * np.pi - lag)
        delay = min(delay, lag / angle)
    return float(margin), float(delay)
