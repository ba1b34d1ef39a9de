"""Each fault of the drive by its frames and its true motion; the oracle of the motion is the matrix exponential."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from tests.simulation.bench import GAIN, POLE, START_S, Bench, message, motion
from twostage_servo.axis.messages import Feedback, Heartbeat
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.frame import FrameRejected, SentFrame
from twostage_servo.simulation.faults import DriveFaults

PATIENT = {"command_timeout_ms": 10_000.0}  # a drive that a test need not command all the time


def driven(profile: DriveProfile, effort: float = 1.0, **settings: Any) -> Bench:
    bench = Bench(profile, **(PATIENT | settings))
    bench.enable(effort=effort)
    return bench


def glide(state: tuple[float, float], duration_s: float, effort: float, gain: float, pole: float) -> Any:
    generator = np.array([[0.0, 1.0, 0.0], [0.0, -pole, gain], [0.0, 0.0, 0.0]])
    return (expm(generator * duration_s) @ [*state, effort])[:2]


def states_told(bench: Bench, at_s: float) -> tuple[Feedback, str]:
    """The feedback of a free-running drive, and its state in words."""
    frames = bench.cycle(at_s)
    (feedback,) = [frame for frame in frames if isinstance(frame, Feedback)]
    (heartbeat,) = [frame for frame in frames if isinstance(frame, Heartbeat)]
    return feedback, bench.profile.traits.state_texts[heartbeat.state or 0]


# In general -----------------------------------------------------------------------------------------------------------


def test_without_faults_there_is_none(profile: DriveProfile) -> None:
    assert Bench(profile).drive.faults == DriveFaults()


@given(
    commands=st.lists(st.tuples(st.floats(0.0, 0.03), st.floats(-5.0, 5.0)), min_size=1, max_size=12),
    changes_s=st.lists(st.floats(0.0, 0.4), max_size=12),
)
def test_a_change_to_what_is_already_so_changes_nothing(
    profile: DriveProfile, commands: list[tuple[float, float]], changes_s: list[float]
) -> None:
    settings = {"delay_ms": 4.0, "coulomb_friction": 0.2, "load": 0.1, "load_at_s": 0.1}
    changed, alone = driven(profile, 0.0, **settings), driven(profile, 0.0, **settings)
    times_s = list(itertools.accumulate(wait_s for wait_s, _ in commands))
    events: list[tuple[float, float | None]] = [(at_s, None) for at_s in changes_s if at_s <= times_s[-1]]
    events += zip(times_s, (effort for _, effort in commands), strict=True)
    for at_s, effort in sorted(events, key=lambda event: event[0]):
        if effort is None:
            changed.change(at_s, gain_factor=1.0, stalled=False, safe_torque_off=False, fault_code=0, effort_limit=99.0)
        else:
            changed.command(at_s, effort)
            alone.command(at_s, effort)
    assert changed.drive.position == pytest.approx(alone.drive.position, abs=1e-9)
    assert changed.drive.velocity == pytest.approx(alone.drive.velocity, abs=1e-9)
    assert (changed.drive.effort, changed.drive.enabled) == (alone.drive.effort, alone.drive.enabled)


@pytest.mark.parametrize(
    ("faults", "error"),
    [
        ({"no_such_fault": 1}, TypeError),
        ({"gain_factor": 0.0, "stalled": True}, ValueError),
        ({"pole_factor": -1.0}, ValueError),
        ({"coulomb_friction": -1.0}, ValueError),
        ({"effort_limit": -1.0}, ValueError),
        ({"effort_limit": math.nan}, ValueError),
        ({"load": math.inf}, ValueError),
        ({"effort_while_disabled": math.nan}, ValueError),
    ],
)
def test_a_fault_that_makes_no_sense_is_refused_and_changes_nothing(
    profile: DriveProfile, faults: dict[str, Any], error: type[Exception]
) -> None:
    bench = driven(profile)
    with pytest.raises(error):
        bench.change(0.01, **faults)
    assert bench.drive.faults == DriveFaults()
    bench.cycle(0.05)
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(motion((0.05, 1.0)))


# Plant and power stage ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("faults", "effort", "gain", "pole"),
    [
        ({"load": 0.3}, 0.7, GAIN, POLE),
        ({"effort_limit": 0.5}, 0.5, GAIN, POLE),
        ({"gain_factor": 1.3}, 1.0, 1.3 * GAIN, POLE),
        ({"gain_factor": -1.0}, 1.0, -GAIN, POLE),
        ({"pole_factor": 0.5}, 1.0, GAIN, 0.5 * POLE),
        ({"coulomb_friction": 0.4}, 0.6, GAIN, POLE),
    ],
)
def test_a_change_of_the_plant_acts_from_its_exact_time_on_and_until_it_is_undone(
    profile: DriveProfile, faults: dict[str, Any], effort: float, gain: float, pole: float
) -> None:
    bench = driven(profile)
    bench.change(0.0137, **faults)
    bench.cycle(0.02)
    bench.change(0.0251, **{name: getattr(DriveFaults(), name) for name in faults})
    bench.cycle(0.05)
    state = glide((0.0, 0.0), 0.0137, 1.0, GAIN, POLE)
    state = glide(state, 0.0114, effort, gain, pole)
    state = glide(state, 0.0249, 1.0, GAIN, POLE)
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(state)


def test_the_load_of_a_fault_adds_to_that_of_the_settings(profile: DriveProfile) -> None:
    bench = driven(profile, load=0.2, load_at_s=0.01)
    bench.change(0.0, load=0.3)
    bench.cycle(0.03)
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(motion((0.01, 0.7), (0.02, 0.5)))


def test_a_stall_stops_it_at_once_and_for_as_long_as_it_lasts(profile: DriveProfile) -> None:
    bench = driven(profile, load=0.5, load_at_s=0.03)
    bench.change(0.02, stalled=True)
    bench.command(0.025, 2.0)
    bench.cycle(0.1)
    stands_at = motion((0.02, 1.0))[0]
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx([stands_at, 0.0], rel=1e-9, abs=0.0)
    bench.change(0.1, stalled=False)
    bench.cycle(0.13)
    assert bench.drive.position == pytest.approx(stands_at + motion((0.03, 1.5))[0])


def test_the_effort_is_clipped_on_both_sides_and_comes_back(profile: DriveProfile) -> None:
    bench = driven(profile, effort=3.0)
    for at_s, limit, command, acts in [
        (0.00, 2.0, None, 2.0),
        (0.01, 2.0, -5.0, -2.0),
        (0.02, 4.0, None, -4.0),
        (0.03, 0.0, 1.0, 0.0),
        (0.04, None, None, 1.0),
    ]:
        bench.change(at_s, effort_limit=limit)
        if command is not None:
            bench.command(at_s, command)
        assert bench.drive.effort == acts


def test_a_drive_that_stays_enabled_obeys_neither_enable_nor_its_time_out(profile: DriveProfile) -> None:
    bench = Bench(profile, feedback="cyclic", command_timeout_ms=20.0)
    bench.command(0.0, enable=False)
    bench.change(0.01, stays_enabled=True)  # comes on by itself
    assert (bench.drive.enabled, bench.drive.effort) == (True, 0.0)
    bench.command(0.02, 1.5, enable=False)
    told, state = states_told(bench, 0.1)
    assert (told.enabled, told.fault, state, bench.drive.effort) == (True, False, "Operation enabled", 1.5)
    assert bench.drive.counters.command_timeouts == 0
    bench.change(0.11, safe_torque_off=True)
    assert (bench.drive.enabled, bench.drive.effort) == (False, 0.0)
    bench.command(0.12, 1.0, enable=False)
    assert not bench.drive.enabled
    bench.change(0.13, safe_torque_off=False)
    bench.command(0.14, 1.0, enable=False)
    assert (bench.drive.enabled, bench.drive.effort) == (True, 1.0)
    bench.change(0.15, stays_enabled=False)
    bench.command(0.16, 1.0, enable=False)
    assert (bench.drive.enabled, bench.drive.effort) == (False, 0.0)


@pytest.mark.parametrize("commanded", [True, False])
def test_a_drive_that_stays_enabled_no_more_times_out_at_once_if_no_command_has_come(
    profile: DriveProfile, *, commanded: bool
) -> None:
    """Its time-out lies in the past then: the axis was to be moved back in time (service soak, seed 5)."""
    bench = Bench(profile, feedback="cyclic", command_timeout_ms=20.0)
    if commanded:
        bench.enable(0.0, 1.0)
    bench.change(0.01, stays_enabled=True)
    bench.cycle(0.5)
    assert bench.drive.enabled
    bench.change(0.6, stays_enabled=False)
    bench.cycle(0.7)
    assert (bench.drive.enabled, bench.drive.counters.command_timeouts) == (False, 1)


def test_a_drive_that_stays_enabled_and_ignores_effort_goes_on_with_the_one_it_had(profile: DriveProfile) -> None:
    bench = driven(profile, effort=1.5)
    bench.change(0.01, stays_enabled=True, ignores_effort=True)
    bench.command(0.02, 0.0, enable=False)
    bench.cycle(0.05)
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(motion((0.05, 1.5)))


def test_an_axis_can_move_though_its_drive_is_off_and_says_so(profile: DriveProfile) -> None:
    bench = Bench(profile, feedback="cyclic")
    bench.change(0.0, effort_while_disabled=0.5)
    told, state = states_told(bench, 0.1)
    assert (told.enabled, state) == (False, "Ready to switch on")
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(motion((0.1, 0.5)))
    bench.enable(0.1, effort=2.0)
    assert bench.drive.effort == 2.0
    bench.command(0.1, enable=False)
    assert bench.drive.effort == 0.5
    bench.change(0.1, effort_while_disabled=0.0)
    assert bench.drive.effort == 0.0


def test_a_heartbeat_can_say_another_state_than_the_true_one(profile: DriveProfile) -> None:
    bench = Bench(profile, feedback="cyclic", heartbeat_ms=20.0)
    bench.change(0.0, heartbeat_state=4)
    told, state = states_told(bench, 0.0)
    assert (told.enabled, told.fault, state) == (False, False, "Fault")
    bench.change(0.01, heartbeat_state=None)
    assert states_told(bench, 0.02)[1] == "Ready to switch on"


def test_a_drive_that_ignores_effort_keeps_the_one_it_had_but_obeys_enable(profile: DriveProfile) -> None:
    bench = driven(profile, effort=1.5, delay_ms=2.0)
    bench.cycle(0.01)
    bench.command(0.019, 9.0)  # under way when the fault comes
    bench.change(0.02, ignores_effort=True)
    bench.command(0.03, -3.0)
    bench.cycle(0.04)
    assert bench.drive.effort == 1.5
    bench.command(0.05, 0.0, enable=False)
    bench.change(0.051, load=0.1)
    assert (bench.drive.enabled, bench.drive.effort) == (False, 0.0)
    bench.command(0.06, 0.0)
    bench.cycle(0.07)
    assert (bench.drive.enabled, bench.drive.effort) == (True, 1.5)
    bench.change(0.08, ignores_effort=False)
    bench.command(0.09, 0.25)
    bench.cycle(0.1)
    assert bench.drive.effort == 0.25


def test_a_drive_that_ignores_effort_still_stops_when_commands_cease(profile: DriveProfile) -> None:
    bench = driven(profile, command_timeout_ms=50.0)
    bench.change(0.0, ignores_effort=True)
    bench.cycle(0.06)
    assert (bench.drive.enabled, bench.drive.effort, bench.drive.counters.command_timeouts) == (False, 0.0, 1)


# Fault, safe torque off -----------------------------------------------------------------------------------------------


def test_a_fault_disables_it_latches_and_is_cleared_once_its_cause_is_gone(profile: DriveProfile) -> None:
    bench = driven(profile, feedback="cyclic")
    bench.change(0.02, fault_code=2)
    bench.cycle(0.09)
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(motion((0.02, 1.0), (0.07, 0.0)))
    feedback, state = states_told(bench, 0.1)
    assert (feedback.enabled, feedback.fault, feedback.fault_code, feedback.command_timeout) == (False, True, 2, False)
    assert state == "Fault"
    bench.command(0.11, enable=False)
    bench.command(0.12, 1.0)
    assert (bench.drive.fault_code, bench.drive.enabled) == (2, False)
    bench.change(0.13, fault_code=0)
    bench.command(0.14, 1.0)  # this Enable was there before
    assert (bench.drive.fault_code, bench.drive.enabled) == (2, False)
    bench.command(0.15, enable=False)
    assert (bench.drive.fault_code, bench.drive.enabled) == (0, False)
    bench.command(0.16, 1.0)
    assert (bench.drive.enabled, bench.drive.effort) == (True, 1.0)


def test_safe_torque_off_takes_the_effort_but_not_the_position(profile: DriveProfile) -> None:
    bench = driven(profile, feedback="cyclic")
    bench.change(0.03, safe_torque_off=True)
    bench.cycle(0.09)
    feedback, state = states_told(bench, 0.1)
    expected = motion((0.03, 1.0), (0.07, 0.0))
    assert feedback.position == pytest.approx(expected[0], abs=0.0006)
    assert (feedback.safe_torque_off, feedback.enabled, feedback.fault) == (True, False, False)
    assert state == "Switch on disabled"
    bench.command(0.11, enable=False)
    bench.command(0.12, 1.0)
    assert (bench.drive.enabled, bench.drive.effort) == (False, 0.0)
    bench.change(0.13, safe_torque_off=False)
    bench.command(0.14, 1.0)
    assert (bench.drive.enabled, bench.drive.effort) == (False, 0.0)
    bench.command(0.15, enable=False)
    bench.command(0.16, 1.0)
    assert (bench.drive.enabled, bench.drive.effort) == (True, 1.0)
    (feedback,) = bench.feedback(0.16)
    assert feedback.safe_torque_off is False


class Rules:
    """When the drive is enabled, in words: only after an edge that came while nothing forbade it."""

    def __init__(self) -> None:
        self.cause = self.latched = self.torque_off = self.may_enable = self.enabled = False

    def enable(self) -> None:
        self.may_enable = self.enabled = self.may_enable and not (self.latched or self.torque_off)

    def disable(self) -> None:
        self.latched, self.may_enable, self.enabled = self.cause, True, False

    def fail(self) -> None:
        if not self.cause:
            self.cause = self.latched = True
            self.may_enable = self.enabled = False

    def mend(self) -> None:
        self.cause = False

    def take_torque_off(self) -> None:
        if not self.torque_off:
            self.torque_off = True
            self.may_enable = self.enabled = False

    def give_torque(self) -> None:
        self.torque_off = False

    def reboot(self) -> None:
        self.latched = self.cause
        self.may_enable = self.enabled = False

    def fall_silent(self) -> None:
        if self.enabled:
            self.latched, self.may_enable, self.enabled = True, False, False


DOINGS: dict[str, Callable[[Bench, float], object]] = {
    "enable": lambda bench, at_s: bench.command(at_s, 1.0),
    "disable": lambda bench, at_s: bench.command(at_s, enable=False),
    "fail": lambda bench, at_s: bench.change(at_s, fault_code=3),
    "mend": lambda bench, at_s: bench.change(at_s, fault_code=0),
    "take_torque_off": lambda bench, at_s: bench.change(at_s, safe_torque_off=True),
    "give_torque": lambda bench, at_s: bench.change(at_s, safe_torque_off=False),
    "reboot": lambda bench, at_s: bench.drive.reboot(START_S + at_s, 0.0),
    "fall_silent": lambda bench, at_s: bench.cycle(at_s),
}


@given(st.lists(st.sampled_from(sorted(DOINGS)), max_size=40))
def test_it_is_enabled_when_the_rules_say_so(profile: DriveProfile, doings: list[str]) -> None:
    bench, rules, at_s = Bench(profile), Rules(), 0.0
    for doing in doings:
        at_s += 0.051 if doing == "fall_silent" else 0.0001
        DOINGS[doing](bench, at_s)
        getattr(rules, doing)()
        assert bench.drive.enabled == rules.enabled
        assert (bench.drive.fault_code != 0) == rules.latched
        assert rules.enabled or bench.drive.effort == 0.0


# Frames ---------------------------------------------------------------------------------------------------------------


def test_a_frozen_counter_stands_still_while_the_position_moves(profile: DriveProfile) -> None:
    bench = driven(profile, feedback="cyclic")
    (before,) = bench.feedback(0.0)
    bench.change(0.005, frozen_counter=True)
    frozen = [frame for n in range(1, 6) for frame in bench.feedback(n / 100)]
    assert {frame.counter for frame in frozen} == {before.counter}
    assert len({frame.position for frame in frozen}) == 5
    bench.change(0.055, frozen_counter=False)
    (after,) = bench.feedback(0.06)
    assert after.counter == (before.counter or 0) + 1


def test_a_silent_heartbeat_keeps_its_rhythm(profile: DriveProfile) -> None:
    bench = Bench(profile, heartbeat_ms=20.0)

    def beats(first_ms: int, last_ms: int) -> list[int]:
        return [ms for ms in range(first_ms, last_ms) for one in bench.cycle(ms / 1000) if isinstance(one, Heartbeat)]

    assert beats(0, 50) == [0, 20, 40]
    bench.change(0.05, heartbeat_silent=True)
    assert beats(50, 110) == []
    bench.change(0.11, heartbeat_silent=False)
    assert beats(110, 170) == [120, 140, 160]


@pytest.mark.parametrize("switch", ["positive_limit", "negative_limit", "home_switch"])
def test_a_switch_can_be_stuck_either_way(profile: DriveProfile, switch: str) -> None:
    bench = Bench(profile, feedback="cyclic", positive_limit_from=-1.0, home_switch_from=-1.0, home_switch_to=1.0)
    (sound,) = bench.feedback(0.0)
    for n, stuck in enumerate((True, False), start=1):
        bench.change(n / 100, **{switch: stuck})
        (feedback,) = bench.feedback(n / 100)
        assert getattr(feedback, switch) is stuck
    bench.change(0.03, **{switch: None})
    (feedback,) = bench.feedback(0.03)
    assert feedback[6:] == sound[6:] == (False, True, False, True)


# Encoder --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("measure", "expected"),
    [
        (lambda position: 7.5, 7.5),
        (lambda position: position + 20.0, 32.5),
        (lambda position: -position, -12.5),
        (lambda position: 2.0 * position, 25.0),
        (lambda position: 3e9, 3e9 - 699 * 4294967.296),  # far beyond the signal: it wraps
    ],
    ids=["frozen", "jump", "inverted", "scaled", "far"],
)
def test_the_encoder_reports_what_the_fault_makes_of_the_position(
    profile: DriveProfile, measure: Any, expected: float
) -> None:
    bench = Bench(profile, initial_position=12.5, quantum=0.01, feedback="cyclic")
    bench.change(0.0, measure=measure)
    (feedback,) = bench.feedback(0.0)
    period = profile.traits.position_period
    assert feedback.position == pytest.approx(math.remainder(expected, period), abs=1e-6)
    assert bench.drive.position == 12.5
    bench.change(0.01, measure=None)
    (feedback,) = bench.feedback(0.01)
    assert feedback.position == pytest.approx(12.5)


def test_a_frozen_encoder_has_no_noise(profile: DriveProfile) -> None:
    bench = Bench(profile, noise_std=1.0, feedback="cyclic")
    bench.change(0.0, measure=lambda _: 3.0)
    assert {frame.position for n in range(20) for frame in bench.feedback(n / 100)} == {3.0}


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("quantum", [0.0, 0.001])
def test_an_invalid_position_is_sent_as_the_reserved_value(profile: DriveProfile, value: float, quantum: float) -> None:
    bench = Bench(profile, quantum=quantum)
    bench.change(0.0, measure=lambda _: value)
    (identifier, data), *_ = bench.drive.cycle(START_S)
    assert data[:4] == bytes.fromhex("00000080")
    with pytest.raises(FrameRejected) as caught:
        profile.decode_feedback(message(identifier, data))
    assert caught.value.reason == "reserved_value"


def test_the_index_is_latched_from_the_faulty_count(profile: DriveProfile) -> None:
    bench = driven(profile, index_at=0.5)
    bench.change(0.0, measure=lambda position: position + 2.0)
    (index,) = bench.index(0.2)
    assert index.position == pytest.approx(2.5)


# Reboot ---------------------------------------------------------------------------------------------------------------


def test_a_reboot_coasts_in_silence_and_counts_from_zero_where_it_then_is(profile: DriveProfile) -> None:
    bench = driven(profile, feedback="cyclic", initial_position=30.0, boot_counter=254)
    bench.cycle(0.0)
    bench.cycle(0.05)
    bench.drive.reboot(START_S + 0.0503, 0.2)
    assert (bench.drive.enabled, bench.drive.effort) == (False, 0.0)
    for n in range(51, 250):
        if n % 10 == 0:
            bench.command(n / 1000, 1.0)
        assert bench.cycle(n / 1000) == []
    assert bench.drive.counters.lost == 19
    zero = 30.0 + motion((0.0503, 1.0), (0.2, 0.0))[0]
    frames = bench.cycle(0.251)
    feedback, heartbeat = frames
    assert isinstance(feedback, Feedback)
    assert isinstance(heartbeat, Heartbeat)
    moved = motion((0.0503, 1.0), (0.2007, 0.0))[0] - motion((0.0503, 1.0), (0.2, 0.0))[0]
    assert feedback.position == pytest.approx(moved, abs=0.0011)
    assert (feedback.counter, feedback.enabled, heartbeat.boot_counter) == (1, False, 255)
    bench.command(0.26, 1.0)
    assert (bench.drive.enabled, bench.drive.effort) == (False, 0.0)
    bench.enable(0.27)
    assert (bench.drive.enabled, bench.drive.effort) == (True, 0.0)
    bench.cycle(2.0)
    bench.drive.reboot(START_S + 2.0, 0.0)
    beats = [frame.boot_counter for frame in bench.cycle(2.0) if isinstance(frame, Heartbeat)]
    assert beats == [0]
    assert bench.drive.position == pytest.approx(zero, abs=0.3)


def test_a_drive_that_boots_misses_its_index_and_latches_it_by_the_new_zero(profile: DriveProfile) -> None:
    bench = driven(profile, index_at=0.5, effort=2.0)
    bench.drive.reboot(START_S + 0.05, 1.0)  # it coasts past the mark
    assert bench.index(1.05) == []
    zero = bench.drive.position
    assert zero > 0.5
    bench.command(1.06, enable=False)
    bench.command(1.07, -1.0)
    (index,) = bench.index(1.5)
    assert index.position == pytest.approx(0.5 - zero, abs=0.0006)
    assert index.counter == 1


def test_a_fault_whose_cause_remains_is_there_again_after_the_reboot(profile: DriveProfile) -> None:
    bench = Bench(profile)
    bench.change(0.0, fault_code=7)
    bench.drive.reboot(START_S + 0.01, 0.1)
    (feedback,) = bench.feedback(0.2)
    assert feedback.fault_code == 7


@pytest.mark.parametrize("boot_s", [-0.1, math.nan, math.inf])
def test_a_boot_takes_some_time(profile: DriveProfile, boot_s: float) -> None:
    with pytest.raises(ValueError, match="cannot boot"):
        Bench(profile).drive.reboot(START_S, boot_s)


def test_faults_leave_the_chance_of_noise_and_losses_as_it_was(profile: DriveProfile) -> None:
    def frames(**faults: Any) -> list[list[SentFrame]]:
        bench = Bench(profile, noise_std=0.1, frame_loss=0.3)
        bench.change(0.0, **faults)
        bench.change(0.5, **{name: getattr(DriveFaults(), name) for name in faults})
        return [bench.drive.cycle(START_S + n / 100) for n in range(50, 100)]

    assert frames() == frames(measure=lambda _: 1.0, positive_limit=True)
