"""The tests of encoder and plant: they tell signs and scales, and are silent about loads and plants 30 % off."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twostage_servo.control.model_monitor.monitor import ModelMonitor
from twostage_servo.control.observer import DisturbanceObserver, NoiseModel, kalman_gain
from twostage_servo.control.plant import Plant

PERIOD_S = 0.01
PLANT = Plant(180.0, 14.0)
MODEL = PLANT.discretise(PERIOD_S)


class Bench:
    """A plant under a given effort, its model's observer, and the test; no loop is closed."""

    def __init__(self, factor: float, pole: float = 1.0, period_s: float = PERIOD_S) -> None:
        self.plant = Plant(factor * PLANT.gain, pole * PLANT.pole).discretise(period_s)
        model = PLANT.discretise(period_s)
        self.observer = DisturbanceObserver(model, kalman_gain(model, NoiseModel()).predictor)
        self.test = ModelMonitor(PLANT, period_s, NoiseModel())
        self.test.start(self.observer)
        self.position = self.velocity = 0.0
        self.counts, self.changed_at = 1.0, 0.0
        self.verdicts: list[float | None] = []

    def run(self, efforts: list[float], load: float = 0.0) -> "Bench":
        for effort in efforts:
            sample = self.changed_at + self.counts * (self.position - self.changed_at)
            self.observer.update(sample, effort)
            self.test.update(sample, effort, self.observer, 0.0)
            total = effort - load
            self.position += self.plant.a12 * self.velocity + self.plant.b1 * total
            self.velocity = self.plant.a22 * self.velocity + self.plant.b2 * total
            self.verdicts.append(self.test.better_factor)
        return self

    def cruise(self, velocity: float) -> "Bench":
        self.run([velocity * PLANT.pole / PLANT.gain] * 400)
        self.verdicts.clear()
        return self

    def change(self, counts: float) -> None:
        """Let the encoder count otherwise from the place of the latest sample on."""
        self.counts, self.changed_at = counts, self.position


RAMP = [0.3 * n for n in range(60)]


@pytest.mark.parametrize("factor", [-1.0, -0.7, 0.4, 0.5, 2.0, 2.4])
def test_a_wrong_gain_is_told_and_on_which_side_of_the_models_it_is(factor: float) -> None:
    verdicts = {one for one in Bench(factor).run(RAMP).verdicts if one is not None}
    assert verdicts
    assert verdicts <= ({-1.0} if factor < 0.0 else {0.45, 0.5} if factor < 1.0 else {2.0, 2.2})


@pytest.mark.parametrize("factor", [0.7, 0.85, 1.0, 1.15, 1.3])
@pytest.mark.parametrize("pole", [0.7, 1.0, 1.3])
def test_a_plant_30_percent_off_is_not_told(factor: float, pole: float) -> None:
    assert set(Bench(factor, pole).run(RAMP[:40]).verdicts) == {None}


@settings(max_examples=40, deadline=None)
@given(load=st.floats(-15.0, 15.0), effort=st.floats(-10.0, 10.0), when=st.integers(1, 100))
def test_a_load_decides_nothing(load: float, effort: float, when: int) -> None:
    bench = Bench(1.0)
    bench.run([effort * min(1.0, n / 30.0) for n in range(when + 60)])
    bench.verdicts.clear()
    bench.run([effort] * 60, load=load)
    assert set(bench.verdicts) == {None}


@pytest.mark.parametrize(("load", "effort"), [(-14.0, 6.0), (-12.0, -10.0), (-10.0, 4.0), (-8.0, -2.0), (8.0, 2.0)])
def test_a_load_whose_first_sample_looks_like_a_part_of_a_change_decides_nothing(load: float, effort: float) -> None:
    bench = Bench(1.0).run([effort * min(1.0, n / 30.0) for n in range(61)])
    bench.verdicts.clear()
    bench.run([effort] * 60, load=load)
    assert set(bench.verdicts) == {None}


@settings(max_examples=30, deadline=None)
@given(load=st.floats(-2.0, 2.0), effort=st.floats(-10.0, 10.0), gap=st.integers(1, 40))
def test_an_estimate_that_a_load_has_just_put_off_decides_nothing(load: float, effort: float, gap: int) -> None:
    """Two loads after each other, nearly the stall effort: the second meets a velocity unknown to the model."""
    bench = Bench(1.0)
    bench.run([effort * min(1.0, n / 30.0) for n in range(120)])
    bench.verdicts.clear()
    bench.run([effort] * gap, load=load)
    bench.run([effort] * 60, load=-load)
    assert set(bench.verdicts) == {None}


def test_an_effort_that_does_not_change_decides_nothing() -> None:
    """Whatever the gain: the disturbance takes the constant difference."""
    bench = Bench(1.0)
    bench.run([0.0] * 200)
    assert bench.test.surprise == 0.0
    assert bench.test.better_factor is None


@pytest.mark.parametrize("velocity", [20.0, 100.0, -100.0])
@pytest.mark.parametrize(("counts", "samples"), [(-1.0, 3), (0.5, 3), (2.0, 3), (0.0, 5)])
def test_a_change_of_the_encoder_in_a_cruise_is_told_by_its_third_sample_and_a_standstill_by_its_fifth(
    velocity: float, counts: float, samples: int
) -> None:
    bench = Bench(1.0).cruise(velocity)
    bench.change(counts)
    effort = velocity * PLANT.pole / PLANT.gain
    bench.run([effort] * (samples + 1))  # the first sample is that of the place where it changes
    assert bench.verdicts == [None] * samples + [counts]


@pytest.mark.parametrize("velocity", [5.0, 10.0, 20.0, 100.0])
def test_an_encoder_that_turns_round_is_told_at_a_quarter_of_that_speed_as_well(velocity: float) -> None:
    bench = Bench(1.0).cruise(velocity)
    bench.change(-1.0)
    bench.run([velocity * PLANT.pole / PLANT.gain] * 6)
    told = [one for one in bench.verdicts if one is not None]
    assert bench.verdicts[:3] == [None] * 3
    assert set(told) == {-1.0}


@pytest.mark.parametrize("velocity", [20.0, -20.0, 100.0])
@pytest.mark.parametrize(("counts", "samples"), [(-1.0, 6), (2.0, 6)])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_a_change_within_a_period_is_told_by_its_seventh_sample(
    velocity: float, counts: float, samples: int, share: float
) -> None:
    """The first sample shows a part of it, which a hypothesis of a whole one, or of a later one, cannot explain."""
    bench = Bench(1.0).cruise(velocity)
    effort = velocity * PLANT.pole / PLANT.gain
    bench.change(counts)
    bench.changed_at -= (1.0 - share) * velocity * PERIOD_S
    bench.run([effort] * (samples + 1))
    assert bench.verdicts[-1] == counts


def test_an_encoder_that_stands_still_from_rest_on_explains_what_a_growing_effort_does_not_do() -> None:
    bench = Bench(1.0).cruise(0.0)
    bench.change(0.0)
    bench.run([6.0, 12.0, 17.0])
    assert not bench.test.seems_to_stand
    bench.run([20.0, 20.0, 20.0])
    assert bench.test.seems_to_stand


@settings(max_examples=40, deadline=None)
@given(gain=st.floats(0.7, 1.3), pole=st.floats(0.7, 1.3), effort=st.floats(-20.0, 20.0), share=st.floats(-1.0, 0.5))
def test_no_healthy_axis_that_sets_out_seems_to_stand(gain: float, pole: float, effort: float, share: float) -> None:
    """Up to half of the effort is held by a load; an axis whose whole effort is held does stand."""
    bench = Bench(gain, pole).run([0.0] * 20)
    for _ in range(60):
        bench.run([effort], load=share * effort)
        assert not bench.test.seems_to_stand


@pytest.mark.parametrize("counts", [-1.0, 0.0, 0.5, 2.0])
@pytest.mark.parametrize("load", [-2.0, 0.0, 2.0])
def test_what_is_reckoned_after_a_change_is_the_true_speed(counts: float, load: float) -> None:
    """Whatever the encoder has shown since: the plant is as it was, and the effort of each tick is known."""
    bench = Bench(1.0)
    bench.run([100.0 * PLANT.pole / PLANT.gain + load] * 400, load=load)
    bench.change(counts)
    bench.run([12.0, 4.0, 9.0, -3.0, 2.0, 8.0], load=load)
    factor = bench.test.better_factor
    assert factor == counts
    reckoning = bench.test.reckon(factor)
    assert reckoning.velocity == pytest.approx(bench.velocity, rel=1e-3)
    assert reckoning.disturbance == pytest.approx(-load, abs=1e-3)


@pytest.mark.parametrize("factor", [-1.0, 2.0, 0.5])
def test_what_is_reckoned_with_another_gain_brings_the_plant_to_rest(factor: float) -> None:
    """The effort for what is reckoned, on the model, is the one that takes the plant's own speed away."""
    bench = Bench(factor)
    told = next(told for effort in RAMP if (told := bench.run([effort]).test.better_factor) is not None)
    velocity, _ = bench.test.reckon(told)
    effort = -MODEL.a22 * velocity / MODEL.b2
    rest = bench.plant.a22 * bench.velocity + bench.plant.b2 * effort
    assert abs(rest) < 0.35 * abs(bench.velocity)


@pytest.mark.parametrize("rebound", [0.3, 0.6])
def test_a_collision_is_not_a_mirrored_motion(rebound: float) -> None:
    bench = Bench(1.0).cruise(20.0)
    bench.velocity *= -rebound
    bench.run([20.0 * 14.0 / 180.0] * 20)
    assert -1.0 not in bench.verdicts


def test_an_axis_that_runs_against_a_wall_is_one_that_stands_still() -> None:
    """An encoder that freezes looks the same."""
    bench = Bench(1.0).cruise(20.0)
    bench.plant = Plant(1e-9, 1e6).discretise(PERIOD_S)
    bench.velocity = 0.0
    bench.run([20.0 * 14.0 / 180.0] * 8)
    assert {one for one in bench.verdicts if one is not None} == {0.0}


def test_another_origin_and_a_missing_sample_surprise_nobody() -> None:
    bench = Bench(1.0).run(RAMP)
    bench.test.shift(500.0)
    bench.observer.position += 500.0
    bench.position += 500.0
    bench.run(RAMP[::-1])
    bench.observer.predict(0.0)
    bench.test.predict(0.0)
    bench.position += MODEL.a12 * bench.velocity
    bench.velocity *= MODEL.a22
    bench.run([0.0] * 50)
    assert bench.test.surprise < 1e-6
    assert set(bench.verdicts) == {None}


def test_a_tick_of_transport_delay_more_is_no_other_gain() -> None:
    bench = Bench(1.0)
    observer, test = bench.observer, bench.test
    verdicts, before = set(), 0.0
    for effort in [*RAMP, *RAMP[::-1], *[-one for one in RAMP]]:
        observer.update(bench.position, effort)
        test.update(bench.position, effort, observer, 0.0)
        bench.position += MODEL.a12 * bench.velocity + MODEL.b1 * before
        bench.velocity = MODEL.a22 * bench.velocity + MODEL.b2 * before
        before = effort
        verdicts.add(test.better_factor)
    assert verdicts == {None}


@pytest.mark.parametrize("counts", [-1.0, 0.0, 0.5, 2.0])
def test_another_origin_changes_no_verdict(counts: float) -> None:
    """Whoever homes an axis in motion tells it another place; what its encoder does is judged as before."""
    verdicts = []
    for distance in (0.0, 1000.0):
        bench = Bench(1.0).cruise(100.0)
        bench.position += distance
        bench.observer.position += distance
        bench.test.shift(distance)
        bench.change(counts)
        bench.run([100.0 * PLANT.pole / PLANT.gain] * 60)
        verdicts.append(bench.verdicts)
    assert verdicts[0] == verdicts[1]
    assert set(verdicts[0]) != {None}


def test_a_sample_counts_for_the_time_at_which_it_was_taken() -> None:
    """Some milliseconds before the instant of the effort, while the axis speeds up: with its date it is no surprise."""
    surprise = {}
    for lag_s, told_s in ((0.0, 0.0), (0.004, 0.004), (0.004, 0.0)):
        bench = Bench(1.0)
        for effort in RAMP:
            sample = bench.position - bench.velocity * lag_s
            bench.observer.update(sample + bench.observer.velocity * told_s, effort)
            bench.test.update(sample, effort, bench.observer, 0.0, told_s)
            bench.verdicts.append(bench.test.better_factor)
            bench.position += bench.plant.a12 * bench.velocity + bench.plant.b1 * effort
            bench.velocity = bench.plant.a22 * bench.velocity + bench.plant.b2 * effort
        surprise[lag_s, told_s] = bench.test.surprise
    assert surprise[0.004, 0.004] < 0.5 * surprise[0.004, 0.0]
    assert surprise[0.0, 0.0] < 0.5 * surprise[0.004, 0.0]
