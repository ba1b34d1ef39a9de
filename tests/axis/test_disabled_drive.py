"""The watch on a drive that is told to disable, against a plain account of what the drive has said and where it was."""

import contextlib
import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.disabled_drive import DisabledDriveWatch, MotionWhileDisabled
from twostage_servo.axis.messages import Feedback, Reception
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.plant import MODEL_ERROR

DESIGN = design_axis(axis_settings(), PERIOD_S)
PATIENCE = 52
"""500 ms of arming time-out, and two ticks."""
SILENCE = 3
"""30 ms without feedback."""
LONGEST_GAP = 10
"""100 ms between two reports."""
POLE = 14.0
GATE = 0.5

reports = st.sampled_from([True, True, True, False, None])
runs = st.lists(st.tuples(reports, st.integers(1, 80), st.integers(0, 3)), max_size=20)


@given(runs)
def test_the_time_that_it_reports_to_be_enabled_adds_up(told: list[tuple[bool | None, int, int]]) -> None:
    watch = DisabledDriveWatch(DESIGN)
    watch.update(0, None, None, 0.0)
    last: bool | None = None
    enabled = disabled = silent = since = 0
    for report, ticks, missed in told:
        for _ in range(ticks):
            watch.update(missed, report, None, 0.0)
            silent = silent + 1 + missed if report is None else 0
            since += 1
            if report is not None:
                counted, since, last = min(since, LONGEST_GAP), 0, report
                enabled += counted * report
                disabled = 0 if report else disabled + counted
            if disabled >= PATIENCE:
                enabled = 0
            assert watch.not_disabled == (last is True and enabled > PATIENCE)
            assert watch.waits == (last is True and silent < SILENCE and enabled <= PATIENCE)
            assert watch.seen_enabled == (last is True)
            assert watch.enabled_ms == pytest.approx(10.0 * enabled)


@given(st.integers(0, PATIENCE), st.integers(0, 5))
def test_a_drive_that_obeys_within_its_time_is_never_told(after: int, missed: int) -> None:
    watch = DisabledDriveWatch(DESIGN)
    watch.release(True)
    watch.update(missed, True, 0.0, 0.0)
    for tick in range(300):
        watch.update(missed, tick < after, 0.0, 0.0)
        assert not watch.not_disabled
    assert not watch.waits


@given(runs)
def test_a_drive_that_is_told_to_enable_is_not_watched(told: list[tuple[bool | None, int, int]]) -> None:
    watch = DisabledDriveWatch(DESIGN)
    for _ in range(100):
        watch.update(0, True, 0.0, 0.0)
    assert watch.not_disabled
    for report, _, _ in told:
        watch.release(report)
        assert not watch.not_disabled
    watch.release(True)
    watch.update(0, True, 0.0, 0.0)
    assert (watch.not_disabled, watch.enabled_ms, watch.moved, watch.told_ms) == (False, 0.0, None, 0.0)
    watch.update(2, True, 0.0, 0.0)
    assert watch.told_ms == pytest.approx(30.0)
    watch.release(None)
    assert watch.told_ms == 0.0


def coasting(speed: float, pole: float, ticks: int, noise: list[float]) -> list[float]:
    """Samples that are one tick old, of an axis that the drive lets go of a tick after it was told to."""
    places = [speed * PERIOD_S * n for n in range(2)]
    let_go = places[-1]
    after = [let_go + speed / pole * -math.expm1(-pole * PERIOD_S * n) for n in range(1, ticks)]
    return [place + noise[n % len(noise)] for n, place in enumerate([*places, *after])]


@given(
    speed=st.floats(-320.0, 320.0),
    error=st.floats(1.0 - MODEL_ERROR, 1.0 + MODEL_ERROR),
    estimate=st.floats(0.0, 1.0),
    noise=st.lists(st.floats(-0.1, 0.1), min_size=1, max_size=40),
    lost=st.sets(st.integers(0, 60)),
)
@settings(max_examples=300)
@example(speed=30.0, error=0.71875, estimate=0.625, noise=[0.0625, 0.0625, 0.0], lost={0, 1, 2, 3, 4, 5})
@example(speed=11.0, error=0.703125, estimate=0.0, noise=[0.0], lost={0, 1, 2, 3, 4, 5})
@example(speed=88.0, error=0.701171875, estimate=0.0, noise=[0.0], lost={1, 2, 3, 4, 5, 6})
def test_coasting_is_no_motion_whatever_the_estimate_was(
    speed: float, error: float, estimate: float, noise: list[float], lost: set[int]
) -> None:
    watch = DisabledDriveWatch(DESIGN, 0.001)
    for tick, place in enumerate(coasting(speed, error * POLE, 400, noise)):
        watch.update(0, False, None if tick in lost else place, estimate * speed)
        assert watch.moved is None, (tick, place)


@given(
    coast=st.floats(-300.0, 300.0),
    wait=st.integers(150, 400),
    speed=st.floats(0.5, 300.0),
    sign=st.sampled_from([-1.0, 1.0]),
)
def test_motion_after_it_has_come_to_rest_is_told_with_its_distance(
    coast: float, wait: int, speed: float, sign: float
) -> None:
    watch = DisabledDriveWatch(DESIGN, 0.001)
    places = coasting(coast, POLE, wait, [0.0])
    for place in places:
        watch.update(0, False, place, coast)
    rest, gone = places[-1], 0.0
    while gone <= 1.5 * GATE + 0.002:  # its place may have been taken anew half a gate before it was at rest
        assert watch.moved is None or gone > 0.5 * GATE
        gone += speed * PERIOD_S
        watch.update(0, False, rest + sign * gone, 0.0)
    gone += speed * PERIOD_S
    watch.update(0, False, rest + sign * gone, 0.0)  # one sample is a spike
    assert watch.moved == pytest.approx(sign * gone, abs=0.5 * GATE)
    watch.motion.shift(1000.0)
    watch.update(0, False, 1000.0 + rest + sign * gone, 0.0)
    assert watch.moved == pytest.approx(sign * gone, abs=0.5 * GATE)


def test_a_drive_that_goes_on_at_its_speed_is_told_once_coasting_does_not_explain_it() -> None:
    watch = DisabledDriveWatch(DESIGN)
    for tick in range(100):
        watch.update(0, True, 1.0 * tick, 100.0)
    assert watch.moved == pytest.approx(99.0)


def test_a_spike_is_no_motion() -> None:
    watch = DisabledDriveWatch(DESIGN)
    for tick in range(300):
        watch.update(0, False, 100.0 if tick == 200 else 0.0, 0.0)
    assert watch.moved is None


def test_another_watch_on_the_same_drive_goes_on_where_the_former_was() -> None:
    watch = DisabledDriveWatch(DESIGN)
    for tick in range(45):
        watch.update(0, True, 0.02 * tick, 0.0)
    other = DisabledDriveWatch(design_axis(axis_settings(), PERIOD_S))
    other.continue_from(watch)
    for tick in range(45, 54):
        assert not other.not_disabled
        other.update(0, True, 0.02 * tick, 0.0)
    assert other.not_disabled
    assert other.moved == pytest.approx(0.02 * (53 - 3))  # so slow an axis has no way to coast


def test_a_drive_that_says_nothing_more_is_waited_for_as_long_as_feedback_may_be_old() -> None:
    watch = DisabledDriveWatch(DESIGN)
    watch.update(0, True, None, 0.0)
    waits = []
    for _ in range(SILENCE):
        watch.update(0, None, None, 0.0)
        waits.append(watch.waits)
    assert waits == [True] * (SILENCE - 1) + [False]


@pytest.mark.parametrize(("report", "waits"), [(None, True), (False, False), (True, True)])
def test_what_a_drive_said_last_while_enabled_counts_until_it_says_something_else(
    report: bool | None, *, waits: bool
) -> None:
    watch = DisabledDriveWatch(DESIGN)
    watch.release(True)
    watch.update(0, report, None, 0.0)
    assert (watch.waits, watch.seen_enabled) == (waits, waits)


# In the axis ----------------------------------------------------------------------------------------------------------


def test_the_axis_takes_over_what_was_known_of_its_drive() -> None:
    rig = AxisRig()
    rig.seconds(0.05)
    rig.enabled = True
    for _ in range(40):
        rig.tick()
        rig.enabled = True
    fresh = Axis(DESIGN, TRAITS)
    fresh.continue_from(rig.axis)
    rig.axis = fresh
    for _ in range(20):
        rig.enabled = True
        rig.tick()
    assert rig.state() is State.TRIPPED
    assert list(rig.axis.trips) == [TripCode.DRIVE_NOT_DISABLED]


def ask(axis: Axis, what: str) -> None:
    match what:
        case "foreign":
            axis.record_foreign_command("0x201")
        case "stall":
            axis.raise_trip(TripCode.STALL, "test")
        case "move":
            axis.move_to(300.0, 100.0)
        case "arm" | "disarm" | "reset" | "stop":
            getattr(axis, what)()


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["arm", "disarm", "reset", "foreign", "stall", "move", "stop", "wait"]), st.integers(1, 90)
        ),
        max_size=12,
    )
)
@settings(max_examples=60, deadline=None)
def test_in_any_order_a_drive_that_stays_enabled_ends_in_the_trip_and_cannot_be_reset(
    asked: list[tuple[str, int]],
) -> None:
    rig = AxisRig()
    rig.seconds(0.05)
    sticks = False
    for what, ticks in asked:
        with contextlib.suppress(Refused):
            ask(rig.axis, what)
        for _ in range(ticks):
            rig.tick()
            sticks = sticks or rig.enabled
            rig.enabled = sticks  # once enabled, always
    rig.axis.disarm()
    for _ in range(150):
        rig.enabled = True
        rig.tick()
    assert TripCode.DRIVE_NOT_DISABLED in rig.axis.trips
    assert rig.state() is State.TRIPPED
    assert rig.axis.present_trip is not None
    assert rig.axis.present_trip.code is TripCode.DRIVE_NOT_DISABLED
    with pytest.raises(Refused, match="told to disable"):
        rig.axis.reset()
    for _ in range(2):
        rig.enabled = False
        rig.tick()
    rig.axis.reset()
    assert (rig.state(), rig.axis.trip) == (State.DISARMED, None)


def test_a_report_that_has_waited_says_nothing_of_now() -> None:
    """Neither that the drive is still enabled, nor that it is off: the time that it has goes by the reports of now."""
    rig = AxisRig()
    rig.seconds(0.05)
    drive = rig.axis.drive
    for late in (True, False):
        rig.axis.begin_tick(rig.tick_index + 1, 0)
        rig.counter += 1
        rig.axis.accept_feedback(Feedback(0.0, rig.counter % 16, enabled=True), Reception(late=late))
        assert drive.enabled_report is (None if late else True)


def test_a_bus_that_is_held_up_is_no_drive_that_does_not_obey() -> None:
    """Also where feedback may be as old as the time that the drive has: what comes at last may be from before."""
    patient = design_axis(axis_settings(stale_feedback_ms=3000.0), PERIOD_S)
    watch = DisabledDriveWatch(patient)
    watch.release(True)
    watch.update(0, True, 0.0, 0.0)
    for _ in range(250):
        watch.update(0, None, None, 0.0)
        assert not watch.not_disabled
    for _ in range(40):
        watch.update(0, True, 0.0, 0.0)
        assert not watch.not_disabled
    watch.update(0, False, 0.0, 0.0)
    assert not watch.waits


@pytest.mark.parametrize("every", [1, 3, 10])
def test_a_drive_that_reports_less_often_has_no_more_time(every: int) -> None:
    watch = DisabledDriveWatch(design_axis(axis_settings(stale_feedback_ms=200.0), PERIOD_S))
    ticks = 0
    while not watch.not_disabled:
        watch.update(0, True if ticks % every == 0 else None, 0.0, 0.0)
        ticks += 1
    assert PATIENCE < ticks - 1 <= PATIENCE + every


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("ticks", [1, 2, 4])
def test_the_speed_of_a_coasting_axis_is_that_at_the_first_of_two_samples(sign: float, ticks: int) -> None:
    """It slows down in between: the second lies (1 - e^(-pole t))/pole of the speed farther."""
    motion = MotionWhileDisabled(DESIGN, 0.0)
    motion.begin(sign * 1.0)
    assert motion.known.speed == 1.0
    motion.update(0, 5.0)
    assert (motion.known.samples, motion.known.ticks_since_last) == (1, 0)
    for _ in range(ticks - 1):
        motion.update(0, None)
    assert (motion.known.ticks, motion.known.ticks_since_last) == (ticks, ticks - 1)
    pole, elapsed_s = DESIGN.least_pole, ticks * PERIOD_S
    motion.update(0, 5.0 + sign * 30.0 * (1.0 - math.exp(-pole * elapsed_s)) / pole)
    assert motion.known.speed == pytest.approx(30.0)
    assert motion.known.ticks == 0


def test_missed_ticks_lie_between_two_samples_as_well() -> None:
    motion = MotionWhileDisabled(DESIGN, 0.0)
    motion.begin(0.0)
    motion.update(0, 5.0)
    motion.update(3, 6.0)
    pole = DESIGN.least_pole
    assert motion.known.speed == pytest.approx(pole / (1.0 - math.exp(-pole * 4 * PERIOD_S)))


@pytest.mark.parametrize(("told", "reported", "ticks", "silent"), [
    (True, True, SILENCE, True), (True, True, SILENCE - 1, False), (True, False, SILENCE, False),
    (False, True, SILENCE, False),
])  # fmt: skip
def test_a_drive_is_silent_while_enabled_if_that_was_the_last_it_said_before_it_was_told_to_disable(
    told: bool, reported: bool, ticks: int, silent: bool
) -> None:
    watch = DisabledDriveWatch(DESIGN)
    if told:
        watch.update(0, reported, None, 0.0)
        for _ in range(ticks):
            watch.update(0, None, None, 0.0)
    else:
        watch.release(reported)
        watch.known.ticks_silent = ticks
    assert watch.silent_while_enabled is silent
    assert watch.silent_ms == pytest.approx(10.0 * ticks)
