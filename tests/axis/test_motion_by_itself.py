"""What a motion believes of its drive, tick by tick, with the drive's report written by hand."""

import math
import statistics
from collections import deque
from random import Random
from types import SimpleNamespace
from typing import Any

import pytest

from tests.axis.rig import DEMO, PERIOD_S, axis_settings
from twostage_servo.axis.design import AxisDesign, design_axis
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.control.laws.adaptive.law import AdaptiveLaw
from twostage_servo.control.laws.law import Stage
from twostage_servo.control.plant import Plant

DESIGN = design_axis(axis_settings(), PERIOD_S)
"""An innovation of 0.5 mm and 3 ms of speed is believed; a stall takes 5 ticks."""


class Bench:
    """A motion with the report that it reads, at rest at a place that it tracks, or holds."""

    def __init__(self, position: float = 10.0, resolution: float = 0.001, design: AxisDesign = DESIGN) -> None:
        drive: Any = SimpleNamespace(
            fresh=False,
            position=None,
            age_s=None,
            is_stale=False,
            encoder=SimpleNamespace(step=lambda before, now: now - before),
        )
        self.drive = drive
        self.motion = Motion(design, drive, resolution)
        self.observer = self.motion.law.observer
        self.position = position

    def report(self, position: float | None, age_s: float | None = None, missed: int = 0) -> None:
        self.drive.fresh = position is not None
        if position is not None:
            self.drive.position = position
        self.drive.age_s = age_s
        self.motion.begin_tick(missed)

    def track(self, *positions: float | None) -> "Bench":
        for position in positions:
            self.report(position)
            self.motion.track()
        return self

    def holding(self) -> "Bench":
        self.track(*3 * [self.position])
        self.motion.start()
        return self

    def step(self, position: float | None, age_s: float | None = None, missed: int = 0) -> float:
        self.report(position, age_s, missed)
        return self.motion.step()

    def estimate(self) -> tuple[float, float]:
        return self.observer.position, self.observer.velocity


def test_a_new_motion_has_seen_nothing() -> None:
    motion = Bench().motion
    assert [motion.blind] == [False]
    assert (motion.predicted, motion.implausible, motion.implausible_distance) == (0, 0, 0.0)
    assert (motion.unchanged_effort, motion.recent_way) == (0.0, math.inf)


# Tracking -----------------------------------------------------------------------------------------------------------


def test_tracking_begins_at_the_first_sample_and_takes_the_speed_from_the_second() -> None:
    bench = Bench()
    bench.track(None)
    assert bench.motion.expected_position(driven=False) is None
    assert bench.estimate() == (0.0, 0.0)
    bench.track(10.0)
    assert bench.estimate() == (10.0, 0.0)
    assert bench.motion.expected_position(driven=False) == 10.0
    bench.track(11.0)
    expected = DESIGN.build_law().observer
    expected.start_moving(10.0, 11.0, 1)
    assert bench.estimate() == (expected.position, expected.velocity)
    assert expected.velocity > 50.0
    expected.update(expected.position + 0.3, 0.0)
    bench.track(bench.observer.position + 0.3)
    assert bench.estimate() == (expected.position, expected.velocity)


def test_another_origin_between_the_first_two_samples_is_no_speed() -> None:
    bench = Bench().track(10.0)
    bench.motion.shift(100.0)
    bench.track(110.0)
    assert bench.estimate() == pytest.approx((110.0, 0.0))


def test_while_nothing_is_tracked_only_a_driven_axis_has_an_expected_position() -> None:
    motion = Bench().motion
    assert motion.expected_position(driven=False) is None
    assert motion.expected_position(driven=True) == 0.0


def test_a_spike_while_tracking_is_passed_over_and_a_second_one_says_how_fast_it_goes() -> None:
    for side in (1.0, -1.0):
        bench = Bench().track(10.0, 10.0, 10.0)
        bench.track(10.0 + side * 0.6)
        assert bench.estimate() == (10.0, 0.0)
        bench.track(10.0, 10.0 + side * 0.6)  # another one, not the second of the first
        assert bench.estimate() == pytest.approx((10.0, 0.0))
        bench.track(10.0 + side * 1.0)
        expected = DESIGN.build_law().observer
        expected.start_moving(10.0 + side * 0.6, 10.0 + side * 1.0, 1)
        assert bench.estimate() == pytest.approx((expected.position, expected.velocity))
        bench.track(bench.observer.position, bench.observer.position)
        before = bench.estimate()
        bench.track(bench.observer.position + side * 20.0)  # a first one again
        assert abs(bench.observer.velocity) < abs(before[1])


def test_after_it_was_driven_a_spike_is_a_first_one() -> None:
    bench = Bench().track(10.0, 10.0, 10.6)
    bench.motion.start()
    bench.track(10.7)
    assert bench.estimate() == pytest.approx((10.0, 0.0))


def test_while_tracking_as_much_is_believed_as_an_innovation_may_be() -> None:
    for distance, believed in ((0.5, True), (-0.5, True), (0.51, False), (-0.51, False)):
        bench = Bench().track(0.0, 0.0, distance)
        assert (bench.observer.position != 0.0) is believed


def test_the_limit_grows_by_3_ms_of_the_speed() -> None:
    bench = Bench()
    assert bench.motion.innovation_gate == 0.5
    for velocity in (100.0, -100.0):
        bench.observer.velocity = velocity
        assert bench.motion.innovation_gate == pytest.approx(0.8)


@pytest.mark.parametrize("reason", ["stale", "blind", "told"])
def test_after_a_while_without_sight_it_starts_afresh(reason: str) -> None:
    bench = Bench().track(10.0, 10.0, 10.6)  # the last one is a spike, so far
    bench.drive.is_stale, bench.motion.blind = reason == "stale", reason == "blind"
    if reason == "told":
        bench.motion.lose_track()
    else:
        bench.track(10.0)
    assert bench.motion.blind is False
    assert bench.motion.expected_position(driven=False) is None
    bench.drive.is_stale = False
    bench.track(50.0)
    assert bench.estimate() == (50.0, 0.0)
    bench.track(50.2)
    expected = DESIGN.build_law().observer
    expected.start_moving(50.0, 50.2, 1)
    assert bench.estimate() == pytest.approx((expected.position, expected.velocity))


def test_the_last_effort_acts_for_one_tick_after_the_law_has_ended() -> None:
    bench = Bench().holding()
    bench.motion.set_target(400.0, 100.0)
    for _ in range(3):
        effort = bench.step(bench.observer.position)
    assert effort > 0.4
    expected = DESIGN.build_law().observer
    expected.continue_from(bench.observer)
    bench.track(None, None)
    expected.predict(effort)
    expected.predict(0.0)
    assert bench.estimate() == pytest.approx((expected.position, expected.velocity))


# Driven -------------------------------------------------------------------------------------------------------------


def test_what_lies_where_it_may_is_believed_and_what_does_not_is_counted() -> None:
    for distance in (0.5, -0.5):
        bench = Bench(0.0).holding()
        bench.step(distance)
        assert (bench.motion.implausible, bench.motion.predicted, bench.observer.position != 0.0) == (0, 0, True)
    for distance in (0.51, -0.51):
        bench = Bench(0.0).holding()
        for count in (1, 2, 3):
            bench.step(distance)
            assert (bench.motion.implausible, bench.motion.predicted) == (count, count)
        assert bench.motion.implausible_distance == distance
        assert bench.estimate() == (0.0, 0.0)
        bench.step(0.1)
        assert (bench.motion.implausible, bench.motion.predicted) == (0, 3)


def test_without_sight_the_model_goes_on_and_counts() -> None:
    bench = Bench().holding()
    bench.step(None)
    bench.drive.fresh, bench.drive.position = True, None
    bench.motion.step()
    bench.motion.blind = True
    bench.step(10.1)
    assert bench.motion.predicted == 3
    assert bench.estimate() == pytest.approx((10.0, 0.0))


def test_a_sample_is_taken_as_it_was_at_the_last_command() -> None:
    """At 100 mm/s a sample of 4 ms ago, where it is wanted of 10 ms ago, is as far off as the axis coasts in 6 ms."""
    way = Plant(180.0, 14.0).discretise(0.006).a12 * 100.0
    for velocity in (100.0, -100.0):
        dated, undated = Bench(0.0).holding(), Bench(0.0).holding()
        for bench in (dated, undated):
            bench.observer.velocity = velocity
        dated.step((0.1 + way) * math.copysign(1.0, velocity), age_s=0.004)
        undated.step(0.1 * math.copysign(1.0, velocity))
        assert dated.estimate() == pytest.approx(undated.estimate(), rel=1e-3)


def test_after_missed_ticks_only_a_sample_with_a_date_is_used() -> None:
    bench = Bench().holding()
    bench.step(10.1, missed=1)
    assert (bench.motion.predicted, bench.observer.position) == (1, 10.0)
    bench.step(10.1, age_s=PERIOD_S, missed=1)
    assert bench.motion.predicted == 1
    assert bench.observer.position > 10.0
    bench.step(10.1)
    assert bench.motion.predicted == 1


@pytest.mark.parametrize("lag", [1.0, 1.25, 2.0, 2.5, 3.0, 4.0])
def test_a_sample_from_among_missed_ticks_is_compared_with_where_the_model_was_then(lag: float) -> None:
    """The axis speeds up by 90 mm/s in these ticks, so its present speed would not do."""
    bench = Bench().holding()
    bench.observer.velocity, bench.observer.disturbance = 20.0, 20.0
    wanted = DESIGN.build_law().observer
    wanted.continue_from(bench.observer)
    path = [wanted.position]
    for _ in range(3):
        wanted.predict(0.0)
        path.append(wanted.position)
    bench.motion.skip(3)
    assert bench.estimate() == pytest.approx((wanted.position, wanted.velocity))
    ago = min(lag, 3.0)
    whole = math.ceil(ago)
    then = path[3 - whole] + (whole - ago) * (path[min(4 - whole, 3)] - path[3 - whole])
    bench.step(then, age_s=(1.0 + lag) * PERIOD_S, missed=3)
    assert bench.motion.implausible == 0
    assert bench.observer.innovation == pytest.approx(0.0, abs=1e-9)


def test_missed_ticks_move_law_and_nominal_alike() -> None:
    bench = Bench().holding()
    bench.motion.set_target(400.0, 100.0)
    for _ in range(20):
        bench.step(bench.observer.position)
    observer = DESIGN.build_law().observer
    observer.continue_from(bench.observer)
    for _ in range(3):
        observer.predict(bench.motion.law.effort)
    bench.motion.skip(3)
    assert bench.estimate() == pytest.approx((observer.position, observer.velocity))
    assert bench.motion.following_error == pytest.approx(0.0)


def test_beginning_to_hold_forgets_what_was() -> None:
    bench = Bench().holding()
    bench.motion.set_target(400.0, 100.0)
    for _ in range(12):
        bench.step(10.0)
    bench.motion.blind = True
    assert bench.motion.implausible > 0 or bench.motion.unchanged_effort > 0.0
    bench.track(None)
    bench.motion.start()
    assert (bench.motion.blind, bench.motion.implausible, bench.motion.unchanged_effort) == (False, 0, 0.0)
    assert (bench.motion.recent_way, bench.motion.following_error) == (math.inf, 0.0)
    assert bench.motion.law.stage is bench.motion.nominal.stage is Stage.POSITION


def test_law_and_nominal_are_told_the_same() -> None:
    motion = Bench().holding().motion
    motion.set_target(400.0, 100.0)
    for law in (motion.law, motion.nominal):
        assert (law.target, law.cruise_velocity, law.stage) == (400.0, 100.0, Stage.SPEED)
    motion.shift(-7.0)
    for law in (motion.law, motion.nominal):
        assert (law.target, law.observer.position) == (393.0, 3.0)
    motion.nominal.observer.position = 99.0
    assert motion.following_error == -96.0
    motion.stop(1000.0)
    assert motion.following_error == 0.0
    assert motion.law.stage is motion.nominal.stage is Stage.BRAKE


def test_the_way_of_late_is_that_of_the_last_six_samples() -> None:
    """What lies within a stall time of 50 ms; a shift of the origin is none of it."""
    bench = Bench(0.0).holding()
    samples = [0.0, 0.03, -0.02, 0.01, 0.0]
    for sample in samples:
        bench.step(sample)
        assert bench.motion.recent_way == math.inf
    bench.step(0.02)
    assert bench.motion.recent_way == pytest.approx(0.05)
    bench.step(0.0)
    bench.step(0.0)
    assert bench.motion.recent_way == pytest.approx(0.04)
    bench.step(None)
    assert bench.motion.recent_way == pytest.approx(0.04)
    bench.motion.shift(1.0)
    assert bench.motion.recent_way == pytest.approx(0.04)
    bench.step(1.05)
    assert bench.motion.recent_way == pytest.approx(0.05)  # from 0, which is 1 now


def test_the_effort_is_compared_with_that_of_the_last_other_position() -> None:
    """Another one is farther than one and a half steps of the encoder, here 0.15 mm; another origin is none."""
    for side in (1.0, -1.0):
        bench = Bench(0.0, resolution=0.1).holding()
        bench.step(0.0)
        first = bench.motion.law.effort
        assert bench.motion.unchanged_effort == 0.0
        bench.motion.set_target(side * 400.0, 100.0)
        for sample in (0.0, 0.0, side * 0.149):
            bench.step(sample)
            assert bench.motion.unchanged_effort == pytest.approx(abs(bench.motion.law.effort - first))
        assert bench.motion.unchanged_effort > 0.0
        bench.step(side * 0.151)
        assert bench.motion.unchanged_effort == 0.0
        bench.step(side * 0.151)
        before = bench.motion.unchanged_effort
        assert before > 0.0
        bench.motion.shift(1.0)
        bench.step(1.0 + side * 0.151)
        assert bench.motion.unchanged_effort > before


def test_an_estimate_that_is_given_up_keeps_its_place_and_takes_its_speed_from_the_model() -> None:
    bench = Bench().holding()
    bench.observer.velocity, bench.observer.disturbance = 50.0, 1.0
    bench.motion.distrust()
    assert bench.motion.blind
    # Reckoned from where it has been holding, undisturbed.
    assert (bench.observer.position, bench.observer.velocity, bench.observer.disturbance) == (10.0, 0.0, 0.0)


@pytest.mark.parametrize("in_doubt", [True, False])
def test_blind_it_goes_on_from_before_the_samples_that_are_in_doubt(*, in_doubt: bool) -> None:
    """The last sample was off by 0.2 mm, which is believed, or by 30 mm, which is not."""
    bench = Bench().holding()
    for _ in range(20):
        bench.observer.velocity = 50.0
        bench.step(bench.observer.position)
    bench.observer.velocity = 80.0  # what samples since have made of it
    bench.motion.implausible = int(in_doubt)
    bench.motion.ignore_feedback()
    assert (abs(bench.observer.velocity - 80.0) < 5.0) is not in_doubt


def test_a_stop_goes_on_from_what_the_model_says_when_its_estimate_is_given_up() -> None:
    bench = Bench().holding()
    bench.observer.velocity = 50.0
    bench.motion.stop(2000.0)
    assert bench.motion.law.speed_reference == 50.0
    bench.motion.distrust()
    assert bench.motion.law.speed_reference == 0.0


def test_what_may_be_held_bears_no_more_than_it_does_already() -> None:
    bench = Bench().holding()
    bench.step(10.0)
    bench.step(10.0)  # the encoder shows the same again
    bench.motion.distrust()
    for effort, limit in ((-7.0, 7.0), (1.0, 2.5)):  # the effort of that moment, or the stall effort
        bench.motion.law.effort = effort
        bench.motion.stop(4000.0)
        assert bench.motion.law.effort_limit == limit
    bench.motion.start()
    assert bench.motion.law.effort_limit == 24.0


def test_an_encoder_that_seems_to_stand_still_shows_motion_by_a_sample_alone() -> None:
    bench = Bench().holding()
    bench.step(10.0)
    bench.step(10.0)
    bench.motion.distrust()
    bench.step(None)
    assert not bench.motion.moves_after_all
    bench.step(10.0)
    assert not bench.motion.moves_after_all
    bench.step(11.0)
    assert bench.motion.moves_after_all


@pytest.mark.parametrize(("resolution", "least"), [(0.001, 0.3), (1.0, 1.5)])
def test_motion_is_more_than_the_noise_and_than_a_step_of_the_encoder(resolution: float, least: float) -> None:
    """Three deviations of the measured position, 0.1 mm; one and a half steps."""
    for side in (1.0, -1.0):
        bench = Bench(resolution=resolution).holding()
        bench.step(10.0)
        bench.step(10.0)
        bench.motion.distrust()
        bench.report(10.0 + side * (least - 0.001))
        assert [bench.motion.moves_after_all] == [False]
        bench.report(10.0 + side * (least + 0.001))
        assert [bench.motion.moves_after_all] == [True]


def test_what_a_sample_corrects_stands_and_what_the_model_predicts_does_not() -> None:
    """The speed at which a stop begins has what lasting corrections make up for."""
    speeds = []
    for seen in (True, False):
        bench = Bench().holding()
        bench.motion.model_monitor.is_sure = False
        for _ in range(30):
            bench.observer.velocity = 50.0
            bench.step(bench.observer.position + 0.2 if seen else None)
        bench.observer.velocity = 50.0
        bench.motion.stop(2000.0)
        speeds.append(bench.motion.law.speed_reference)
    assert speeds[0] > 55.0
    assert speeds[1] == pytest.approx(50.0)


def test_an_axis_of_which_nothing_has_been_shown_does_not_stand() -> None:
    """What an encoder that stands seems to hold is no disturbance; before the first sample none has stood."""
    bench = Bench().holding()
    bench.observer.velocity, bench.observer.disturbance = 50.0, 1.0
    bench.motion.stop(2000.0)
    bench.step(None)
    assert bench.observer.disturbance > 0.5
    bench.step(11.0)
    bench.step(11.0)
    assert bench.observer.disturbance == 0.0


def test_an_encoder_that_still_stands_as_a_move_begins_takes_no_disturbance_away() -> None:
    bench = Bench().holding()
    bench.motion.set_target(400.0, 100.0)
    for _ in range(2):
        bench.step(10.0)
    assert bench.motion.law.stage is Stage.SPEED
    bench.observer.disturbance = 1.0
    bench.step(10.0)
    assert bench.observer.disturbance == pytest.approx(1.0, abs=0.5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("step", "moves"), [(0.141, False), (0.142, True)])
def test_two_samples_that_differ_by_no_more_than_their_noise_make_no_speed(
    sign: float, step: float, moves: bool
) -> None:
    """0.1 mm each, √2 of that for the difference. Otherwise v = a22 y/a12, and a22 of that a tick later."""
    bench = Bench().track(10.0, 10.0 + sign * step)
    speed = 0.869358**2 * sign * step / 0.00933155
    assert bench.observer.velocity == pytest.approx(speed if moves else 0.0, rel=1e-4)
    assert bench.observer.position == pytest.approx(10.0 + sign * (step + 0.869358 * step * moves), rel=1e-5)
    assert bench.motion.knows_speed


def test_an_axis_at_rest_behind_a_noisy_encoder_is_not_armed_with_a_speed() -> None:
    """After four samples, over a hundred noises of 0.0316 mm; a speed of the first two would last for ten."""
    random = Random(3)  # noqa: S311 - noise, not a secret
    speeds = []
    for _ in range(100):
        bench = Bench().track(*(random.gauss(10.0, 0.0316) for _ in range(4)))
        speeds.append(bench.observer.velocity)
    assert statistics.pstdev(speeds) < 0.5


def test_the_speed_is_known_from_the_second_sample_on_until_the_track_is_lost() -> None:
    bench = Bench()
    known = [bench.track(10.0).motion.knows_speed for _ in range(3)]
    bench.motion.lose_track()
    assert [*known, bench.motion.knows_speed] == [False, True, True, False]


@pytest.mark.parametrize("name", ["position", "velocity", "disturbance", "effort"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_nothing_of_the_law_may_be_no_number(name: str, value: float) -> None:
    motion = Bench().holding().motion
    assert [motion.finite] == [True]
    setattr(motion.law if name == "effort" else motion.law.observer, name, value)
    assert [motion.finite] == [False]


def test_the_model_is_judged_by_the_speed_of_late_which_fades_in_5_s() -> None:
    """The speed that the test is told: the largest so far, less 0.2 % a tick."""
    told: list[Any] = []
    predicted: list[float] = []
    bench = Bench(0.0).holding()
    test: Any = bench.motion.model_monitor
    bench.motion.model_monitor = SimpleNamespace(  # type: ignore[assignment]
        update=lambda sample, effort, _, speed, lag_s: told.append((sample, effort, speed)),
        is_sure=True,
        predict=predicted.append,
        start=test.start,
    )
    bench.observer.velocity = -100.0
    efforts = [bench.motion.law.effort]
    efforts.append(bench.step(0.0))
    speed = abs(bench.observer.velocity)
    assert told == [(0.0, efforts[0], pytest.approx(speed))]
    bench.observer.velocity = 0.0
    efforts.append(bench.step(bench.observer.position))
    assert abs(bench.observer.velocity) < 0.9 * speed
    assert told[1][1:] == (efforts[1], pytest.approx(0.998 * speed))
    bench.step(None)
    bench.motion.skip(2)
    assert predicted == [efforts[2], bench.motion.law.effort, bench.motion.law.effort]
    bench.observer.velocity = 0.0
    bench.motion.start()
    bench.step(bench.observer.position)
    assert told[2][2] == pytest.approx(abs(bench.observer.velocity))


@pytest.mark.parametrize(
    ("disturbance", "velocity", "stage", "blind", "cannot"),
    [
        # Of 34 V at 100 mm/s friction that the model lacks is 8 V: 26 V remain at rest, and a stop may give 24.
        (34.0, 100.0, Stage.BRAKE, True, True),
        (31.0, 100.0, Stage.BRAKE, True, False),
        (-34.0, 100.0, Stage.BRAKE, True, False),  # a load that slows it down
        (-34.0, -100.0, Stage.BRAKE, True, True),
        (34.0, 100.0, Stage.BRAKE, False, False),  # the encoder is believed
        (34.0, 100.0, Stage.POSITION, True, False),
    ],
)
def test_a_load_that_pushes_on_by_more_than_a_stop_may_give(
    disturbance: float, velocity: float, stage: Stage, blind: bool, cannot: bool
) -> None:
    law = SimpleNamespace(
        stage=stage, effort_limit=24.0, observer=SimpleNamespace(disturbance=disturbance, velocity=velocity)
    )
    motion: Any = SimpleNamespace(law=law, blind=blind, _friction=0.08, _gain=180.0)
    assert Motion.cannot_stop.fget(motion) is cannot  # type: ignore[attr-defined]  # a property of the class


def test_another_origin_moves_all_that_a_motion_remembers_of_positions() -> None:
    moved: list[float] = []
    part = SimpleNamespace(shift=moved.append)
    motion: Any = SimpleNamespace(
        law=part, nominal=part, model_monitor=part, _tracking=part, _unchanged=(3.0, 1.5, 0.5), _shown=4.0,
        _stands_at=5.0, _recent=deque([1.0, 2.0], maxlen=5),
    )  # fmt: skip
    Motion.shift(motion, 100.0)
    assert moved == [100.0] * 4
    assert (motion._unchanged, motion._shown, motion._stands_at) == ((103.0, 1.5, 0.5), 104.0, 105.0)
    assert list(motion._recent) == [101.0, 102.0]
    motion._unchanged = motion._shown = motion._stands_at = None
    Motion.shift(motion, 100.0)
    assert (motion._unchanged, motion._shown, motion._stands_at) == (None, None, None)


@pytest.mark.parametrize(("factor", "moves"), [(1.0, False), (1.0 + 1e-12, True)])
def test_a_difference_of_just_the_noise_of_two_samples_makes_no_speed(factor: float, moves: bool) -> None:
    bench = Bench().track(0.0, factor * math.sqrt(2.0) * 0.1)
    assert (bench.observer.velocity != 0.0) is moves


class Told:
    """Stands in for a part of a motion, and remembers what it is told."""

    def __init__(self, **values: Any) -> None:
        self.calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []
        self.values = values

    def __getattr__(self, name: str) -> Any:
        if name in self.values:
            return self.values[name]
        return lambda *given, **named: self.calls.append((name, given, named))

    def names(self) -> list[str]:
        return [name for name, _, _ in self.calls]


def told_monitor(bench: Bench) -> Told:
    monitor = Told(is_sure=True, better_factor=None, least=1.0)
    bench.motion.model_monitor = monitor  # type: ignore[assignment]
    return monitor


@pytest.mark.parametrize(
    ("missed", "age_s", "seen", "corrected"),
    [(0, None, True, True), (0, None, False, False), (3, 3.0 * PERIOD_S, True, False), (3, PERIOD_S, True, True)],
)
def test_a_stop_is_told_what_a_sample_of_now_has_corrected(
    missed: int, age_s: float | None, seen: bool, corrected: bool
) -> None:
    """One from among missed ticks says nothing of the effort since."""
    bench = Bench().holding()
    braking = Told()
    bench.motion._braking = braking  # type: ignore[assignment]
    if missed:
        bench.motion.skip(missed)
    bench.step(10.0 if seen else None, age_s, missed)
    (_, _, named) = braking.calls[-1]
    assert named == {"corrected": corrected, "sure": corrected}


@pytest.mark.parametrize(("gaps", "anew"), [([1], False), ([2], True), ([1, 1], True), ([3], True)])
def test_after_two_missed_ticks_without_a_sample_between_the_model_is_judged_anew(gaps: list[int], anew: bool) -> None:
    """20 ms; from the estimate and the effort of then."""
    bench = Bench().holding()
    bench.motion.set_target(400.0, 100.0)
    for _ in range(5):
        effort = bench.step(bench.observer.position)
    assert effort > 0.5
    monitor = told_monitor(bench)
    for missed in gaps[:-1]:
        bench.motion.skip(missed)
        bench.step(None, missed=missed)
    before = bench.motion.law.effort
    bench.motion.skip(gaps[-1])
    bench.step(bench.observer.position, PERIOD_S, gaps[-1])
    starts = [given for name, given, _ in monitor.calls if name == "start"]
    assert starts == [(bench.observer, before)] * anew
    assert ("update" in monitor.names()) is not anew


@pytest.mark.parametrize(
    ("outlier", "implausible", "doubted"), [(False, 0, False), (True, 0, True), (False, 1, True), (True, 1, True)]
)
def test_a_sample_is_doubted_while_tracking_and_while_driven(outlier: bool, implausible: int, doubted: bool) -> None:
    motion = Bench().motion
    motion._tracking.was_outlier, motion.implausible = outlier, implausible
    assert [motion.doubts_sample] == [doubted]


@pytest.mark.parametrize(
    ("load", "effort", "evidence"), [(0.0, 0.0, 0.0), (0.0, 1.5, 1.5), (-2.0, 2.0, 0.0), (-2.0, 0.0, 2.0)]
)
def test_an_effort_that_only_holds_the_load_is_no_sign_of_an_encoder_that_stands_still(
    load: float, effort: float, evidence: float
) -> None:
    """An axis that brakes with 6 V within its encoder's last step stays there, and its effort becomes that of rest."""
    bench = Bench(0.0).holding()
    bench.motion._load.load = load
    bench.motion._effort.last = -6.0
    bench.drive.position = 0.0
    bench.motion._unchanged = None
    bench.motion._compare_with_the_last()
    assert bench.motion.unchanged_effort == 0.0
    bench.motion._effort.last = effort
    bench.motion._compare_with_the_last()
    assert bench.motion.unchanged_effort == evidence
    bench.motion._effort.last = -6.0 - 0.5
    bench.motion._compare_with_the_last()
    assert bench.motion.unchanged_effort == 0.5


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("blind", [False, True])
def test_a_stop_begins_gradually_unless_blind_and_with_the_jerk_where_it_has_time(
    monkeypatch: pytest.MonkeyPatch, smooth: bool, blind: bool
) -> None:
    settings = AxisSettings.model_validate(DEMO | {"law": {"type": "adaptive", "jerk": 40_000.0}})
    bench = Bench(design=design_axis(settings, PERIOD_S)).holding()
    bench.observer.velocity, bench.observer.disturbance, bench.motion.blind = 50.0, -1.0, blind
    told: list[tuple[Any, ...]] = []

    def stop(
        _law: AdaptiveLaw, deceleration: float, friction: float, *, gradual: bool = False, jerk: float = math.inf
    ) -> None:
        told.append((deceleration, friction, gradual, jerk))

    monkeypatch.setattr(AdaptiveLaw, "stop", stop)
    bench.motion.stop(1500.0, smooth=smooth)
    # The load of -1 V goes with the speed: at 50 mm/s that is -0.02 V s/mm of friction.
    jerk = 40_000.0 if smooth and not blind else math.inf
    assert told == [(1500.0, pytest.approx(-0.02), not blind, jerk)]
