"""Numbers that the paper prints or the documentation names, as they are there."""

from twostage_servo.control.baselines.transcription import Reading
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper import SPEED_TOLERANCE
from twostage_servo.control.laws.stop import BRAKING_SHARE, REST_TICKS, braking_gain
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver, NoiseModel
from twostage_servo.control.optimal import WEIGHTS, ServoGains
from twostage_servo.control.plant import DiscretePlant

PLANT = DiscretePlant(period_s=0.01, a12=0.01, a22=0.5, b1=0.25, b2=2.0)


def test_the_noise_is_that_of_equation_37_with_a_disturbance_that_persists() -> None:
    assert NoiseModel() == NoiseModel((0.1, 0.1, 0.1), 0.01, 1.0)
    assert (Reading().process_variance, Reading().disturbance_memory) == ((0.1, 0.1, 0.1), 1.0)
    observer = DisturbanceObserver(PLANT, (0.0, 0.0, 0.0))
    observer.disturbance = 3.0
    observer.predict(0.0)
    assert observer.disturbance == 3.0


def test_the_feedback_is_negative_unless_it_is_read_as_printed() -> None:
    assert Reading().feedback_sign == -1


def test_the_weights_of_erratum_3() -> None:
    assert WEIGHTS == (1.0, 0.0, 1.0)
    assert Reading().weights == WEIGHTS


def test_no_correction_is_none() -> None:
    assert NO_CORRECTION == (0.0, 0.0, 0.0)


def test_equation_19_by_hand() -> None:
    assert ServoGains(f11=6.0, f12=1.0, f22=4.0).changeover_time_s(0.5) == 0.75


def test_a_stop_takes_three_tenths_of_the_velocity_error_away_in_a_period() -> None:
    assert BRAKING_SHARE == 0.3
    assert braking_gain(PLANT) == 0.15
    assert (REST_TICKS, SPEED_TOLERANCE, len(Stage)) == (3, 0.1, 3)


def test_an_update_by_hand() -> None:
    """From position 1, velocity 2, disturbance 4, with a sample of 3 and an effort of 6: innovation 2, total 10."""
    observer = DisturbanceObserver(PLANT, (0.5, 0.25, 8.0), 0.5)
    assert observer.plant is PLANT
    assert (observer.position, observer.velocity, observer.disturbance, observer.innovation) == (0.0, 0.0, 0.0, 0.0)
    observer.position, observer.velocity, observer.disturbance = 1.0, 2.0, 4.0
    observer.update(3.0, 6.0)
    assert observer.innovation == 2.0
    assert observer.position == 1.0 + 0.01 * 2.0 + 0.25 * 10.0 + 0.5 * 2.0
    assert observer.velocity == 0.5 * 2.0 + 2.0 * 10.0 + 0.25 * 2.0
    assert observer.disturbance == 0.5 * 4.0 + 8.0 * 2.0
