"""Margins against python-control, and each against what it promises: the closed loop's poles."""

import control
import numpy as np
import pytest

from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper_margins import closed_loop_poles, controller, loop_margins
from twostage_servo.control.observer import KalmanGain, NoiseModel, kalman_gain
from twostage_servo.control.optimal import ServoGains, servo_gains
from twostage_servo.control.plant import DiscretePlant, Plant

PLANT = Plant(180.0, 14.0).discretise(0.01)
NOISE = NoiseModel()
KALMAN = kalman_gain(PLANT, NOISE)
Loop = tuple[DiscretePlant, ServoGains, KalmanGain, NoiseModel, Stage]


def loop(ratio: float, stage: Stage) -> Loop:
    return PLANT, servo_gains(PLANT, ratio), KALMAN, NOISE, stage


def radius(ratio: float, stage: Stage, factor: float) -> float:
    """Largest pole when the drive's gain is another than the model's, from the closed loop's matrix alone."""
    a_c, b_c, c_c = controller(*loop(ratio, stage))
    a_p = np.array([[1.0, PLANT.a12], [0.0, PLANT.a22]])
    b_p = factor * np.array([[PLANT.b1], [PLANT.b2]])
    closed = np.block([[a_p, b_p @ c_c], [b_c @ np.array([[1.0, 0.0]]), a_c]])
    poles = np.linalg.eigvals(closed)
    if stage is not Stage.POSITION:
        poles = np.delete(poles, np.argmin(np.abs(poles - 1.0)))
    return float(np.max(np.abs(poles)))


@pytest.mark.parametrize("stage", list(Stage))
@pytest.mark.parametrize("ratio", [5e-5, 5e-3])
def test_the_gain_margin_is_where_the_poles_leave_the_unit_circle(ratio: float, stage: Stage) -> None:
    margins = loop_margins(*loop(ratio, stage))
    assert radius(ratio, stage, 0.999 * margins.gain_margin) < 1.0 < radius(ratio, stage, 1.001 * margins.gain_margin)
    assert margins.gain_reduction_margin == 0.0
    assert radius(ratio, stage, 1e-3) < 1.0


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("ratio", [5e-5, 5e-3])
def test_position_stage_margins_are_those_of_python_control(ratio: float) -> None:
    matrices = controller(*loop(ratio, Stage.POSITION))
    law = control.ss(*matrices, 0.0, 0.01)
    plant = control.ss([[1.0, PLANT.a12], [0.0, PLANT.a22]], [[PLANT.b1], [PLANT.b2]], [[1.0, 0.0]], 0.0, 0.01)
    gain, phase, modulus, _, crossover, _ = control.stability_margins(-plant * law)
    margins = loop_margins(*loop(ratio, Stage.POSITION))
    assert margins.gain_margin == pytest.approx(gain, rel=1e-4)
    assert margins.phase_margin_deg == pytest.approx(phase, rel=1e-4)
    assert margins.modulus_margin == pytest.approx(modulus, rel=1e-4)
    assert margins.delay_margin_s == pytest.approx(np.radians(phase) / crossover, rel=1e-4)


@pytest.mark.parametrize("ratio", [5e-5, 5e-3])
def test_the_servo_and_observer_poles_separate(ratio: float) -> None:
    """With the true plant as modelled, the loop's poles are those of the servo design and of the observer."""
    plant, gains, kalman, noise, stage = loop(ratio, Stage.POSITION)
    servo = np.array([[1.0, PLANT.a12, 0.0], [0.0, PLANT.a22, 0.0], [-1.0, 0.0, 1.0]])
    servo -= np.array([[PLANT.b1], [PLANT.b2], [0.0]]) @ np.array([[gains.f11, gains.f12, -gains.f22]])
    estimator = np.array([[1.0, PLANT.a12, PLANT.b1], [0.0, PLANT.a22, PLANT.b2], [0.0, 0.0, 1.0]])
    estimator -= np.array(kalman.predictor).reshape(3, 1) @ np.array([[1.0, 0.0, 0.0]])
    # The sum removes the disturbance's own pole from the estimator's three, and adds none: 2 + 1 servo, 3 estimator.
    expected = np.sort_complex(np.concatenate([np.linalg.eigvals(servo), np.linalg.eigvals(estimator)]))
    ours = np.sort_complex(np.array(closed_loop_poles(plant, gains, kalman, noise, stage)))
    np.testing.assert_allclose(ours, expected, atol=1e-7)


def test_a_drive_stronger_than_its_model_uses_up_the_gain_margin() -> None:
    strong = DiscretePlant(PLANT.period_s, PLANT.a12, PLANT.a22, 3.0 * PLANT.b1, 3.0 * PLANT.b2)
    nominal = loop_margins(*loop(5e-3, Stage.SPEED))
    margins = loop_margins(*loop(5e-3, Stage.SPEED), plant=strong)
    assert nominal.stable
    assert not margins.stable
    assert margins.gain_reduction_margin == pytest.approx(nominal.gain_margin / 3.0, rel=1e-3)
