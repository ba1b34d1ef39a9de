import gc
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.axis.state import State
from twostage_servo.telemetry.recorder import Recorder
from twostage_servo.telemetry.sample import COLUMNS, FIELDS, TYPES, Sample

numbers = st.floats(allow_nan=False)
PERIOD_S = 0.01
records = st.builds(
    Sample,
    time_s=st.just(0.0),
    tick=st.integers(0, 1 << 62),
    missed=st.integers(0, 1 << 62),
    lateness_us=numbers,
    state=st.sampled_from(State),
    measured_position=st.none() | st.floats(allow_nan=False, allow_infinity=False),
    **dict.fromkeys(FIELDS[5:-1], numbers),
).map(lambda sample: sample._replace(time_s=sample.tick * PERIOD_S))


def record(tick: int) -> Sample:
    values = (float(tick + field) for field in range(7))
    return Sample._make((tick, 0, 0.5, State.HOLDING, None, *values, tick * PERIOD_S))


def test_each_column_has_its_type_its_unit_and_its_meaning() -> None:
    assert tuple(COLUMNS) == tuple(TYPES) == FIELDS
    assert {column.unit for column in COLUMNS.values()} == {"", "µs", "s", "axis unit", "axis unit/s", "effort unit"}
    assert all(column.meaning for column in COLUMNS.values())
    assert FIELDS[0] == "tick"
    assert FIELDS[-1] == "time_s"  # names are added at the end: who reads by place goes on reading


@given(st.lists(records, max_size=6), st.integers(1, 4))
def test_what_is_recorded_is_read_to_the_last_bit(ticks: list[Sample], capacity: int) -> None:
    recorder = Recorder(capacity, PERIOD_S)
    for tick in ticks:
        recorder.add(tick)
    assert list(recorder.records()) == ticks[-capacity:]
    assert [type(tick.state) for tick in recorder.records()] == [State] * min(len(ticks), capacity)


def test_what_is_no_number_stays_none() -> None:
    recorder = Recorder(1, PERIOD_S)
    recorder.add(record(3)._replace(effort=math.nan, velocity=math.inf))
    (read,) = recorder.records()
    assert (math.isnan(read.effort), read.velocity, read.measured_position) == (True, math.inf, None)


@pytest.mark.parametrize("part", [slice(0, 2), slice(-3, None), slice(None, -1), slice(7, 9), slice(None, None, 2)])
def test_a_part_of_a_recording_is_that_of_a_list(part: slice) -> None:
    recorder = Recorder(5, PERIOD_S)
    for tick in range(8):
        recorder.add(record(tick))
    kept = [record(tick) for tick in range(3, 8)]
    assert list(recorder.records()[part]) == kept[part]
    assert [recorder.records()[index] for index in (0, -1)] == [kept[0], kept[-1]]


def test_what_is_kept_does_not_change_until_it_is_discarded() -> None:
    recorder = Recorder(2, PERIOD_S)
    recorder.add(record(1))
    now = recorder.records()
    recorder.keep()
    recorder.add(record(2))
    recorder.add(record(3))
    assert list(now) == list(recorder.records()) == [record(1)]
    recorder.discard()
    assert list(recorder.records()) == [record(2), record(3)]


def test_the_collector_of_cyclic_garbage_has_nothing_to_look_at_in_it() -> None:
    recorder = Recorder(1_000, PERIOD_S)
    gc.collect()
    before = len(gc.get_objects())
    for tick in range(1_000):
        recorder.add(record(tick))
    assert len(gc.get_objects()) - before < 100
    assert len(recorder.records()) == 1_000
