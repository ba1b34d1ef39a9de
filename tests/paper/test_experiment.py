"""One run: the plant against python-control, the noise that every law shares, rounding, load, and giving up."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from twostage_servo.control.baselines.compared_law import ComparedLaw
from twostage_servo.control.baselines.transcription import Reading
from twostage_servo.control.plant import Plant
from twostage_servo.paper.examples import EXAMPLE_1, EXAMPLE_2, EXAMPLES, Example
from twostage_servo.paper.experiment import DrivenPlant, Run, simulate
from twostage_servo.paper.methods import METHODS, Builder, Sensor, transcribed

Matrix = NDArray[np.float64]
PERIOD_S = 0.01


def sampled(plant: Plant) -> tuple[Matrix, Matrix]:
    continuous = control.ss([[0.0, 1.0], [0.0, -plant.pole]], [[0.0], [plant.gain]], np.eye(2), 0.0)
    discrete = control.sample_system(continuous, PERIOD_S, "zoh")
    return np.asarray(discrete.A), np.asarray(discrete.B)


def response(plant: Plant, efforts: Matrix) -> Matrix:
    """Position and velocity before each effort, by python-control."""
    a, b = sampled(plant)
    loop = control.ss(a, b, np.eye(2), 0.0, PERIOD_S)
    outputs = control.forced_response(loop, PERIOD_S * np.arange(len(efforts)), efforts).outputs
    return np.asarray(outputs).reshape(2, -1)


@dataclass
class Recorder:
    """A law that gives one effort, and writes down what it was handed."""

    effort: float = 0.0
    sample_age: int = 0
    velocity: float = 0.0
    changes_over_at: int | None = None
    changeovers: int = 0
    target: tuple[float, float] = (0.0, 0.0)
    samples: list[float] = field(default_factory=list)

    def set_target(self, target: float, velocity: float) -> None:
        self.target = target, velocity

    def step(self, sample: float) -> float:
        self.changeovers += len(self.samples) == self.changes_over_at
        self.samples.append(sample)
        return self.effort


@dataclass
class Overheard:
    """Another law, whose samples are written down on their way."""

    law: ComparedLaw
    samples: list[float] = field(default_factory=list)

    @property
    def sample_age(self) -> int:
        return self.law.sample_age

    @property
    def velocity(self) -> float:
        return self.law.velocity

    @property
    def changeovers(self) -> int:
        return self.law.changeovers

    def set_target(self, target: float, velocity: float) -> None:
        self.law.set_target(target, velocity)

    def step(self, sample: float) -> float:
        self.samples.append(sample)
        return self.law.step(sample)


def always(law: ComparedLaw) -> Builder:
    return lambda _example, _sensor: law


def noise_of(build: Callable[[Example, Sensor], ComparedLaw], seed: int) -> Matrix:
    """What was added to the positions, by the law's own samples; those of one period before are shifted back."""
    heard: list[Overheard] = []

    def overheard(example: Example, sensor: Sensor) -> ComparedLaw:
        heard.append(Overheard(build(example, sensor)))
        return heard[0]

    run = simulate(overheard, EXAMPLE_1, seed=seed, duration_s=5.0)
    positions, samples = np.array(run.position), np.array(heard[0].samples)
    if heard[0].sample_age:
        assert samples[0] == 0.0
        return np.asarray(samples[1:] - positions[:-1])
    return np.asarray(samples[:-1] - positions[:-1])


def test_the_same_seed_gives_every_law_the_same_noise_and_another_seed_another() -> None:
    reference = noise_of(always(Recorder()), 7)
    for method in METHODS.values():
        np.testing.assert_allclose(noise_of(method.build, 7), reference, rtol=0.0, atol=1e-9)
    assert np.max(np.abs(noise_of(always(Recorder()), 8) - reference)) > 0.01
    # 499 samples: the standard deviation of their variance is a share of sqrt(2 / 499).
    assert np.var(reference) == pytest.approx(1e-5 / PERIOD_S, rel=4.0 * math.sqrt(2.0 / len(reference)))
    assert abs(np.mean(reference)) < 4.0 * math.sqrt(1e-3 / len(reference))


@settings(max_examples=40)
@given(
    gain=st.floats(1.0, 500.0),
    pole=st.floats(0.5, 50.0),
    load=st.floats(-5.0, 5.0),
    efforts=st.lists(st.floats(-20.0, 20.0), min_size=2, max_size=40),
)
def test_the_driven_plant_is_that_of_python_control_and_the_load_opposes_the_effort(
    gain: float, pole: float, load: float, efforts: list[float]
) -> None:
    plant = Plant(gain, pole)
    driven = DrivenPlant(plant.discretise(PERIOD_S), load)
    theirs = response(plant, np.array(efforts) - load)
    for k, effort in enumerate(efforts):
        assert driven.position == pytest.approx(theirs[0, k], rel=1e-9, abs=1e-9)
        assert driven.velocity == pytest.approx(theirs[1, k], rel=1e-9, abs=1e-9)
        driven.advance(effort)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name)
@pytest.mark.parametrize("load", [0.0, 1.5])
def test_a_run_drives_the_true_plant_of_its_example(example: Example, load: float) -> None:
    true = {"example1": Plant(180.0, 14.0), "example2": Plant(180.0 * 1.3, 14.0 * 0.7)}[example.name]  # (35), (38)
    law = Recorder(effort=2.0)
    run = simulate(always(law), example, set_point=-250.0, velocity=30.0, load=load, duration_s=1.0)
    position, velocity = response(true, np.full(100, 2.0 - load))
    np.testing.assert_allclose(run.position, position, atol=1e-9)
    np.testing.assert_allclose(run.velocity, velocity, atol=1e-9)
    assert law.target == (-250.0, 30.0)
    assert run.effort == [2.0] * 100
    assert run.time_s == pytest.approx(np.arange(100) * 0.01)


def test_a_load_alone_pushes_backwards() -> None:
    assert simulate(always(Recorder()), EXAMPLE_2, load=1.0, duration_s=0.5).position[-1] < -1.0


@pytest.mark.parametrize("age", [0, 1])
def test_a_law_gets_the_sample_of_the_age_that_it_is_made_for(age: int) -> None:
    law = Recorder(effort=3.0, sample_age=age)
    run = simulate(always(law), EXAMPLE_2, duration_s=0.3)
    assert law.samples == ([0.0, *run.position[:-1]] if age else run.position)


@settings(max_examples=20)
@given(quantum=st.sampled_from([0.001, 0.1, 0.25, 5.0]), effort=st.floats(-10.0, 10.0), seed=st.integers(0, 99))
def test_samples_are_rounded_to_their_quantum_after_the_noise(quantum: float, effort: float, seed: int) -> None:
    exact, rounded = Recorder(effort), Recorder(effort)
    simulate(always(exact), EXAMPLE_1, seed=seed, duration_s=0.5)
    simulate(always(rounded), EXAMPLE_1, seed=seed, duration_s=0.5, position_quantum=quantum)
    counts = np.array(rounded.samples) / quantum
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    assert np.max(np.abs(np.array(rounded.samples) - exact.samples)) <= quantum / 2.0 * (1.0 + 1e-9)


@pytest.mark.parametrize(("effort", "quantum", "acting"), [(1.26, 0.5, 1.5), (-1.26, 0.5, -1.5), (0.24, 0.5, 0.0)])
def test_the_plant_is_driven_by_the_rounded_effort(effort: float, quantum: float, acting: float) -> None:
    run = simulate(always(Recorder(effort)), EXAMPLE_2, duration_s=0.5, effort_quantum=quantum)
    np.testing.assert_allclose(run.position, response(EXAMPLE_2.true_plant, np.full(50, acting))[0], atol=1e-9)
    assert run.effort == [effort] * 50  # what the law gave


def test_the_changeover_is_the_first_tick_of_the_position_stage() -> None:
    assert simulate(always(Recorder(changes_over_at=17)), EXAMPLE_2, duration_s=0.5).changeover == 17
    assert simulate(always(Recorder()), EXAMPLE_2, duration_s=0.5).changeover is None


@pytest.mark.parametrize("effort", [4000.0, -4000.0])
def test_a_runaway_is_given_up_a_hundred_metres_from_the_set_point(effort: float) -> None:
    run = simulate(always(Recorder(effort)), EXAMPLE_2, set_point=400.0)
    position = response(EXAMPLE_2.true_plant, np.full(1000, effort))[0]
    beyond = int(np.argmax(np.abs(position - 400.0) >= 1e5))
    assert 0 < beyond < 1000
    assert run.diverged
    assert len(run.position) == len(run.velocity) == len(run.law_velocity) == len(run.effort) == beyond
    np.testing.assert_allclose(run.position, position[:beyond], rtol=1e-9)


def test_an_effort_that_is_no_number_is_given_up_at_once() -> None:
    run = simulate(always(Recorder(math.nan)), EXAMPLE_2)
    assert run.diverged
    assert run.position == [0.0]


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name)
def test_positive_feedback_runs_away(example: Example) -> None:
    """Erratum 2: [x1, x2, sum] under + f11, + f12 has a pole outside the unit circle, so no run can end."""
    a, b = sampled(example.true_plant)
    gains = example.gains
    loop = np.block([[a, np.zeros((2, 1))], [np.array([[-1.0, 0.0, 1.0]])]])
    loop += np.vstack([b, [[0.0]]]) @ np.array([[gains.f11, gains.f12, gains.f22]])
    assert np.max(np.abs(np.linalg.eigvals(loop))) > 1.01
    run = simulate(transcribed(Reading(feedback_sign=1)), example)
    assert run.diverged
    assert len(run.position) < 1000


def stationary_variance(loop: Matrix, entry: Matrix, seen: Matrix) -> float:
    """Variance of ``seen @ x`` when white noise of variance 1 enters by ``entry``: a discrete Lyapunov equation."""
    covariance = control.dlyap(loop, entry @ entry.T)
    return float((seen @ covariance @ seen.T).item())


def long_cruise(name: str) -> Run:
    return simulate(METHODS[name].build, EXAMPLE_1, set_point=30_000.0, duration_s=250.0)


def test_the_estimated_velocity_in_the_cruise_is_as_quiet_as_theory_says() -> None:
    """Speed stage by hand, noise into the observer alone: [x2, x_o1 - x1, x_o2, x_o3, I] as deviations."""
    a, b = sampled(Plant(180.0, 14.0))
    gains = EXAMPLE_1.gains
    effort = np.array([[0.0, 0.0, -gains.f12, 0.0, 1.0]])
    estimator = np.block([[a, b], [np.zeros((1, 2)), np.ones((1, 1))]])
    gain, _, _ = control.dlqe(estimator, np.eye(3), [[1.0, 0.0, 0.0]], 0.1 * np.eye(3), [[0.01]])
    gain = np.asarray(gain)
    loop = np.zeros((5, 5))
    loop[0, 0] = a[1, 1]
    loop[0] += b[1] * effort[0]
    # x_o1 - x1 moves by what the velocities differ by: the efforts are the same on both.
    loop[1] = [-a[0, 1], 1.0 - gain[0, 0], a[0, 1], b[0, 0], 0.0]
    loop[2] = [0.0, -gain[1, 0], a[1, 1], b[1, 0], 0.0]
    loop[2] += b[1] * effort[0]
    loop[3] = [0.0, -gain[2, 0], 0.0, 1.0, 0.0]
    loop[4] = [0.0, 0.0, -gains.f22, 0.0, 1.0]
    entry = np.array([[0.0, gain[0, 0], gain[1, 0], gain[2, 0], 0.0]]).T
    theory = stationary_variance(loop, entry, np.array([[0.0, 0.0, 1.0, 0.0, 0.0]]))
    run = long_cruise("proposed")
    assert run.changeover is None
    # 23,000 samples with a correlation of some 20 ticks: the deviation is good for 2 % or so.
    assert np.std(run.law_velocity[1000:24000]) == pytest.approx(math.sqrt(1e-3 * theory), rel=0.08)


def test_the_differentiated_velocity_in_the_cruise_is_as_noisy_as_theory_says() -> None:
    """[x2, way of the last tick, noise before, I]: the difference of two samples, fed back through f12 and the sum."""
    a, b = sampled(Plant(180.0, 14.0))
    gains = EXAMPLE_1.gains
    # The sampled velocity is (way + n - n_before) / T_s; n enters anew each tick.
    seen = np.array([[0.0, 1.0, -1.0, 0.0]]) / PERIOD_S
    effort = np.array([[0.0, 0.0, 0.0, 1.0]]) - gains.f12 * seen
    loop = np.zeros((4, 4))
    loop[0, 0], loop[1, 0], loop[3, 3] = a[1, 1], a[0, 1], 1.0
    loop[0] += b[1] * effort[0]
    loop[1] += b[0] * effort[0]
    loop[3] -= gains.f22 * seen[0]
    fresh = -gains.f12 / PERIOD_S
    entry = np.array([[b[1, 0] * fresh, b[0, 0] * fresh, 1.0, -gains.f22 / PERIOD_S]]).T
    theory = stationary_variance(loop, entry, seen) + 1.0 / PERIOD_S**2
    assert math.sqrt(1e-3 * theory) > math.sqrt(2e-3) / PERIOD_S  # the loop adds to it
    run = long_cruise("conventional_differentiated")
    assert run.changeover is None
    assert np.std(run.law_velocity[1000:24000]) == pytest.approx(math.sqrt(1e-3 * theory), rel=0.03)
