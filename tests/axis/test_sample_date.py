"""When a sample was taken that comes after missed ticks, by hand: the axis went 1 mm in each of them."""

from types import SimpleNamespace
from typing import Any

import pytest

from twostage_servo.axis.sample_date import SampleDate

PERIOD_S = 0.01


def dated(age_s: float | None, missed: int, effort: float = 0.0) -> tuple[SampleDate, float | None]:
    """Return how a sample at 50 mm is dated after so many missed ticks, in each of which the estimate moved by 1 mm.

    The axis coasts but for the effort: 1 V and a load that helps by 1 V each make it faster by 2 mm/s in a period.
    """
    plant = SimpleNamespace(a22=1.0, b2=2.0)
    observer: Any = SimpleNamespace(position=10.0, velocity=100.0, disturbance=0.0, plant=plant)
    drive: Any = SimpleNamespace(fresh=True, position=50.0, age_s=age_s)
    date = SampleDate(observer, drive, PERIOD_S)
    date.begin_tick(missed)
    date.begin_gap()
    for _ in range(missed):
        observer.position += 1.0
        date.record_missed()
    return date, date.sample(effort)


@pytest.mark.parametrize(
    ("periods", "lag_periods", "way"),
    [(1.6, 1, 0.6), (2.0, 1, 1.0), (3.0, 2, 2.0), (4.0, 3, 3.0), (5.0, 3, 3.0), (9.0, 3, 3.0)],
)
def test_a_sample_from_before_missed_ticks_is_no_older_than_they_are(
    periods: float, lag_periods: int, way: float
) -> None:
    """Three of them: it lies as far back as the estimate went since, at most to before the first."""
    date, sample = dated(periods * PERIOD_S, 3)
    assert (date.lag_periods, date.lag_s) == (lag_periods, 0.0)
    assert sample == pytest.approx(50.0 + way)


@pytest.mark.parametrize(("periods", "missed"), [(1.4, 3), (1.0, 3), (0.5, 1), (4.0, 0)])
def test_one_from_after_them_is_dated_by_the_speed(periods: float, missed: int) -> None:
    date, sample = dated(periods * PERIOD_S, missed)
    assert date.lag_periods == 0
    assert date.lag_s == pytest.approx((periods - 1.0) * PERIOD_S)
    assert sample == pytest.approx(50.0 + 100.0 * (periods - 1.0) * PERIOD_S)


@pytest.mark.parametrize(("missed", "sample"), [(0, 50.0), (1, None)])
def test_without_a_date_it_is_believed_where_no_tick_was_missed(missed: int, sample: float | None) -> None:
    assert dated(None, missed)[1] == sample


@pytest.mark.parametrize("periods", [0.6, 1.4])
def test_an_axis_that_speeds_up_was_slower_before(periods: float) -> None:
    """8 V make it faster by 16 mm/s in a period: 0.4 of one before an instant it was 3.2 mm/s slower on the average."""
    date, sample = dated(periods * PERIOD_S, 0, effort=8.0)
    lag = periods - 1.0
    assert sample == pytest.approx(50.0 + (100.0 - 0.5 * 16.0 * lag) * lag * PERIOD_S)
    assert date.dating == pytest.approx((sample or 0.0) - 50.0)


def test_a_load_speeds_it_up_as_well() -> None:
    observer: Any = SimpleNamespace(
        position=10.0, velocity=100.0, disturbance=8.0, plant=SimpleNamespace(a22=1.0, b2=2.0)
    )
    date = SampleDate(observer, SimpleNamespace(fresh=True, position=50.0, age_s=1.4 * PERIOD_S), PERIOD_S)  # type: ignore[arg-type]
    date.begin_tick(0)
    assert date.sample(0.0) == dated(1.4 * PERIOD_S, 0, effort=8.0)[1]


def test_what_was_added_to_one_sample_is_not_told_of_the_next() -> None:
    date, _ = dated(1.4 * PERIOD_S, 0)
    date._drive.age_s = PERIOD_S
    assert date.sample(0.0) == 50.0
    assert (date.dating, date.lag_s) == (0.0, 0.0)
