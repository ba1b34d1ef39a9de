import math
import random

import pytest

from twostage_servo.host.send_offset import FixedOffset, LearnedOffset, send_offset
from twostage_servo.host.settings import RealtimeSettings

PERIOD_S = 0.01


@pytest.mark.parametrize("seed", range(3))
def test_it_covers_199_of_200_times(seed: int) -> None:
    source = random.Random(seed)  # noqa: S311
    offset = LearnedOffset(PERIOD_S)
    ready = [60e-6 + source.expovariate(1 / 20e-6) for _ in range(40_000)]
    for ready_s in ready[:10_000]:
        offset.learn(ready_s)
    covered = 0
    for ready_s in ready[10_000:]:
        covered += ready_s <= offset.offset_s
        offset.learn(ready_s)
    assert 0.9925 <= covered / 30_000 <= 0.9975


def test_it_is_there_within_two_seconds() -> None:
    source = random.Random(1)  # noqa: S311
    offset = LearnedOffset(PERIOD_S)
    covered = 0
    for index in range(200):
        ready_s = 400e-6 + source.expovariate(1 / 40e-6)
        covered += index >= 20 and ready_s <= offset.offset_s
        offset.learn(ready_s)
    assert covered >= 0.97 * 180


def test_a_host_that_gets_other_work_is_followed_within_a_few_ticks() -> None:
    offset = LearnedOffset(PERIOD_S)
    for _ in range(400):
        offset.learn(200e-6)
    late = 0
    for _ in range(10):
        late += offset.offset_s < 450e-6
        offset.learn(450e-6)
    assert 0 < late <= 8
    assert offset.offset_s < 550e-6


def test_one_late_command_now_and_then_changes_an_interval_by_eight_microseconds_at_most() -> None:
    offset = LearnedOffset(PERIOD_S)
    for _ in range(200):
        offset.learn(0.15e-3)
    for ready_s in (0.0, 0.9e-3, *(40 * [0.0]), 0.9e-3):
        before_s = offset.offset_s
        offset.learn(ready_s)
        assert 0.0 < abs(offset.offset_s - before_s) < 8e-6


@pytest.mark.parametrize(("period_s", "cap_s"), [(0.001, 100e-6), (0.01, 1e-3), (0.1, 1e-3)])
def test_it_stays_within_its_cap_and_above_zero(period_s: float, cap_s: float) -> None:
    offset = LearnedOffset(period_s)
    for _ in range(1000):
        offset.learn(cap_s)
        assert offset.offset_s <= cap_s
    assert offset.offset_s == pytest.approx(cap_s, abs=0.1e-6)
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
        offset = send_offset(RealtimeSettings.model_validate(settings), PERIOD_S)
        assert offset is None or isinstance(offset, LearnedOffset | FixedOffset)
        return offset

    assert isinstance(asked(), LearnedOffset)
    assert asked(send_at="off") is None
    assert asked(send_at=0.0) is None
    assert asked(spin="off") is None
    assert isinstance(asked(spin=100.0), LearnedOffset)
    fixed = asked(spin="off", send_at=120)
    assert isinstance(fixed, FixedOffset)
    fixed.learn(0.1)
    assert fixed.offset_s == pytest.approx(120e-6)
    short = send_offset(RealtimeSettings(send_at=1000.0), 0.001)
    assert short is not None
    assert short.offset_s == 0.5e-3
