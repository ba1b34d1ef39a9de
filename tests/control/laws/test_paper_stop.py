"""Stops: a ramp by the model, with the disturbance cancelled, within limit and rate of the effort."""

import itertools

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twostage_servo.control.laws.law import Stage
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.control.laws.paper_margins import closed_loop_poles, controller, loop_margins
from twostage_servo.control.laws.stop import BRAKING_SHARE, braking_gain
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.optimal import servo_gains
from twostage_servo.control.plant import DiscretePlant, Plant

PERIOD_S = 0.01
MODEL = Plant(180.0, 14.0).discretise(PERIOD_S)
GAINS = servo_gains(MODEL, 5e-5)
NOISE = NoiseModel()
KALMAN = kalman_gain(MODEL, NOISE)


class Run:
    """A law that cruises with its plant, from the steady state of the model."""

    def __init__(self, velocity: float, plant: DiscretePlant = MODEL, load: float = 0.0, **limits: float) -> None:
        self.law = TwoStageLaw(
            DisturbanceObserver(MODEL, KALMAN.predictor), GAINS, PERIOD_S, rest_velocity=1.0, **limits
        )
        self.plant, self.load = plant, load
        self.position = self.velocity = self.sample = 0.0
        self.positions: list[float] = []
        self.velocities: list[float] = []
        self.efforts: list[float] = []
        if velocity:
            self.law.set_target(1e6 * velocity, abs(velocity))
            self.steps(1500)

    def steps(self, count: int, *, blind: bool = False) -> None:
        for _ in range(count):
            effort = self.law.step(None if blind else self.sample)
            self.sample = self.position
            total = effort - self.load
            self.position += self.plant.a12 * self.velocity + self.plant.b1 * total
            self.velocity = self.plant.a22 * self.velocity + self.plant.b2 * total
            self.positions.append(self.position)
            self.velocities.append(self.velocity)
            self.efforts.append(effort)

    def stop(self, deceleration: float, *, blind: bool = False) -> "Run":
        self.positions.clear()
        self.velocities.clear()
        self.efforts = self.efforts[-1:]
        self.start = self.position
        self.law.stop(deceleration)
        self.steps(300, blind=blind)
        return self


@settings(max_examples=60, deadline=None)
@given(
    speed=st.floats(10.0, 400.0),
    sign=st.sampled_from([1.0, -1.0]),
    deceleration=st.floats(200.0, 20_000.0),
    load=st.floats(-5.0, 5.0),
)
def test_without_limits_the_model_follows_the_ramp_exactly(
    speed: float, sign: float, deceleration: float, load: float
) -> None:
    """The way is that of a speed that falls by the same in each period: by hand, sum of v T less a T each time."""
    velocity = sign * speed
    run = Run(velocity, load=load).stop(deceleration)
    speeds = [max(0.0, abs(velocity) - deceleration * PERIOD_S * n) for n in range(400)]
    by_hand = sum((a + b) / 2.0 * PERIOD_S for a, b in itertools.pairwise(speeds))
    # Within a period the plant's speed is an exponential between the two, not a line.
    slack = 0.02 + abs(velocity) * 0.002
    assert abs(run.positions[-1] - run.start) == pytest.approx(by_hand, abs=slack)
    assert run.velocities[-1] == pytest.approx(0.0, abs=1e-3)


@settings(max_examples=60, deadline=None)
@given(velocity=st.floats(5.0, 250.0), deceleration=st.floats(500.0, 4000.0), rate=st.floats(200.0, 5000.0))
def test_within_limit_and_rate_it_slows_down_all_the_way_and_does_not_turn_back(
    velocity: float, deceleration: float, rate: float
) -> None:
    run = Run(velocity, effort_limit=24.0, effort_rate_limit=rate).stop(deceleration)
    assert all(abs(effort) <= 24.0 for effort in run.efforts)
    assert all(abs(b - a) <= rate * PERIOD_S + 1e-9 for a, b in itertools.pairwise(run.efforts))
    assert all(b <= a + 1e-6 for a, b in itertools.pairwise([velocity, *run.velocities[:3]]))
    turned_back = max(run.positions) - run.positions[-1]
    assert turned_back <= 0.02 * velocity**2 / deceleration + 0.3


@pytest.mark.parametrize("gain", [0.5, 0.7, 1.3, 2.0])
@pytest.mark.parametrize("pole", [0.5, 1.0, 2.0])
def test_a_stop_is_stable_for_half_to_twice_the_gain_or_pole(gain: float, pole: float) -> None:
    plant = Plant(180.0 * gain, 14.0 * pole).discretise(PERIOD_S)
    poles = closed_loop_poles(MODEL, GAINS, KALMAN, NOISE, Stage.BRAKE, plant)
    assert max(abs(one) for one in poles) < 1.0


def test_the_poles_are_those_of_the_equations_written_out() -> None:
    """Plant, observer and ``u = -f_b x2 - x3``, in one matrix by hand."""
    a12, a22, b1, b2 = MODEL.a12, MODEL.a22, MODEL.b1, MODEL.b2
    l1, l2, l3 = KALMAN.predictor
    fb = BRAKING_SHARE / b2
    assert braking_gain(MODEL) == pytest.approx(fb)
    matrix = np.array([
        [1.0, a12, 0.0, -b1 * fb, -b1],
        [0.0, a22, 0.0, -b2 * fb, -b2],
        [l1, 0.0, 1.0 - l1, a12 - b1 * fb, b1 - b1],
        [l2, 0.0, -l2, a22 - b2 * fb, b2 - b2],
        [l3, 0.0, -l3, 0.0, 1.0],
    ])  # fmt: skip
    by_hand = sorted(np.linalg.eigvals(matrix), key=lambda p: (round(abs(p), 9), round(p.imag, 9)))
    poles = sorted(
        closed_loop_poles(MODEL, GAINS, KALMAN, NOISE, Stage.BRAKE), key=lambda p: (round(abs(p), 9), round(p.imag, 9))
    )
    kept = list(by_hand)
    kept.remove(min(kept, key=lambda p: abs(p - 1.0)))
    assert np.allclose(poles, kept, atol=1e-6)


def test_the_margins_are_python_controls() -> None:
    a_c, b_c, c_c = controller(MODEL, GAINS, KALMAN, NOISE, Stage.BRAKE)
    regulator = control.ss(a_c, b_c, c_c, 0.0, PERIOD_S)
    plant = control.ss([[1.0, MODEL.a12], [0.0, MODEL.a22]], [[MODEL.b1], [MODEL.b2]], [[1.0, 0.0]], 0.0, PERIOD_S)
    loop = -regulator * plant
    angles = np.geomspace(1e-3, np.pi, 20_000) / PERIOD_S
    response = control.frequency_response(loop, angles).frdata[0, 0]
    margins = loop_margins(MODEL, GAINS, KALMAN, NOISE, Stage.BRAKE)
    assert margins.modulus_margin == pytest.approx(float(np.min(np.abs(1.0 + response))), rel=1e-3)


def test_on_the_model_alone_it_brakes_as_well_while_the_plant_is_the_model() -> None:
    seeing, blind = Run(200.0).stop(4000.0), Run(200.0).stop(4000.0, blind=True)
    assert blind.positions[-1] - blind.start == pytest.approx(seeing.positions[-1] - seeing.start, abs=0.05)


def test_the_effort_that_remains_is_what_holds_against_the_load() -> None:
    run = Run(100.0, load=3.0, effort_limit=24.0, effort_rate_limit=1000.0).stop(2000.0)
    assert run.law.stage is Stage.POSITION
    assert run.efforts[-1] == pytest.approx(3.0, abs=1e-3)
    assert abs(run.positions[-1] - run.positions[40]) < 0.05


def test_a_harder_stop_takes_over_from_a_softer_one() -> None:
    run = Run(250.0)
    run.law.stop(500.0)
    run.steps(5)
    place = run.position
    run.law.stop(4000.0)
    run.steps(300)
    assert run.position - place < 250.0**2 / 8000.0 + 250.0 * 0.03


@settings(max_examples=40, deadline=None)
@given(distance=st.floats(-1e4, 1e4), steps=st.integers(0, 400))
def test_another_origin_changes_no_effort(distance: float, steps: int) -> None:
    """The same run counted from another origin, shifted in any stage."""
    plain, shifted = Run(0.0), Run(0.0)
    for run in (plain, shifted):
        run.law.set_target(100.0, 50.0)
        run.steps(steps)
    shifted.law.shift(distance)
    shifted.position += distance
    shifted.sample += distance
    for run in (plain, shifted):
        run.steps(300)
    assert shifted.efforts == pytest.approx(plain.efforts, abs=1e-6)
