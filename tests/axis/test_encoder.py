"""What the encoder says and when: wraps, dates, bits that flip, and an encoder or an axis that stands still."""

import itertools
import math
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import AxisDesign, design_axis
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.feedback import FeedbackMonitor
from twostage_servo.axis.messages import DriveTraits, Feedback
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.plant import Plant

DESIGN = design_axis(axis_settings(), PERIOD_S)
COUNTER = 65.536
"""Range of a 16-bit counter of micrometres, in mm; 32 bits are the same 65536 times over."""


def rig_of(design: AxisDesign = DESIGN, period: float = 0.0, **keywords: float) -> AxisRig:
    axis = Axis(design, replace(TRAITS, position_period=period))
    return AxisRig(axis, **keywords)  # type: ignore[arg-type]


def counting(period: float) -> Callable[[float], float]:
    """Return an encoder that wraps at half its range, as two's complement does."""
    return lambda position: (position + period / 2.0) % period - period / 2.0


def with_top_bit_flipped(period: float) -> Callable[[float], float]:
    def see(position: float) -> float:
        counted = counting(period)(position)
        return counted - period / 2.0 if counted >= 0.0 else counted + period / 2.0

    return see


def trip_of(rig: AxisRig) -> TripCode | None:
    return rig.axis.trip.code if rig.axis.trip is not None else None


# Wrap ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("period", [COUNTER, COUNTER * 65_536.0], ids=["16 bits", "32 bits"])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_counter_that_ends_anywhere_changes_nothing(period: float, direction: float) -> None:
    """Pushed through the end while disarmed, armed beyond it, moved back and forth through it."""

    def run(sees: Callable[[float], float], range_of_counter: float) -> AxisRig:
        rig = rig_of(period=range_of_counter)
        rig.sees = sees
        rig.position = rig.sample = direction * (period / 2.0 - 0.25)
        rig.seconds(0.1)
        rig.axis.set_position(0.0)
        for _ in range(200):  # by hand, 0.2 mm a tick, and back to just beyond the end
            rig.position += direction * 0.2
            rig.tick()
        for _ in range(197):
            rig.position -= direction * 0.2
            rig.tick()
        rig.armed(0.4)  # it is still moved by hand, and has to stop
        for target in (direction * 80.0, direction * -80.0, 0.0):
            rig.axis.move_to(target, 100.0)
            rig.seconds(4.0)
        return rig

    plain, wrapping = run(lambda position: position, 0.0), run(counting(period), period)
    assert wrapping.states == plain.states
    rounding = 1e-4 if period > 1e6 else 1e-7  # 2147 m in a double, and f11 times that
    assert wrapping.position == pytest.approx(plain.position, abs=rounding)
    efforts = [[command.effort for command in rig.commands] for rig in (wrapping, plain)]
    assert efforts[0] == pytest.approx(efforts[1], abs=rounding)
    assert wrapping.axis.drive.position == pytest.approx(0.0, abs=0.05)


def test_one_flipped_top_bit_is_a_spike_like_any_other() -> None:
    """It lies half a range away: by the way back the counter must not have gained a whole range."""
    rig = rig_of(period=COUNTER)
    rig.sees = counting(COUNTER)
    rig.cruising()
    rig.sees = with_top_bit_flipped(COUNTER)
    rig.tick()
    rig.sees = counting(COUNTER)
    rig.seconds(6.0)
    assert rig.axis.trip is None


def test_one_flipped_top_bit_while_disarmed_does_not_move_the_origin() -> None:
    rig = rig_of(period=COUNTER)
    rig.sees = counting(COUNTER)
    rig.seconds(0.1)
    rig.velocity = 30.0  # coasting
    rig.seconds(0.05)
    rig.sees = with_top_bit_flipped(COUNTER)
    rig.tick()
    rig.sees = counting(COUNTER)
    rig.seconds(0.5)
    assert rig.axis.drive.position == pytest.approx(rig.position, abs=0.01) or not rig.axis.referenced


# Dates ---------------------------------------------------------------------------------------------------------------


class CyclicDrive(AxisRig):
    """A drive that samples by a clock of its own: each sample is exact for its age, and says it."""

    ages: "itertools.cycle[float]"

    def move(self, effort: float) -> None:
        age = next(self.ages)
        part, total = self.plant.discretise(PERIOD_S - age), effort - self.load
        self.sample = self.position + part.a12 * self.velocity + part.b1 * total
        self.inputs["age_s"] = age
        super().move(effort)


def cyclic(ages: list[float]) -> CyclicDrive:
    rig = CyclicDrive(Axis(DESIGN, TRAITS))
    rig.ages = itertools.cycle(ages)
    return rig


@pytest.mark.long
@settings(max_examples=25, deadline=None)
@given(ages=st.lists(st.floats(0.0005, 0.0095), min_size=1, max_size=40), velocity=st.floats(20.0, 250.0))
def test_a_whole_move_with_samples_of_any_age_trips_nothing(ages: list[float], velocity: float) -> None:
    rig = cyclic(ages).armed()
    move = rig.axis.move_to(300.0, velocity)
    worst = 0.0
    for _ in range(round((300.0 / velocity + 6.0) / PERIOD_S)):
        before = rig.position
        rig.tick()
        worst = max(worst, abs(rig.axis.law.observer.position - before))
    assert (rig.axis.trip, move.outcome) == (None, "reached")
    assert rig.position == pytest.approx(300.0, abs=0.05)
    # At constant speed the date says all; what the speed changes by in a period moves a sample by 0.1 mm at most.
    assert worst < 0.5


@pytest.mark.parametrize("age_ms", [0.5, 2.0, 4.0, 6.0, 9.0])
def test_knocked_while_disarmed_the_speed_is_soon_known_again(age_ms: float) -> None:
    """Moved by 50 mm within a tick: the speeds estimated must die down, whatever the age of the samples."""
    rig = cyclic([1e-3 * age_ms]).seconds(0.1)
    rig.position += 50.0
    rig.seconds(0.5)
    assert abs(rig.axis.law.observer.velocity) < 1.0
    assert rig.axis.law.observer.position == pytest.approx(50.0, abs=0.1)


# Bad frames ----------------------------------------------------------------------------------------------------------


def test_a_lost_frame_is_an_error_and_so_many_trip_to_the_frame() -> None:
    rig = rig_of().cruising(2000.0)
    lost = 0
    for index in range(200):
        rig.silent = index % 2 == 0
        if rig.silent:  # sent, and gone
            rig.counter = (rig.counter + 1) % 16
            lost += 1
        rig.tick()
        if rig.axis.trip is not None:
            break
    assert (trip_of(rig), lost) == (TripCode.FEEDBACK_ERRORS, 25)


@pytest.mark.parametrize(("every", "trips"), [(2, True), (4, True), (5, False)])
def test_an_encoder_that_spikes_again_and_again_trips_by_its_errors(every: int, *, trips: bool) -> None:
    """Never two in a row, so each is bridged; 25 in 100 ticks are too many, 20 are not."""
    rig = rig_of().cruising(2000.0)
    number = itertools.count(1)
    rig.sees = lambda position: position + (30.0 if next(number) % every == 0 else 0.0)
    rig.seconds(3.0)
    assert trip_of(rig) is (TripCode.FEEDBACK_ERRORS if trips else None)
    if not trips:
        assert rig.velocity == pytest.approx(100.0, abs=1.0)


def test_one_frame_in_five_lost_is_bridged_for_good() -> None:
    rig = rig_of().cruising(400.0)
    for index in range(1000):
        rig.silent = index % 5 == 0
        rig.counter = (rig.counter + rig.silent) % 16
        rig.tick()
    assert rig.axis.trip is None
    assert rig.position == pytest.approx(400.0, abs=0.05)


def test_a_rejected_frame_is_one_error() -> None:
    monitor = FeedbackMonitor(16)
    for counter in range(10):
        monitor.begin_tick(0)
        if counter == 5:
            monitor.reject()
        else:
            monitor.accept(counter)
    assert monitor.recent_errors == 1


def test_a_fault_is_heard_from_a_drive_that_has_lost_its_encoder() -> None:
    report = DriveReport(axis_settings(), PERIOD_S, DriveTraits(counter_modulus=16))
    report.begin_tick(0)
    report.accept_feedback(Feedback(0.0, 1, enabled=True))
    report.begin_tick(0)
    report.accept_feedback(Feedback(math.nan, 2, enabled=True, fault_code=7, safe_torque_off=True))
    assert TripCode.DRIVE_FAULT in {code for code, _ in report.troubles(arming=False)}


# Standing still ------------------------------------------------------------------------------------------------------


CRAWLS = pytest.mark.xfail(strict=True, reason="the slower the move, the longer the effort takes to show a stall")


@pytest.mark.parametrize(
    "velocity", [pytest.param(1.0, marks=CRAWLS), pytest.param(5.0, marks=CRAWLS), 20.0, 50.0, 100.0, 250.0]
)
def test_an_encoder_that_freezes_in_mid_move_is_noticed_within_20_mm(velocity: float) -> None:
    """Slowly, the effort shows it; quickly, the second sample that has not moved on."""
    rig = rig_of().cruising(2000.0, velocity)
    frozen, at = rig.sample, rig.position
    rig.sees = lambda _: frozen
    rig.seconds(8.0)
    assert trip_of(rig) in {TripCode.STALL, TripCode.POSITION_JUMP}
    assert rig.state() is State.TRIPPED
    assert abs(rig.position - at) < 20.0


@pytest.mark.parametrize("velocity", [2.0, 5.0, 10.0, 20.0, 40.0, 100.0])
@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_an_encoder_that_turns_round_in_a_cruise_is_noticed_within_5_mm(velocity: float, noise: float) -> None:
    """Ten times the innovation gate; a quick stop by an estimate that counts the wrong way would run on."""
    random = Random(1)  # noqa: S311 - noise
    rig = rig_of()
    rig.sees = lambda position: position + random.gauss(0.0, noise)
    rig.cruising(2000.0, velocity)
    place = rig.position
    rig.sees = lambda position: 2.0 * place - position + random.gauss(0.0, noise)
    rig.sample = rig.sees(rig.position)
    while rig.axis.trip is None:
        rig.tick()
    assert abs(rig.position - place) < 5.0
    assert trip_of(rig) is (TripCode.SIGN_REVERSED if velocity < 40.0 else TripCode.POSITION_JUMP)
    rig.seconds(1.0)
    assert abs(rig.position - place) < 7.0


@pytest.mark.parametrize("asked", ["once", "in each tick", "by jogging"])
def test_an_axis_held_fast_is_stalled_though_its_encoder_trembles(asked: str) -> None:
    """By 4 of its steps, as on an elastic coupling: hardly any motion, much effort; the force has to stay small, also
    where a client sends another set-point, or another speed, in each tick.
    """
    rig = rig_of().armed()
    rig.plant = Plant(1e-9, 1e3)
    tremble = itertools.cycle([0.004, -0.004, 0.004, 0.0])
    rig.sees = lambda position: position + next(tremble)
    for tick in range(100):
        if rig.axis.trip is None and asked == "by jogging":
            rig.axis.jog(100.0 - 0.01 * tick)
        elif rig.axis.trip is None and (asked == "in each tick" or tick == 0):
            rig.axis.move_to(400.0 + 0.01 * tick, 100.0)
        rig.tick()
    assert trip_of(rig) is TripCode.STALL
    assert max(abs(command.effort) for command in rig.commands) < 12.0


@pytest.mark.parametrize("velocity", [50.0, 100.0, 250.0])
def test_the_quick_example_sets_out_after_a_rest(velocity: float) -> None:
    """Example 2's first effort is 6 V in a tick; the encoder can't show it before the next sample."""
    page = Path(__file__).parents[2] / "config" / "example2.toml"
    quick = AxisSettings.model_validate(tomllib.loads(page.read_text(encoding="utf-8"))["axis"])
    rig = rig_of(design_axis(quick, PERIOD_S), plant=Plant(quick.plant.gain, quick.plant.pole)).armed()  # type: ignore[arg-type]
    rig.seconds(1.0)
    rig.axis.move_to(400.0, velocity)
    rig.seconds(1.0)
    assert rig.axis.trip is None


@pytest.mark.parametrize("step", [0.05, 0.1])
def test_a_coarse_encoder_sets_out_after_a_rest(step: float) -> None:
    rig = AxisRig(Axis(DESIGN, DriveTraits(counter_modulus=16, position_quantum=step)))
    rig.sees = lambda position: round(position / step) * step
    rig.armed().seconds(1.0)
    rig.axis.move_to(400.0, 100.0)
    rig.seconds(1.0)
    assert rig.axis.trip is None


# Switches ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("velocity", [0.5, 2.0])
def test_a_limit_switch_stops_slow_motion_as_well(velocity: float) -> None:
    rig = rig_of().armed()
    rig.axis.move_to(100.0, velocity)
    rig.seconds(2.0)
    at = rig.position
    rig.inputs["positive_limit"] = True
    rig.seconds(10.0)
    assert rig.position - at < 1.0


def test_another_master_disables_and_keeps_the_axis_from_being_armed_for_a_while() -> None:
    rig = rig_of().cruising()
    rig.axis.record_foreign_command("0x201")
    assert (rig.state(), trip_of(rig)) == (State.TRIPPED, TripCode.FOREIGN_COMMAND)
    with pytest.raises(Refused, match="another node on the bus commands this drive: 0x201"):
        rig.axis.reset()  # it has not been seen to be off yet
    rig.seconds(0.05)
    rig.axis.reset()
    rig.seconds(0.35)
    obstacle = rig.axis.obstacle_to_arming()
    assert obstacle is not None
    assert obstacle[0] == "foreign_command"
    rig.seconds(0.2)
    assert rig.axis.obstacle_to_arming() is None
