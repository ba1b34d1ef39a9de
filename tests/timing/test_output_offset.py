import math
import random

import pytest

from twostage_servo.host.settings import RealtimeSettings
from twostage_servo.timing.output_offset import FixedOffset, LearnedOffset, output_offset

PERIOD_S = 0.01


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mean_s", [10e-6, 40e-6])
def test_as_many_are_late_as_the_tail_of_the_times_says(seed: int, mean_s: float) -> None:
    """Times beyond any level exceed it by mean_s, and by this step where 50 us are the most that counts."""
    step_s = mean_s * (1.0 - math.exp(-50e-6 / mean_s))
    source = random.Random(seed)  # noqa: S311
    offset = LearnedOffset(PERIOD_S)
    late = 0
    for index in range(60_000):
        ready_s = 60e-6 + source.expovariate(1 / mean_s)
        late += index >= 10_000 and ready_s > offset.offset_s
        offset.learn(ready_s)
    assert late / 50_000 == pytest.approx(0.1e-6 / step_s, rel=0.2)


def test_a_host_that_gets_other_work_is_followed_within_a_few_ticks() -> None:
    offset = LearnedOffset(PERIOD_S)
    for _ in range(400):
        offset.learn(150e-6)
    late = 0
    for _ in range(20):
        late += offset.offset_s < 449e-6
        offset.learn(450e-6)
    assert late == 6  # 300 us in steps of 50: the offset had the 150 from the start
    assert offset.offset_s == pytest.approx(450e-6, abs=0.2e-6)


def test_the_command_behind_a_late_one_leaves_as_long_after_its_deadline() -> None:
    offset = LearnedOffset(PERIOD_S)
    late_s = offset.offset_s + 37e-6
    offset.learn(late_s)
    assert offset.offset_s == pytest.approx(late_s, abs=1e-12)
    offset.learn(0.0)
    assert offset.offset_s == pytest.approx(late_s - 0.1e-6, abs=1e-12)


def test_an_outlier_is_followed_for_fifty_microseconds_and_waited_off_within_six_seconds() -> None:
    offset = LearnedOffset(PERIOD_S)
    before_s = offset.offset_s
    offset.learn(before_s + 700e-6)
    assert offset.offset_s == pytest.approx(before_s + 50e-6)
    for _ in range(550):
        offset.learn(0.0)
    assert offset.offset_s < before_s


@pytest.mark.parametrize(("period_s", "cap_s"), [(0.001, 100e-6), (0.01, 1e-3), (0.1, 1e-3)])
def test_it_stays_within_its_cap_and_above_zero(period_s: float, cap_s: float) -> None:
    offset = LearnedOffset(period_s)
    for _ in range(1000):
        offset.learn(cap_s)
        assert offset.offset_s <= cap_s
    assert offset.offset_s == pytest.approx(cap_s, abs=0.2e-6)
    for _ in range(30_000):
        offset.learn(0.0)
    assert 0.0 <= offset.offset_s < 0.1e-6


def test_a_time_that_no_offset_could_make_up_for_teaches_nothing() -> None:
    offset = LearnedOffset(PERIOD_S)
    before_s = offset.offset_s
    for ready_s in (1.1e-3, 5e-3, 3.0, math.inf):
        offset.learn(ready_s)
    assert offset.offset_s == before_s


def test_what_the_setting_asks_for() -> None:
    def asked(**settings: str | float) -> LearnedOffset | FixedOffset | None:
        table = RealtimeSettings.model_validate(settings)
        offset = output_offset(table.output_offset, table.busy_wait, PERIOD_S)
        assert offset is None or isinstance(offset, LearnedOffset | FixedOffset)
        return offset

    assert isinstance(asked(), LearnedOffset)
    assert asked(output_offset="off") is None
    assert asked(output_offset=0.0) is None
    assert asked(busy_wait="off") is None
    assert isinstance(asked(busy_wait=100.0), LearnedOffset)
    fixed = asked(busy_wait="off", output_offset=120)
    assert isinstance(fixed, FixedOffset)
    fixed.learn(0.1)
    assert fixed.offset_s == pytest.approx(120e-6)
    short = output_offset(1000.0, "auto", 0.001)
    assert short is not None
    assert short.offset_s == 0.5e-3
