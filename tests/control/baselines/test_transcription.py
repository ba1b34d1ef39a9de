"""The law in the paper's matrices: against the product's law, against a third one in plain numbers, and the slips."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import control
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.control.baselines.rig import MODEL, PERIOD_S, Axis
from twostage_servo.control.baselines.transcription import (
    Reading,
    TranscribedLaw,
    UnsolvableError,
    read_gains,
    read_kalman_gain,
)
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.optimal import servo_gains
from twostage_servo.control.plant import DiscretePlant, Plant

Matrix = NDArray[np.float64]
MEASUREMENT = 0.01
plants = st.builds(
    lambda gain, pole, turned: Plant(-gain if turned else gain, pole),
    st.floats(30.0, 500.0),
    st.floats(2.0, 40.0),
    st.booleans(),
)
exponents = st.floats(-5.5, -2.3)
velocities = st.floats(5.0, 250.0)
signs = st.sampled_from([1.0, -1.0])


def dlqr(plant: Plant, ratio: float, weights: tuple[float, float, float] = (1.0, 0.0, 1.0)) -> list[float]:
    """f11, f12, f22 by python-control."""
    a, b = matrices(plant)
    gain, _, _ = control.dlqr(a_p(a), np.vstack([b, [[0.0]]]), ratio * np.diag(weights), np.eye(1))
    f11, f12, minus_f22 = np.asarray(gain)[0].tolist()
    return [f11, f12, -minus_f22]


def matrices(plant: Plant) -> tuple[Matrix, Matrix]:
    continuous = control.ss([[0.0, 1.0], [0.0, -plant.pole]], [[0.0], [plant.gain]], np.eye(2), 0.0)
    sampled = control.c2d(continuous, PERIOD_S, "zoh")
    return np.asarray(sampled.A), np.asarray(sampled.B)


def a_p(a: Matrix) -> Matrix:
    return np.block([[a, np.zeros((2, 1))], [np.array([[-1.0, 0.0, 1.0]])]])


@dataclass
class InNumbers:
    """Section IV a third time: gains by python-control, no matrix in its steps, every slip a field of its own."""

    plant: Plant
    ratio: float
    weights: tuple[float, float, float] = (1.0, 0.0, 1.0)
    sign: float = -1.0
    corner: float = 1.0
    variances: tuple[float, float, float] = (0.1, 0.1, 0.1)
    form: str = "predictor"
    sums_velocity: bool = True
    offset_gain_is_f2: bool = False
    offset_is_nominal: bool = False
    compares_sample: bool = False
    velocity: float = 0.0
    changeovers: int = 0
    x1: float = 0.0
    w: float = 0.0
    effort: float = 0.0
    total: float = 0.0
    offset: float | None = None
    target: float = 0.0
    reference: float = 0.0

    def __post_init__(self) -> None:
        self.f11, self.f12, self.f22 = dlqr(self.plant, self.ratio, self.weights)
        a, b = matrices(self.plant)
        (_, self.a12), (_, self.a22) = a.tolist()
        self.b1, self.b2 = b[:, 0].tolist()
        a_o = np.block([[a, b], [np.zeros((1, 2)), np.array([[self.corner]])]])
        c_o = np.array([[1.0, 0.0, 0.0]])
        _, x, _ = control.dlqe(a_o, np.eye(3), c_o, np.diag(self.variances), np.array([[MEASUREMENT]]))
        current = np.asarray(x)[:, 0] / (x[0, 0] + MEASUREMENT)
        self.k1, self.k2, self.k3 = (a_o @ current if self.form == "predictor" else current).tolist()

    @property
    def sample_age(self) -> int:
        return 0 if self.form == "filter" else 1

    @property
    def p(self) -> float:
        return self.f11 * abs(self.reference) * PERIOD_S / self.f22

    def set_target(self, target: float, velocity: float) -> None:
        self.target, self.reference = target, math.copysign(velocity, target)
        if abs(target) <= self.p:
            self.offset = 0.0

    def predict(self) -> tuple[float, float, float]:
        push = self.effort + self.w
        x1 = self.x1 + self.a12 * self.velocity + self.b1 * push
        return x1, self.a22 * self.velocity + self.b2 * push, self.corner * self.w

    def step(self, sample: float) -> float:
        if self.form == "filter":
            self.x1, self.velocity, self.w = self.predict()
            innovation = sample - self.x1
        else:
            innovation = sample - self.x1
            self.x1, self.velocity, self.w = self.predict()
        self.x1 += self.k1 * innovation
        self.velocity += self.k2 * innovation
        self.w += self.k3 * innovation
        in_position = self.offset is not None
        if in_position and self.form != "filter":
            self.total += self.target - sample
        direction = math.copysign(1.0, self.reference)
        distance = direction * (self.target - (sample if self.compares_sample else self.x1))
        if not in_position and distance <= self.p:
            self.offset = direction * self.p - self.target if self.offset_is_nominal else -self.x1
            self.changeovers += 1
        feedback, total = self.f12 * self.velocity, self.total
        if self.offset is None:
            self.total += self.reference - self.velocity if self.sums_velocity else self.target - sample
        else:
            feedback += self.f11 * self.x1 + (self.f22 if self.offset_gain_is_f2 else self.f11) * self.offset
            if self.form == "filter":
                self.total += self.target - sample
        self.effort = self.sign * feedback + self.f22 * total
        return self.effort


def product_law(sampled: DiscretePlant, ratio: float) -> TwoStageLaw:
    observer = DisturbanceObserver(
        sampled, kalman_gain(sampled, NoiseModel(measurement_variance=MEASUREMENT)).predictor
    )
    return TwoStageLaw(observer, servo_gains(sampled, ratio), PERIOD_S)


def noise(seed: int, deviation: float, ticks: int) -> list[float]:
    """White noise after a first exact sample: an axis at rest is known."""
    return [0.0, *np.random.default_rng(seed).normal(0.0, deviation, ticks - 1).tolist()]


def changeover_time_s(plant: Plant, ratio: float) -> float:
    f11, _, f22 = dlqr(plant, ratio)
    return f11 * PERIOD_S / f22


@settings(max_examples=30)
@given(
    plant=plants,
    exponent=exponents,
    velocity=velocities,
    distance=st.floats(-3.0, 3.0),
    load=st.floats(-1.0, 1.0),
    seed=st.integers(0, 1000),
    deviation=st.sampled_from([0.0, 0.03]),
)
def test_the_default_reading_is_the_law_that_drives_machines(
    plant: Plant, exponent: float, velocity: float, distance: float, load: float, seed: int, deviation: float
) -> None:
    """Distances are in change-over distances: up to 1 the position stage makes the whole move."""
    sampled, ratio = plant.discretise(PERIOD_S), 10.0**exponent
    time_s = changeover_time_s(plant, ratio)
    assume(0.05 < time_s < 1.5)
    target, ticks = distance * velocity * time_s, round((abs(distance) + 1.0) * time_s / PERIOD_S)
    laws = product_law(sampled, ratio), TranscribedLaw(sampled, ratio, MEASUREMENT)
    disturbed = noise(seed, deviation, ticks)
    for law in laws:
        law.set_target(target, velocity)
    ours, theirs = (Axis(plant, load).drive(law, ticks, disturbed) for law in laws)
    scale = np.max(np.abs(ours[2]))
    np.testing.assert_allclose(theirs[2], ours[2], rtol=0.0, atol=1e-9 * scale + 1e-12)
    assert laws[1].stage is laws[0].stage
    assert laws[1].changeovers == laws[0].changeovers
    assert laws[1].velocity == pytest.approx(laws[0].velocity, abs=1e-7 * velocity)


SWITCHES: dict[str, tuple[Reading, dict[str, Any]]] = {
    "as corrected": (Reading(), {}),
    "erratum 2": (Reading(feedback_sign=1), {"sign": 1.0}),
    "erratum 3": (Reading(weights=(0.0, 0.0, 1.0)), {"weights": (0.0, 0.0, 1.0)}),
    "erratum 5": (Reading(disturbance_memory=0.0), {"corner": 0.0}),
    "a fading memory": (Reading(disturbance_memory=0.9), {"corner": 0.9}),
    "erratum 6": (Reading(observer_form="mixed"), {"form": "mixed"}),
    "filter": (Reading(observer_form="filter"), {"form": "filter"}),
    "erratum 8": (Reading(process_variance=(0.0, 0.0, 0.1)), {"variances": (0.0, 0.0, 0.1)}),
    "erratum 10": (Reading(speed_stage_sum="position error"), {"sums_velocity": False}),
    "erratum 11": (Reading(offset_gain="F2"), {"offset_gain_is_f2": True}),
    "erratum 12": (Reading(offset="set-point"), {"offset_is_nominal": True}),
    "erratum 17": (Reading(changeover_on="sample"), {"compares_sample": True}),
    "errata 5 and 12": (
        Reading(disturbance_memory=0.0, offset="set-point"),
        {"corner": 0.0, "offset_is_nominal": True},
    ),
}


def compare_with_numbers(
    reading: Reading, slips: dict[str, Any], plant: Plant, ratio: float, target: float, velocity: float, ticks: int
) -> tuple[Matrix, Matrix]:
    """Close both loops for as long as neither runs away; return both efforts."""
    ours, theirs = (
        TranscribedLaw(plant.discretise(PERIOD_S), ratio, MEASUREMENT, reading),
        InNumbers(plant, ratio, **slips),
    )
    assert ours.sample_age == theirs.sample_age
    disturbed = noise(3, 0.03, ticks)
    efforts = []
    for law in (ours, theirs):
        law.set_target(target, velocity)
        efforts.append(Axis(plant, 0.3).drive(law, ticks, disturbed)[2])
    assert ours.changeovers == theirs.changeovers
    return efforts[0], efforts[1]


@pytest.mark.parametrize("ratio", [5e-5, 5e-3])
@pytest.mark.parametrize("target", [160.0, -170.3])
@pytest.mark.parametrize("name", SWITCHES)
def test_each_switch_changes_what_it_says_and_nothing_else(name: str, target: float, ratio: float) -> None:
    reading, slips = SWITCHES[name]
    ticks = 150 if name == "erratum 2" else 300  # before the runaway has passed all bounds
    ours, theirs = compare_with_numbers(reading, slips, MODEL, ratio, target, 100.0, ticks)
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-6 * np.max(np.abs(theirs)))
    if slips:  # and the switch is connected
        corrected, _ = compare_with_numbers(Reading(), {}, MODEL, ratio, target, 100.0, ticks)
        assert np.max(np.abs(ours - corrected)) > 1e-4 * np.max(np.abs(corrected))


@settings(max_examples=20)
@given(plant=plants, exponent=exponents, velocity=velocities, distance=st.floats(-3.0, 3.0))
def test_the_filter_form_is_its_equations_for_any_plant_gains_and_move(
    plant: Plant, exponent: float, velocity: float, distance: float
) -> None:
    """One tick quicker than (26): y(k) reaches u(k). Independent gains, so their last digits differ."""
    ratio = 10.0**exponent
    time_s = changeover_time_s(plant, ratio)
    assume(0.05 < time_s < 1.5)
    assume(abs(abs(distance) - 1.0) > 1e-6)
    ticks = round((abs(distance) + 1.0) * time_s / PERIOD_S)
    reading, slips = SWITCHES["filter"]
    ours, theirs = compare_with_numbers(reading, slips, plant, ratio, distance * velocity * time_s, velocity, ticks)
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-6 * np.max(np.abs(theirs)) + 1e-9)


@settings(max_examples=15)
@given(load=st.floats(-5.0, 5.0), seed=st.integers(0, 1000))
def test_without_memory_no_disturbance_is_ever_estimated(load: float, seed: int) -> None:
    law = TranscribedLaw(MODEL.discretise(PERIOD_S), 5e-5, MEASUREMENT, Reading(disturbance_memory=0.0))
    law.set_target(100.0, 100.0)
    axis, disturbed = Axis(MODEL, load), noise(seed, 0.03, 150)
    for k in range(150):
        axis.drive(law, 1, disturbed[k : k + 1])
        assert law._x_o[2, 0] == 0.0


def efforts_at_the_changeover(law: TranscribedLaw | TwoStageLaw, plant: Plant, target: float, velocity: float) -> float:
    law.set_target(target, velocity)
    axis = Axis(plant)
    for _ in range(3000):
        effort = float(axis.drive(law, 1)[2, 0])
        if law.changeovers:
            return effort
    raise AssertionError("the change-over never came")


@settings(max_examples=15)
@given(plant=plants, exponent=exponents, velocity=velocities, distance=st.floats(1.5, 2.5), sign=signs)
def test_the_printed_hand_overs_step_by_hand_computed_efforts(
    plant: Plant, exponent: float, velocity: float, distance: float, sign: float
) -> None:
    """Until the change-over nothing differs; at it the effort is off by what M, or its factor, is off by."""
    ratio = 10.0**exponent
    time_s = changeover_time_s(plant, ratio)
    assume(0.05 < time_s < 1.0)
    sampled, target = plant.discretise(PERIOD_S), sign * distance * velocity * time_s
    exact = product_law(sampled, ratio)
    right = efforts_at_the_changeover(exact, plant, target, velocity)
    estimate = exact.observer.position
    past = estimate - (target - sign * velocity * time_s)
    assert sign * past >= 0.0
    f11, _, f22 = dlqr(plant, ratio)
    nominal, f2 = (
        efforts_at_the_changeover(TranscribedLaw(sampled, ratio, MEASUREMENT, reading), plant, target, velocity)
        for reading in (Reading(offset="set-point"), Reading(offset_gain="F2"))
    )
    scale = 1e-6 * abs(f11) * abs(target)
    assert nominal - right == pytest.approx(-f11 * past, abs=scale)
    assert f2 - right == pytest.approx(-(f11 - f22) * estimate, abs=scale)


MakeLaw = Callable[[DiscretePlant, float], TwoStageLaw | TranscribedLaw]


@settings(max_examples=25)
@given(
    plant=plants,
    strength=st.floats(0.8, 1.2),
    exponent=exponents,
    velocity=velocities,
    distance=st.floats(1.2, 2.5),
    sign=signs,
    make=st.sampled_from([product_law, lambda sampled, ratio: TranscribedLaw(sampled, ratio, MEASUREMENT)]),
)
def test_the_effort_at_the_changeover_is_what_the_speed_stage_would_have_given(
    plant: Plant, strength: float, exponent: float, velocity: float, distance: float, sign: float, make: MakeLaw
) -> None:
    """A twin with a far set-point sees the same samples and stays in its speed stage; the true plant is another."""
    ratio = 10.0**exponent
    time_s = changeover_time_s(plant, ratio)
    assume(0.05 < time_s < 1.0)
    law, twin = (make(plant.discretise(PERIOD_S), ratio) for _ in range(2))
    law.set_target(sign * distance * velocity * time_s, velocity)
    twin.set_target(sign * 1e9 * velocity, velocity)
    axis, largest = Axis(replace(plant, gain=strength * plant.gain)), 0.0
    for _ in range(3000):
        continued = twin.step(axis.sample)
        effort = float(axis.drive(law, 1)[2, 0])
        largest = max(largest, abs(continued))
        assert effort == pytest.approx(continued, abs=1e-9 * largest)
        if law.changeovers:
            break
    assert (law.stage, law.changeovers) == (Stage.POSITION, 1)
    assert (twin.stage, twin.changeovers) == (Stage.SPEED, 0)
    assert largest > 0.0


@settings(max_examples=20)
@given(exponent=exponents, velocity=velocities, cruise_s=st.floats(6.0, 7.0), sign=signs)
def test_after_the_changeover_the_effort_moves_by_no_more_than_one_tick_of_way(
    exponent: float, velocity: float, cruise_s: float, sign: float
) -> None:
    """Out of a steady cruise, by hand: its next change is ``f22 (e(k) - p)``, and e(k) is at most v T_s short of p."""
    ratio = 10.0**exponent
    f11, _, f22 = dlqr(MODEL, ratio)
    law = product_law(MODEL.discretise(PERIOD_S), ratio)
    law.set_target(sign * velocity * (f11 * PERIOD_S / f22 + cruise_s), velocity)
    axis = Axis()
    cruising = effort = 0.0
    for _ in range(2000):
        cruising, effort = effort, float(axis.drive(law, 1)[2, 0])
        if law.changeovers:
            break
    change = sign * (float(axis.drive(law, 1)[2, 0]) - effort)
    assert effort == pytest.approx(cruising, rel=1e-4)
    assert -f22 * velocity * PERIOD_S - 1e-4 * abs(effort) <= change <= 1e-4 * abs(effort)


@settings(max_examples=40)
@given(gain=st.floats(1.0, 3e3), turned=st.booleans(), pole=st.floats(0.3, 100.0), exponent=st.floats(-6.0, -1.0))
@example(gain=1685.4114143748752, turned=False, pole=0.3, exponent=-6.0)
def test_erratum_1_the_printed_cost_does_not_see_a_constant_error(
    gain: float,
    turned: bool,
    pole: float,
    exponent: float,
) -> None:
    """Popov, Belevitch and Hautus at z = 1: the mode e = constant is in the kernel of A_p - I, and of the cost."""
    plant = Plant(-gain if turned else gain, pole)
    a, _ = matrices(plant)
    change = a_p(a) - np.eye(3)
    weighed = np.diag(np.sqrt([1.0, 0.0, 1.0]))
    assert np.linalg.matrix_rank(np.vstack([change, weighed @ change])) < 3  # as printed: undetectable
    assert np.linalg.matrix_rank(np.vstack([change, weighed])) == 3  # read as corrected: detectable
    with pytest.raises(UnsolvableError, match="a constant error costs nothing"):
        read_gains(plant.discretise(PERIOD_S), 10.0**exponent, Reading(cost="increment"))


def test_with_the_cost_on_the_increment_the_sum_is_not_fed_back_and_its_pole_stays_where_it_is() -> None:
    with pytest.raises(UnsolvableError) as refused:
        read_gains(Plant(180.0, 14.0).discretise(PERIOD_S), 5e-5, Reading(cost="increment"))
    found = re.search(r"f22 = (\S+) and a pole of magnitude (\S+):", str(refused.value))
    assert found is not None
    assert float(found[1]) < 1e-6
    assert float(found[2]) == pytest.approx(1.0, abs=1e-5)


entries = st.lists(st.floats(-100.0, 100.0), min_size=9, max_size=9)


@given(root=entries, memory=st.sampled_from([0.0, 1.0]), variance=st.floats(1e-4, 10.0))
def test_erratum_7_the_printed_riccati_equation_is_positive_for_every_covariance(
    root: list[float], memory: float, variance: float
) -> None:
    a, b = matrices(MODEL)
    a_o = np.block([[a, b], [np.zeros((1, 2)), np.array([[memory]])]])
    c_o = np.array([[1.0, 0.0, 0.0]])
    x = np.array(root).reshape(3, 3) @ np.array(root).reshape(3, 3).T
    taken_off = a_o @ x @ c_o.T @ np.linalg.inv(c_o @ x @ c_o.T + variance) @ c_o @ x @ a_o.T
    left = -taken_off + a_o @ x @ a_o.T + 0.1 * np.eye(3)
    assert np.min(np.linalg.eigvalsh((left + left.T) / 2.0)) > 0.1 - 1e-12 * np.max(np.abs(x)) - 1e-9


@pytest.mark.parametrize("build", [read_kalman_gain, lambda *args: TranscribedLaw(args[0], 5e-5, *args[1:])])
def test_erratum_7_as_printed_has_no_kalman_gain(build: Callable[..., object]) -> None:
    with pytest.raises(UnsolvableError, match=r"\(28\)"):
        build(MODEL.discretise(PERIOD_S), MEASUREMENT, Reading(covariance="as printed"))


def test_the_read_gains_are_those_of_python_control() -> None:
    sampled = MODEL.discretise(PERIOD_S)
    for weights in ((1.0, 0.0, 1.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0)):
        ours = read_gains(sampled, 5e-5, Reading(weights=weights))
        assert [ours.f11, ours.f12, ours.f22] == pytest.approx(dlqr(MODEL, 5e-5, weights), rel=1e-7)
