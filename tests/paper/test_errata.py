"""What the list of errata says of the effects, held to runs and to the equations themselves."""

import re

import pytest

from twostage_servo.control.baselines.transcription import UnsolvableError
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper_margins import closed_loop_poles
from twostage_servo.control.observer import NoiseModel, kalman_gain
from twostage_servo.control.optimal import servo_gains
from twostage_servo.paper.errata import ERRATA, Erratum
from twostage_servo.paper.examples import EXAMPLE_1, EXAMPLE_2, NOISE, PERIOD_S, VELOCITY, Example
from twostage_servo.paper.experiment import simulate
from twostage_servo.paper.methods import METHODS
from twostage_servo.paper.scores import Scores, score

BY_NUMBER = {erratum.number: erratum for erratum in ERRATA}


def printed(number: int, example: Example, load: float = 0.0) -> Scores:
    erratum = BY_NUMBER[number]
    assert erratum.as_printed is not None
    noise = erratum.noise_variance if example.noise_variance else None
    return score(simulate(erratum.as_printed, example, load=load, noise_variance=noise))


def corrected(number: int, example: Example) -> Scores:
    return score(simulate(METHODS[BY_NUMBER[number].baseline].build, example))


def noise(scores: Scores) -> float:
    assert scores.velocity_noise_rms is not None
    return scores.velocity_noise_rms


def numbers_in(erratum: Erratum) -> set[str]:
    return set(re.findall(r"\d+(?:\.\d+)?", erratum.effect))


def test_the_list_is_numbered_and_complete() -> None:
    assert [erratum.number for erratum in ERRATA] == list(range(1, len(ERRATA) + 1))
    assert len(ERRATA) >= 17
    for erratum in ERRATA:
        assert all((erratum.where, erratum.printed, erratum.read_as, erratum.why, erratum.effect))
        assert erratum.printed != erratum.read_as
        # What changes no number says so, and nothing else does.
        assert (erratum.as_printed is None) == erratum.effect.startswith("none")


@pytest.mark.parametrize("number", [1, 7])
@pytest.mark.parametrize("example", [EXAMPLE_1, EXAMPLE_2], ids=lambda example: example.name)
def test_two_slips_leave_no_law(number: int, example: Example) -> None:
    with pytest.raises(UnsolvableError):
        printed(number, example)


def test_with_the_signs_as_printed_the_axis_runs_away() -> None:
    for example in (EXAMPLE_1, EXAMPLE_2):
        runaway = printed(2, example)
        assert runaway.diverged
        assert runaway.final_error is None
        assert runaway.settling_time_s is None


def test_weights_of_erratum_3() -> None:
    changes = []
    for example in (EXAMPLE_1, EXAMPLE_2):
        on_e_alone = servo_gains(example.model, example.ratio, (0.0, 0.0, 1.0))
        changes.append(f"{100.0 * (example.gains.f11 - on_e_alone.f11) / example.gains.f11:.2f}")
    assert set(changes) <= numbers_in(BY_NUMBER[3])
    fits = [
        (f"{gains.f11:.2e}", f"{gains.f12:.2e}", f"{gains.f22:.1e}") == ("3.78e-01", "2.32e-02", "6.9e-03")
        for gains in (servo_gains(EXAMPLE_1.model, EXAMPLE_1.ratio, (w, 0.0, 1.0)) for w in (0.5, 0.6, 1.0, 4.2, 4.5))
    ]
    assert fits == [False, True, True, True, False]
    assert f"{servo_gains(EXAMPLE_1.model, EXAMPLE_1.ratio, (0.0, 0.0, 1.0)).f11:.2e}" == "3.77e-01"
    assert f"{servo_gains(EXAMPLE_1.model, EXAMPLE_1.ratio, (1.0, 1.0, 1.0)).f12:.2e}" == "2.35e-02"


def test_speeds_of_erratum_5() -> None:
    wrong_plant = printed(5, EXAMPLE_2)
    assert wrong_plant.cruise_velocity is not None
    loaded = printed(5, EXAMPLE_1, load=1.0)
    assert loaded.cruise_velocity is not None
    measured = {
        f"{VELOCITY + wrong_plant.speed_overshoot:.0f}",
        f"{wrong_plant.cruise_velocity:.0f}",
        f"{VELOCITY - loaded.cruise_velocity:.1f}",
    }
    assert measured == {"230", "184", "12.7"}
    assert measured <= numbers_in(BY_NUMBER[5])
    assert noise(printed(5, EXAMPLE_1)) < noise(corrected(5, EXAMPLE_1))


def test_gains_of_erratum_6_differ_by_a_tenth_and_the_printed_one_is_quieter() -> None:
    kalman = kalman_gain(EXAMPLE_1.model, NOISE)
    assert 1.05 < kalman.predictor[0] / kalman.current[0] < 1.15
    assert noise(printed(6, EXAMPLE_1)) < noise(corrected(6, EXAMPLE_1))


def test_noise_on_the_disturbance_alone_makes_the_speed_stage_of_example_2_unstable() -> None:
    noise_model = NoiseModel((0.0, 0.0, 0.1))
    kalman = kalman_gain(EXAMPLE_2.model, noise_model)
    true_plant = EXAMPLE_2.true_plant.discretise(PERIOD_S)
    poles = closed_loop_poles(EXAMPLE_2.model, EXAMPLE_2.gains, kalman, noise_model, Stage.SPEED, true_plant)
    assert max(map(abs, poles)) > 1.0
    assert printed(8, EXAMPLE_2).speed_overshoot > 1000.0
    assert corrected(8, EXAMPLE_2).speed_overshoot < 200.0


def test_a_hundredth_of_the_variance_is_a_tenth_of_the_noise() -> None:
    assert noise(corrected(9, EXAMPLE_1)) / noise(printed(9, EXAMPLE_1)) == pytest.approx(10.0, rel=1e-3)


def test_without_speed_control_there_are_thousands_of_millimetres_a_second() -> None:
    assert all(VELOCITY + printed(10, example).speed_overshoot > 1000.0 for example in (EXAMPLE_1, EXAMPLE_2))


def test_steps_at_the_changeover() -> None:
    for example in (EXAMPLE_1, EXAMPLE_2):
        gains, way = example.gains, VELOCITY * PERIOD_S
        jump = gains.f11 * (400.0 - example.changeover_distance)
        assert 100.0 < printed(11, example).changeover_effort_step < jump
        late = printed(12, example).changeover_effort_step
        assert corrected(12, example).changeover_effort_step + 0.05 < late <= gains.f11 * way
        fall = printed(14, example).following_effort_step
        assert gains.f11 * way <= fall <= (gains.f11 + gains.f22) * way
        assert corrected(14, example).following_effort_step <= gains.f22 * way


def test_the_noises_own_variance_makes_a_filter_that_follows_it_a_little_more() -> None:
    assert f"{100.0 * (noise(printed(16, EXAMPLE_1)) / noise(corrected(16, EXAMPLE_1)) - 1.0):.0f} %" == "8 %"
    assert "8 %" in BY_NUMBER[16].effect


def test_deciding_by_the_sample_is_a_small_change() -> None:
    for example in (EXAMPLE_1, EXAMPLE_2):
        assert printed(17, example).overshoot != corrected(17, example).overshoot
        assert printed(17, example).overshoot == pytest.approx(corrected(17, example).overshoot, rel=0.01)
