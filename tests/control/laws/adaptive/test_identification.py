"""The recursive fit against the batch solution of the same equation, and against plants that are known."""

import random

import numpy as np
import pytest

from tools.bench.control_quality.true_plant import TrueAxis, TruePlant
from twostage_servo.control.laws.adaptive.identification import Acted, Fit, Prior, widened

PERIOD_S = 0.01
PRIOR = Prior(180.0, 14.0, 0.3, 0.17, 0.17, 0.46)
SPREAD = 0.01


def start_of_a_move(axis: TrueAxis, ticks: int) -> tuple[list[float], list[float]]:
    """Return samples from the first effort's instant on, and these efforts: quick at first, then a cruise."""
    plant = TruePlant(axis, PERIOD_S, 1)
    efforts = [min(2.0 * (index + 1), 10.0) if index < 7 else 7.0 for index in range(ticks)]
    samples = []
    for effort in efforts:
        samples.append(plant.sample())
        plant.advance(effort)
    return samples, efforts


def test_it_is_the_least_squares_solution_with_the_prior() -> None:
    """Solved at once by numpy, from rows that are made of the same sums."""
    samples, efforts = start_of_a_move(TrueAxis(180.0 * 1.2, 14.0 * 0.8, noise=0.01), 30)
    fit, rows, seen = Fit(PRIOR, SPREAD, PERIOD_S), [], []
    once = twice = path = 0.0
    before = 0.0
    for index, sample in enumerate(samples[1:], 1):
        acted = efforts[index - 1]
        twice += once * PERIOD_S + 0.5 * acted * PERIOD_S**2
        once += acted * PERIOD_S
        path += 0.5 * PERIOD_S * (sample + before)
        before = sample
        # The correction of the trapezoidal rule takes the speed by the values before.
        values = np.array([fit.gain, fit.pole, fit.gain * fit.load])
        speed = values[0] * once - values[1] * sample - values[2] * index * PERIOD_S
        rows.append([twice, PERIOD_S**2 / 12.0 * speed - path, -0.5 * (index * PERIOD_S) ** 2, 1.0])
        seen.append(sample)
        fit.update(sample, Acted(acted))
    gain, load = PRIOR.gain, PRIOR.load
    root = np.array(
        [
            [0.17 * gain, 0.0, 0.0, 0.0],
            [0.0, 0.17 * 14.0, 0.0, 0.0],
            [0.17 * gain * load, 0.0, 0.46 * gain, 0.0],
            [0.0, 0.0, 0.0, SPREAD],
        ]
    )
    information = np.linalg.inv(root @ root.T)
    a, y = np.array(rows), np.array(seen)
    normal = information + a.T @ a / SPREAD**2
    expected = np.linalg.solve(normal, information @ [gain, 14.0, gain * load, 0.0] + a.T @ y / SPREAD**2)
    assert [fit.gain, fit.pole, fit.gain * fit.load] == pytest.approx(expected[:3], rel=1e-6)
    deviations = np.sqrt(np.diag(np.linalg.inv(normal)))
    assert fit.gain_share * fit.gain == pytest.approx(deviations[0], rel=1e-6)
    assert fit.pole_share * fit.pole == pytest.approx(deviations[1], rel=1e-6)
    off = (y - a @ expected) / SPREAD
    assert fit.residual == pytest.approx(off @ off + (expected[3] / SPREAD) ** 2, rel=1e-5)
    assert fit.freedom == 30 - 1 - 3


@pytest.mark.parametrize("gain", [0.7, 1.0, 1.3])
@pytest.mark.parametrize("pole", [0.7, 1.0, 1.3])
@pytest.mark.parametrize(("load", "friction"), [(0.0, 0.0), (1.0, 0.5), (-1.0, 0.5)])
def test_a_plant_is_known_after_the_start_of_a_move(gain: float, pole: float, load: float, friction: float) -> None:
    """Without noise, from 40 ticks. Until it moves against friction and load the equation is another."""
    axis = TrueAxis(180.0 * gain, 14.0 * pole, friction, load, quantum=0.0)
    samples, efforts = start_of_a_move(axis, 40)
    fit = Fit(PRIOR._replace(load=0.0, load_spread=1.5), 0.003, PERIOD_S)
    for sample, acted in zip(samples[1:], efforts, strict=False):
        fit.update(sample, Acted(acted))
    assert fit.gain == pytest.approx(axis.gain, rel=0.03)
    assert fit.pole == pytest.approx(axis.pole, rel=0.05)
    assert fit.load == pytest.approx(load + friction, abs=0.15)


def test_an_effort_that_acts_a_tick_later_is_likelier_by_the_late_fit() -> None:
    for delay in (0, 1):
        samples, efforts = start_of_a_move(TrueAxis(180.0, 14.0, delay_ticks=delay), 20)
        soon, late = Fit(PRIOR, SPREAD, PERIOD_S), Fit(PRIOR, SPREAD, PERIOD_S)
        for index, sample in enumerate(samples[1:], 1):
            soon.update(sample, Acted(efforts[index - 1]))
            if index == 1:
                late.begin_late(sample)
            else:
                late.update(sample, Acted(efforts[index - 2]))
        assert (late.evidence < soon.evidence - 3.0) is (delay == 1)


def test_its_spread_is_that_of_its_errors() -> None:
    """Over 300 noisy starts on plants drawn from the prior, squared errors in their own variances are 1 on average."""
    rng, errors = random.Random(5), []  # noqa: S311 - a test
    for _ in range(300):
        gain, pole = 180.0 * rng.gauss(1.0, 0.1), 14.0 * rng.gauss(1.0, 0.1)
        plant = TruePlant(
            TrueAxis(gain, pole, load=rng.gauss(0.0, 0.1), quantum=0.0, noise=0.02), PERIOD_S, rng.randrange(1000)
        )
        fit = Fit(Prior(180.0, 14.0, 0.0, 0.1, 0.1, 0.1), 0.02, PERIOD_S)
        origin = plant.sample()
        for index in range(30):
            effort = min(2.0 * (index + 1), 9.0)
            plant.advance(effort)
            fit.update(plant.sample() - origin, Acted(effort))
        errors.append(((fit.gain - gain) / (fit.gain_share * fit.gain)) ** 2)
    assert 0.6 < sum(errors) / len(errors) < 1.6


def test_a_sample_that_is_lost_changes_nothing_of_what_is_believed() -> None:
    fit = Fit(PRIOR, SPREAD, PERIOD_S)
    fit.update(0.02, Acted(4.0))
    before = fit.gain, fit.pole, fit.load, fit.samples
    fit.update(None, Acted(6.0))
    assert (fit.gain, fit.pole, fit.load, fit.samples) == before


def test_what_goes_into_the_next_move_is_less_sure_and_never_less_than_at_first() -> None:
    assert widened(0.0, 0.17) == 0.01
    assert widened(0.05, 0.17) == pytest.approx((0.06**2 + 0.01**2) ** 0.5)
    assert widened(0.5, 0.17) == 0.17


def test_where_a_sample_is_lost_it_goes_on_with_the_plant_that_it_has_found() -> None:
    """Of two that come next, one is lost; 50 µm after 30 ticks of an axis 10 % off its model, at some 100 mm/s."""
    axis = TrueAxis(180.0 * 1.1, 14.0 * 0.9, quantum=0.0)
    samples, efforts = start_of_a_move(axis, 36)
    fit = Fit(PRIOR._replace(load=0.0), 0.003, PERIOD_S)
    for index, (sample, acted) in enumerate(zip(samples[1:], efforts, strict=False)):
        fit.update(None if index in (31, 33) else sample, Acted(acted))
        if index >= 31:
            assert fit.position == pytest.approx(sample, abs=0.05)
    assert fit.samples == 33
    assert fit.gain == pytest.approx(axis.gain, rel=0.02)


@pytest.mark.parametrize(("sample", "evidence"), [(0.02, 2.0), (-0.02, 2.0), (0.0, 0.0), (0.1, 50.0)])
def test_a_sample_before_a_late_effort_has_acted_speaks_against_it_by_the_noise_that_it_would_be(
    sample: float, evidence: float
) -> None:
    """Half of its square in the variance of a sample, here of 0.01 mm."""
    fit = Fit(PRIOR, SPREAD, PERIOD_S)
    fit.begin_late(sample)
    assert fit.evidence == pytest.approx(evidence)
