"""The histogram of times."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.timing.histogram import TimeHistogram


@given(values=st.lists(st.floats(1.1e-7, 5.0), min_size=1, max_size=300), percent=st.sampled_from([50.0, 90.0, 99.0]))
def test_percentiles_are_those_of_numpy_within_a_bin(values: list[float], percent: float) -> None:
    histogram = TimeHistogram()
    for value in values:
        histogram.add(value)
    exact = float(np.percentile(values, percent, method="inverted_cdf"))
    assert exact * 1e6 / 1.06 <= histogram.percentiles_us(percent)[0] <= exact * 1e6 * 1.07
    assert histogram.largest_us == pytest.approx(1e6 * max(values))


def test_what_is_told_of_times_has_a_tenth_of_a_microsecond() -> None:
    histogram = TimeHistogram()
    for number in range(1, 200):
        histogram.add(1.2345e-6 * number)
    p50, p90, p99 = histogram.percentiles_us(50.0, 90.0, 99.0)
    assert histogram.summary() == {
        "p50": round(p50, 1),
        "p90": round(p90, 1),
        "p99": round(p99, 1),
        "max": round(histogram.largest_us, 1),
    }
    assert all(value != round(value, 1) for value in (p50, p90, p99, histogram.largest_us))


def test_a_punctual_run_and_an_empty_one_are_zero() -> None:
    histogram = TimeHistogram()
    assert histogram.summary() == {"p50": 0.0, "p90": 0.0, "p99": 0.0, "max": 0.0}
    for _ in range(100):
        histogram.add(0.0)
    assert histogram.summary() == {"p50": 0.0, "p90": 0.0, "p99": 0.0, "max": 0.0}


def test_a_lateness_beyond_the_last_bin_is_not_lost() -> None:
    histogram = TimeHistogram()
    histogram.add(1000.0)
    assert histogram.percentiles_us(50.0)[0] == pytest.approx(1e7)  # the last bin's edge
    assert histogram.largest_us == 1e9


@given(values=st.lists(st.floats(0.0, 100.0), max_size=300))
def test_the_histogram_to_be_drawn_has_each_value_in_the_bin_below_its_edge(values: list[float]) -> None:
    histogram = TimeHistogram()
    for value in values:
        histogram.add(value)
    shown = histogram.histogram()
    edges = [edge_us for edge_us, _ in shown]
    assert edges == sorted(set(edges))
    assert len(edges) <= 81
    assert sum(count for _, count in shown) == len(values)
    for edge_us, _ in shown:
        up_to = sum(count for other_us, count in shown if other_us <= edge_us)
        if edge_us < 1e7:  # the last bin holds what is beyond it as well
            assert sum(1e6 * value < 0.99 * edge_us for value in values) <= up_to
            assert up_to <= sum(1e6 * value < 1.01 * edge_us for value in values)


def test_the_edges_of_the_histogram_are_ten_a_decade() -> None:
    histogram = TimeHistogram()
    for time_us in (0.0, 0.11, 0.9, 9.9, 10.1, 12.5, 130.0):
        histogram.add(1e-6 * time_us)
    assert histogram.histogram() == [(0.1, 1), (0.126, 1), (1.0, 1), (10.0, 1), (12.6, 2), (158.0, 1)]
