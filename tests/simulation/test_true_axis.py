"""Switches, stops and index marks, by the drive's frames."""

import math
from pathlib import Path

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.simulation.bench import Bench, motion
from twostage_servo.axis.messages import Feedback, IndexMark
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.simulation.faults import DriveFaults
from twostage_servo.simulation.settings import SimulationSettings
from twostage_servo.simulation.true_axis import TrueAxis

DBC = Path(__file__).parents[2] / "config" / "servo_drive.dbc"


def axis(**settings: float) -> TrueAxis:
    return TrueAxis(SimulationSettings.model_validate(settings), 0.0)


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        (-50.0, (False, True, False)),
        (-40.0, (False, True, False)),
        (-39.999, (False, False, False)),
        (9.999, (False, False, False)),
        (10.0, (False, False, True)),
        (12.0, (False, False, True)),
        (12.001, (False, False, False)),
        (40.0, (True, False, False)),
    ],
)
def test_the_switches_are_where_the_settings_put_them(
    profile: DriveProfile, position: float, expected: tuple[bool, bool, bool]
) -> None:
    bench = Bench(
        profile,
        initial_position=position,
        positive_limit_from=40.0,
        negative_limit_from=-40.0,
        home_switch_from=10.0,
        home_switch_to=12.0,
    )
    (feedback,) = bench.feedback(0.0)
    assert (feedback.positive_limit, feedback.negative_limit, feedback.home_switch) == expected


def test_an_axis_without_switches_has_none_active(profile: DriveProfile) -> None:
    for position in (-1e6, 0.0, 1e6):
        (feedback,) = Bench(profile, initial_position=position).feedback(0.0)
        assert (feedback.positive_limit, feedback.negative_limit, feedback.home_switch) == (False, False, False)


def test_a_driven_axis_stands_on_its_hard_stop(profile: DriveProfile) -> None:
    bench = Bench(profile, hard_stop_minimum=-1.0, hard_stop_maximum=0.5, command_timeout_ms=10_000.0)
    bench.enable(effort=5.0)
    bench.cycle(1.0)
    assert (bench.drive.position, bench.drive.velocity, bench.drive.effort) == (0.5, 0.0, 5.0)
    bench.command(1.0, -5.0)
    bench.cycle(1.01)
    assert bench.drive.position == pytest.approx(0.5 + motion((0.01, -5.0))[0])
    bench.cycle(3.0)
    assert (bench.drive.position, bench.drive.velocity) == (-1.0, 0.0)


# Index marks ----------------------------------------------------------------------------------------------------------


def test_an_index_mark_is_latched_exactly_each_time_it_is_passed(profile: DriveProfile) -> None:
    bench = Bench(profile, index_at=0.1234, command_timeout_ms=10_000.0, quantum=0.0001)
    bench.enable(effort=1.0)
    passed = [(n, index) for n in range(200) for index in bench.index(n / 1000)]
    (n, index) = passed[0]
    assert len(passed) == 1
    assert index == IndexMark(123 * 0.001, 1)  # 0.1234 on the wire's steps of 0.001
    assert motion((n / 1000 - 0.001, 1.0))[0] < 0.1234 <= motion((n / 1000, 1.0))[0]
    bench.command(0.2, -1.0)
    passed = [(n, index) for n in range(200, 2000) for index in bench.index(n / 1000)]
    assert [index.counter for _, index in passed] == [2]
    assert passed[0][1].position == pytest.approx(0.123)


def test_a_drive_that_nobody_moves_or_without_mark_sends_no_index(profile: DriveProfile) -> None:
    still = Bench(profile, index_at=0.0, initial_position=0.0)
    bare = Bench(profile, command_timeout_ms=10_000.0)
    bare.enable(effort=5.0)
    assert not any(bench.index(n / 100) for n in range(100) for bench in (still, bare))


def test_a_mark_that_was_passed_forth_and_back_between_two_cycles_is_seen(profile: DriveProfile) -> None:
    """At 0.1 s the axis turns round at 0.745, beyond the mark, and is back before it when the next cycle comes."""
    bench = Bench(profile, index_at=0.7, command_timeout_ms=10_000.0)
    bench.enable(effort=1.0)
    assert bench.index(0.09) == []
    bench.command(0.1, -1.0)
    assert bench.drive.position < 0.7
    bench.cycle(0.2)
    assert bench.drive.position < 0.7
    assert bench.index(0.2) == []
    fresh = Bench(profile, index_at=0.7, command_timeout_ms=10_000.0)
    fresh.enable(effort=1.0)
    fresh.command(0.1, -1.0)
    assert [index.position for index in fresh.index(0.2)] == pytest.approx([0.7])


@given(
    phases=st.lists(st.tuples(st.floats(1e-4, 0.3), st.floats(-5, 5)), min_size=1, max_size=12),
    pitch=st.sampled_from([0.0, 0.5, 3.0]),
    friction=st.sampled_from([0.0, 0.5]),
)
def test_marks_are_found_as_a_fine_grid_finds_them(
    phases: list[tuple[float, float]], pitch: float, friction: float
) -> None:
    """Oracle: the marks between the positions of many small steps."""
    whole, fine = (
        axis(index_at=0.2, index_pitch=pitch, coulomb_friction=friction, gain=180.0, pole=14.0) for _ in range(2)
    )
    now_s = 0.0
    for duration_s, effort in phases:
        last: float | None = None
        for step in range(1, 201):
            before = fine.position
            fine.advance(now_s + duration_s * step / 200, effort)
            lowest, highest = sorted((before, fine.position))
            numbers = [0] if not pitch else range(math.floor(lowest / pitch) - 1, math.ceil(highest / pitch) + 1)
            marks = [0.2 + number * pitch for number in numbers]
            assume(all(abs(mark - end) > 1e-9 for mark in marks for end in (lowest, highest)))
            between = [mark for mark in marks if lowest < mark < highest]
            seen = fine.pop_passed_mark()
            if between:  # when it turns round within a step, the grid misses a mark that the axis does not
                assert seen == pytest.approx(max(between) if fine.position > before else min(between))
            last = seen or last
        now_s += duration_s
        whole.advance(now_s, effort)
        assert whole.pop_passed_mark() == last


@given(st.lists(st.sampled_from([-2.5, -0.75, -0.25, 0.25, 0.5, 1.0, 3.0]), max_size=20), st.sampled_from([0.0, 0.25]))
def test_a_mark_counts_once_whether_it_is_passed_or_stopped_at(steps: list[float], pitch: float) -> None:
    """Quarters are exact in floats: the axis often stops on a mark, and must not report it again as it leaves."""
    marks = axis(index_at=0.5, index_pitch=pitch)
    position = 0.0
    for step in steps:
        marks._look_for_mark(0.5, position, position + step)
        position += step
        if pitch:  # a mark at every quarter: the one that it stops at is the last
            assert marks.pop_passed_mark() == position
        else:
            begin = position - step
            expected = begin < 0.5 <= position or position <= 0.5 < begin
            assert marks.pop_passed_mark() == (0.5 if expected else None)


# Wrap ----------------------------------------------------------------------------------------------------------------


def narrow_profile(folder: Path) -> DriveProfile:
    """The shipped protocol with positions of 16 bits, -32768 reserved."""
    text = DBC.read_text(encoding="cp1252")
    text = text.replace("0|32@1- (0.001,0) [-2147483.647|2147483.647]", "0|16@1- (0.001,0) [-32.767|32.767]")
    (folder / "narrow.dbc").write_text(text, encoding="cp1252")
    return DriveProfile.compile(ProtocolSettings(dbc="narrow.dbc"), folder, "mm")


@pytest.mark.parametrize("bits", [16, 32])
@pytest.mark.parametrize("effort", [9.0, -9.0])
def test_the_measured_position_wraps_and_the_differences_do_not(
    profile: DriveProfile, tmp_path: Path, bits: int, effort: float
) -> None:
    if bits == 16:
        profile = narrow_profile(tmp_path)
    period = 2**bits * 0.001
    assert profile.traits.position_period == pytest.approx(period)
    start = math.copysign(period / 2 - 1.0, effort)
    bench = Bench(profile, initial_position=start, feedback="cyclic", command_timeout_ms=10_000.0)
    bench.enable(effort=effort)
    unwrapped = previous = start
    wrapped = 0
    for n in range(50):
        for frame in bench.cycle(n / 100):
            if isinstance(frame, Feedback):
                wrapped += abs(frame.position - previous) > period / 2
                unwrapped += math.remainder(frame.position - previous, period)
                previous = frame.position
                assert abs(frame.position) < period / 2
                assert unwrapped == pytest.approx(bench.drive.position, abs=0.0016)
    assert wrapped == 1
    assert abs(bench.drive.position) > period / 2


# Settings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"hard_stop_minimum": 1.0, "hard_stop_maximum": 1.0}, "hard_stop_minimum = 1 is not below"),
        ({"hard_stop_minimum": 1.0}, "initial_position = 0 is beyond the hard stop at 1"),
        ({"hard_stop_maximum": -1.0}, "initial_position = 0 is beyond the hard stop at -1"),
        ({"negative_limit_from": 5.0, "positive_limit_from": -5.0}, "negative_limit_from = 5 is not below"),
        ({"home_switch_from": 5.0, "home_switch_to": 4.0}, "home_switch_from = 5 is not below"),
        ({"home_switch_from": 5.0}, "give both or neither"),
        ({"home_switch_to": 5.0}, "give both or neither"),
        ({"index_pitch": 5.0}, "without index_at"),
        ({"index_at": 0.0, "index_pitch": -5.0}, "greater than or equal to 0"),
        ({"index_at": math.inf}, "index_at"),
    ],
)
def test_places_that_cannot_be_meant_are_refused(settings: dict[str, float], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        SimulationSettings.model_validate(settings)


def test_faults_of_the_plant_that_cannot_be_change_nothing() -> None:
    moved = axis()
    with pytest.raises(ValueError, match="gain must not be 0"):
        moved.change(DriveFaults(gain_factor=0.0, stalled=True))
    moved.advance(1.0, 1.0)
    assert moved.position == pytest.approx(motion((1.0, 1.0))[0])
