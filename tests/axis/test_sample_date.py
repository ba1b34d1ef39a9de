"""When a sample was taken that comes after missed ticks, by hand: the axis went 1 mm in each of them."""

from types import SimpleNamespace
from typing import Any

import pytest

from twostage_servo.axis.sample_date import SampleDate

PERIOD_S = 0.01


def dated(age_s: float | None, missed: int) -> tuple[SampleDate, float | None]:
    """Return how a sample at 50 mm is dated after so many missed ticks, in each of which the estimate moved by 1 mm."""
    observer: Any = SimpleNamespace(position=10.0, velocity=100.0)
    drive: Any = SimpleNamespace(fresh=True, position=50.0, age_s=age_s)
    date = SampleDate(observer, drive, PERIOD_S)
    date.begin_tick(missed)
    date.begin_gap()
    for _ in range(missed):
        observer.position += 1.0
        date.record_missed()
    return date, date.sample()


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
