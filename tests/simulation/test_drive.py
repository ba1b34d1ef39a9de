import itertools
import math
import statistics
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.simulation.bench import START_S, Bench, message, motion
from twostage_servo.axis.messages import Feedback, Heartbeat
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.dbc.settings import CommandSettings, FeedbackSettings, ProtocolSettings
from twostage_servo.drives.frame import SentFrame
from twostage_servo.simulation.power_stage import COMMAND_TIMEOUT_FAULT
from twostage_servo.simulation.settings import SimulationSettings


def test_it_boots_disabled_and_says_so(profile: DriveProfile) -> None:
    bench = Bench(profile, boot_counter=7, initial_position=12.5)
    feedback, heartbeat = bench.cycle(0.0)
    assert feedback == Feedback(12.5, 1, *[False] * 3, *[False] * 5)
    assert isinstance(heartbeat, Heartbeat)
    assert heartbeat.boot_counter == 7
    assert profile.traits.state_texts[heartbeat.state or 0] == "Ready to switch on"
    assert not bench.drive.enabled
    assert bench.drive.effort == 0.0


def test_after_the_start_only_an_edge_of_enable_enables_it(profile: DriveProfile) -> None:
    bench = Bench(profile)
    for n in range(10):
        bench.command(0.01 * n, 1.0)
    assert (bench.drive.enabled, bench.drive.effort) == (False, 0.0)
    bench.command(0.1, 1.0, enable=False)
    assert (bench.drive.enabled, bench.drive.effort) == (False, 0.0)
    bench.command(0.11, 1.0)
    assert (bench.drive.enabled, bench.drive.effort) == (True, 1.0)
    (feedback,) = bench.feedback(0.11)
    assert feedback.enabled


def test_an_enabled_drive_says_so_in_its_heartbeat(profile: DriveProfile) -> None:
    bench = Bench(profile)
    bench.enable()
    heartbeat = next(frame for frame in bench.cycle(0.0) if isinstance(frame, Heartbeat))
    assert profile.traits.state_texts[heartbeat.state or 0] == "Operation enabled"


def test_effort_acts_from_the_exact_time_of_arrival(profile: DriveProfile) -> None:
    bench = Bench(profile)
    bench.enable(0.0031, 1.0)
    bench.command(0.0177, -0.5)
    bench.cycle(0.05)
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(motion((0.0146, 1.0), (0.0323, -0.5)))


def test_effort_acts_after_the_delay(profile: DriveProfile) -> None:
    bench = Bench(profile, delay_ms=12.3)
    bench.enable(0.0, 1.0)
    bench.command(0.01, 2.0)
    bench.cycle(0.0122)
    assert (bench.drive.position, bench.drive.effort, bench.drive.enabled) == (0.0, 0.0, True)
    bench.cycle(0.04)
    assert bench.drive.effort == 2.0
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(motion((0.01, 1.0), (0.0177, 2.0)))


def test_enable_0_acts_at_once_and_drops_what_is_under_way(profile: DriveProfile) -> None:
    bench = Bench(profile, delay_ms=5.0)
    bench.enable(0.0, 1.0)
    bench.command(0.018, 9.0)
    bench.command(0.02, 9.0, enable=False)
    assert (bench.drive.enabled, bench.drive.effort) == (False, 0.0)
    bench.cycle(0.06)
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(motion((0.015, 1.0), (0.04, 0.0)))


@pytest.mark.parametrize("effort", [32.0, -32.0])
def test_the_whole_range_of_effort_is_obeyed(profile: DriveProfile, effort: float) -> None:
    bench = Bench(profile)
    bench.enable(effort=effort)
    assert bench.drive.effort == effort


@given(flips=st.integers(1, 255), byte=st.integers(0, 3))
def test_a_damaged_command_is_counted_and_changes_nothing(profile: DriveProfile, flips: int, byte: int) -> None:
    """A CRC of 8 bits detects every pattern within one byte."""
    bench = Bench(profile)
    bench.enable(effort=1.0)
    good = int.from_bytes(profile.encode_command(1.0, enable=True, counter=3), "little")
    damaged = message(profile.command_id, (good ^ flips << 8 * byte).to_bytes(4, "little"))
    bench.drive.receive(damaged, START_S + 0.04)
    bench.cycle(0.05)
    counters = bench.drive.counters
    assert (counters.rejected, counters.accepted, counters.command_timeouts) == (1, 2, 1)
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(motion((0.05, 1.0)))


@pytest.mark.parametrize(
    "frame",
    [
        can.Message(arbitration_id=0x201, is_extended_id=False, data=bytes(3)),
        can.Message(arbitration_id=0x201, is_extended_id=True, data=bytes(4)),
        can.Message(arbitration_id=0x202, is_extended_id=False, data=bytes(4)),
        can.Message(arbitration_id=0x201, is_extended_id=False, is_remote_frame=True, dlc=4),
        can.Message(arbitration_id=0x201, is_error_frame=True),
    ],
    ids=["short", "extended", "foreign", "remote", "error"],
)
def test_a_frame_of_another_kind_is_rejected(profile: DriveProfile, frame: can.Message) -> None:
    bench = Bench(profile)
    bench.drive.receive(frame, START_S)
    assert (bench.drive.counters.rejected, bench.drive.counters.accepted) == (1, 0)


def test_a_command_whose_counter_stands_still_is_not_obeyed_and_does_not_put_off_the_timeout(
    profile: DriveProfile,
) -> None:
    bench = Bench(profile)
    bench.enable(effort=1.0)
    for n in range(1, 6):
        bench.command(0.01 * n, 5.0, repeat_counter=True)
        assert bench.drive.effort == (1.0 if n < 5 else 0.0)
    assert bench.drive.counters.stale == 5
    assert bench.drive.fault_code == COMMAND_TIMEOUT_FAULT


def test_when_commands_cease_it_stops_by_itself_at_the_exact_time(profile: DriveProfile) -> None:
    bench = Bench(profile, command_timeout_ms=50.0)
    bench.enable(0.0, 1.0)
    bench.command(0.0204, 2.0)
    bench.cycle(0.0703)
    assert (bench.drive.enabled, bench.drive.effort) == (True, 2.0)
    (feedback,) = bench.feedback(0.1)
    assert feedback[2:6] == (False, True, COMMAND_TIMEOUT_FAULT, True)
    assert profile.traits.fault_texts[COMMAND_TIMEOUT_FAULT] == "Command timeout"
    expected = motion((0.0204, 1.0), (0.05, 2.0), (0.0296, 0.0))
    assert feedback.position == pytest.approx(expected[0], abs=0.0005)
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(expected)


def test_a_fault_shows_in_the_heartbeat(profile: DriveProfile) -> None:
    bench = Bench(profile)
    bench.enable()
    heartbeat = next(frame for frame in bench.cycle(0.1) if isinstance(frame, Heartbeat))
    assert profile.traits.state_texts[heartbeat.state or 0] == "Fault"


def test_a_controller_that_is_suspended_and_resumes_does_not_enable_it(profile: DriveProfile) -> None:
    bench = Bench(profile)
    bench.enable(effort=1.0)
    for n in range(6, 20):
        bench.command(0.01 * n, 1.0)
        assert bench.drive.effort == 0.0
        assert bench.drive.fault_code == COMMAND_TIMEOUT_FAULT
    bench.command(0.2, enable=False)
    assert (bench.drive.enabled, bench.drive.fault_code) == (False, 0)
    bench.command(0.21, 1.0)
    assert (bench.drive.enabled, bench.drive.effort) == (True, 1.0)
    assert bench.drive.counters.command_timeouts == 1


def test_effort_under_way_at_the_timeout_never_arrives(profile: DriveProfile) -> None:
    bench = Bench(profile, delay_ms=30.0, command_timeout_ms=20.0)
    bench.enable(effort=1.0)
    bench.cycle(1.0)
    assert bench.drive.position == 0.0


def test_a_disabled_drive_knows_no_timeout(profile: DriveProfile) -> None:
    bench = Bench(profile)
    bench.command(0.0, enable=False)
    bench.cycle(10.0)
    assert (bench.drive.counters.command_timeouts, bench.drive.fault_code) == (0, 0)


steps = st.lists(
    st.tuples(st.floats(0.0, 0.12), st.booleans(), st.sampled_from(["command", "repeated", "damaged", "lost"])),
    max_size=40,
)


@given(steps=steps, delay_ms=st.sampled_from([0.0, 3.0, 70.0]))
def test_whatever_arrives_it_is_enabled_only_after_an_edge_and_while_commands_are_fresh(
    profile: DriveProfile, steps: list[tuple[float, bool, str]], delay_ms: float
) -> None:
    bench = Bench(profile, delay_ms=delay_ms)
    now_s, fresh_s = 0.0, -math.inf
    seen_disabled = enabled = False
    for wait_s, enable, kind in steps:
        now_s += wait_s
        if enabled and START_S + now_s >= START_S + fresh_s + 0.05:
            enabled = seen_disabled = False
        if kind == "command" or (kind == "repeated" and bench.counter == 0):
            bench.command(now_s, 1.0, enable=enable)
            fresh_s = now_s
            seen_disabled = seen_disabled or not enable
            enabled = enable and seen_disabled
        elif kind == "repeated":
            bench.command(now_s, 1.0, enable=enable, repeat_counter=True)
        elif kind == "damaged":
            bench.drive.receive(message(profile.command_id, b"\x00\x00\x01\x00"), START_S + now_s)
        else:
            bench.cycle(now_s)
        assert bench.drive.enabled == enabled
        assert enabled or bench.drive.effort == 0.0


@given(
    commands=st.lists(st.tuples(st.floats(0.0, 0.03), st.floats(-5.0, 5.0)), min_size=1, max_size=15),
    looks_s=st.lists(st.floats(0.0, 0.5), max_size=30),
)
def test_looking_at_it_changes_nothing(
    profile: DriveProfile, commands: list[tuple[float, float]], looks_s: list[float]
) -> None:
    watched, alone = (Bench(profile, delay_ms=4.0, coulomb_friction=0.2, load=0.1, load_at_s=0.1) for _ in range(2))
    times_s = list(itertools.accumulate(wait_s for wait_s, _ in commands))
    events: list[tuple[float, float | None]] = [(look_s, None) for look_s in looks_s if look_s <= times_s[-1]]
    events += zip(times_s, (effort for _, effort in commands), strict=True)
    watched.enable()
    alone.enable()
    for at_s, effort in sorted(events, key=lambda event: event[0]):
        if effort is None:
            watched.drive.cycle(START_S + at_s)
            assert math.isfinite(watched.drive.position)
        else:
            watched.command(at_s, effort)
            alone.command(at_s, effort)
    assert watched.drive.position == pytest.approx(alone.drive.position, abs=1e-9)
    assert watched.drive.velocity == pytest.approx(alone.drive.velocity, abs=1e-9)
    assert watched.drive.effort == alone.drive.effort


def test_the_load_opposes_the_effort_from_its_time_on(profile: DriveProfile) -> None:
    bench = Bench(profile, load=0.4, load_at_s=0.0123, command_timeout_ms=1000.0)
    bench.enable(effort=1.0)
    bench.cycle(0.05)
    assert [bench.drive.position, bench.drive.velocity] == pytest.approx(motion((0.0123, 1.0), (0.0377, 0.6)))


def test_friction_holds_a_load_that_is_smaller(profile: DriveProfile) -> None:
    held, moved = Bench(profile, load=0.4, coulomb_friction=0.5), Bench(profile, load=0.6, coulomb_friction=0.5)
    held.cycle(1.0)
    moved.cycle(1.0)
    assert held.drive.position == 0.0
    assert moved.drive.position == pytest.approx(motion((1.0, -0.1))[0])


def test_feedback_answers_a_command_at_once_and_comes_by_itself_in_silence(profile: DriveProfile) -> None:
    bench = Bench(profile)
    sent_ms = []
    for ms in range(100):
        if ms in {15, 25, 35}:
            bench.command(ms / 1000, enable=False)
        sent_ms += [ms for _ in bench.feedback(ms / 1000)]
    assert sent_ms == [0, 10, 15, 25, 35, 46, 56, 66, 76, 86, 96]


def test_rejected_commands_get_no_answer(profile: DriveProfile) -> None:
    bench = Bench(profile)
    bench.command(0.0, enable=False)
    bench.feedback(0.0)
    bench.command(0.005, enable=False, repeat_counter=True)
    bench.drive.receive(message(profile.command_id, bytes(4)), START_S + 0.005)
    assert bench.feedback(0.005) == []


def test_cyclic_feedback_runs_free(profile: DriveProfile) -> None:
    bench = Bench(profile, feedback="cyclic", feedback_period_ms=4.0)
    sent_ms = []
    for ms in range(40):
        bench.command(ms / 1000, enable=False)
        sent_ms += [ms for _ in bench.feedback(ms / 1000)]
    assert sent_ms == list(range(0, 40, 4))


def test_a_late_firmware_cycle_makes_no_burst_and_keeps_the_phase(profile: DriveProfile) -> None:
    bench = Bench(profile, feedback="cyclic", heartbeat_ms=20.0)
    sent = [(ms, len(bench.cycle(ms / 1000))) for ms in (0, 10, 47, 48, 50, 60)]
    assert sent == [(0, 2), (10, 1), (47, 2), (48, 0), (50, 1), (60, 2)]


def test_heartbeats_keep_their_period_over_days(profile: DriveProfile) -> None:
    bench = Bench(profile)
    for beat in range(2_000_000, 2_000_100):
        assert sum(isinstance(frame, Heartbeat) for frame in bench.cycle(beat / 10)) == 1
        assert not any(isinstance(frame, Heartbeat) for frame in bench.cycle(beat / 10 + 0.099))


def test_the_alive_counter_of_feedback_advances_with_each_frame(profile: DriveProfile) -> None:
    bench = Bench(profile, feedback="cyclic")
    counters = [frame.counter for n in range(40) for frame in bench.feedback(n / 100)]
    assert counters == [n % 16 for n in range(1, 41)]


def test_the_encoder_rounds_to_its_quantum(profile: DriveProfile) -> None:
    for quantum, expected in [(0.25, 1.25), (0.001, 1.234), (0.0, 1.234)]:
        (feedback,) = Bench(profile, initial_position=1.2344, quantum=quantum).feedback(0.0)
        assert feedback.position == pytest.approx(expected, abs=1e-12)


def test_the_noise_is_gaussian_of_the_size_asked_for_and_hides_nothing_true(profile: DriveProfile) -> None:
    bench = Bench(profile, noise_std=0.5, feedback="cyclic", initial_position=100.0)
    errors = [frame.position - 100.0 for n in range(4000) for frame in bench.feedback(n / 100)]
    assert len(errors) == 4000
    assert statistics.fmean(errors) == pytest.approx(0.0, abs=0.03)
    assert statistics.stdev(errors) == pytest.approx(0.5, rel=0.05)
    assert sum(abs(error) < 0.5 for error in errors) / 4000 == pytest.approx(0.6827, abs=0.03)
    assert bench.drive.position == 100.0


def test_the_same_seed_gives_the_same_frames_and_another_seed_others(profile: DriveProfile) -> None:
    def frames(seed: int) -> list[list[SentFrame]]:
        bench = Bench(profile, noise_std=0.1, frame_loss=0.3, seed=seed)
        return [bench.drive.cycle(START_S + n / 100) for n in range(200)]

    assert frames(1) == frames(1)
    assert frames(1) != frames(2)


def test_frames_are_lost_in_both_directions_at_the_rate_asked_for(profile: DriveProfile) -> None:
    bench = Bench(profile, frame_loss=0.25, feedback="cyclic")
    received = 0
    for n in range(4000):
        bench.command(n / 100, enable=False)
        received += len(bench.feedback(n / 100))
    assert bench.drive.counters.accepted == pytest.approx(3000, rel=0.05)
    assert received == pytest.approx(3000, rel=0.05)
    assert bench.drive.counters.samples == 4000
    assert bench.drive.counters.lost == pytest.approx(0.25 * 8400, rel=0.08)


def test_a_lost_feedback_leaves_a_gap_in_its_counter(profile: DriveProfile) -> None:
    bench = Bench(profile, frame_loss=0.5, feedback="cyclic")
    counters = [frame.counter for n in range(12) for frame in bench.feedback(n / 100)]
    assert counters
    gaps = [int(b or 0) - int(a or 0) for a, b in itertools.pairwise(counters)]
    assert min(gaps) >= 1
    assert max(gaps) > 1


def test_total_loss_silences_it_and_the_timeout_still_stops_it(profile: DriveProfile) -> None:
    bench = Bench(profile, frame_loss=1.0)
    bench.enable()
    assert bench.cycle(0.0) == []
    assert bench.drive.counters.accepted == 0


def test_a_drive_without_enable_counter_checksum_and_heartbeat(tmp_path: Path) -> None:
    (tmp_path / "bare.dbc").write_text(
        'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_:\n\n'
        'BO_ 32 Set: 2 Vector__XXX\n SG_ Effort : 0|16@1- (0.001,0) [-20|32] "" Vector__XXX\n\n'
        'BO_ 33 Get: 4 Vector__XXX\n SG_ Position : 0|32@1- (0.001,0) [0|0] "mm" Vector__XXX\n'
    )
    necessary = {"message", "position", "position_scale", "sampling"}
    roles = dict.fromkeys(FeedbackSettings.model_fields.keys() - necessary, False)
    settings = ProtocolSettings.model_validate(
        {
            "dbc": "bare.dbc",
            "checksum": "none",
            "feedback": {"message": "Get", "position": "Position", **roles},
            "command": CommandSettings(message="Set", enable=False, counter=False, checksum=False).model_dump(),
            "index": {"message": False},
            "heartbeat": {"message": False, "state": False, "boot_counter": False},
        }
    )
    bench = Bench(DriveProfile.compile(settings, tmp_path, "mm"))
    bench.command(0.0, 30.0)
    assert bench.drive.effort == 30.0
    assert len(bench.cycle(0.0)) == 1
    bench.cycle(0.05)
    assert (bench.drive.effort, bench.drive.counters.command_timeouts) == (0.0, 1)
    bench.command(0.06, -19.0)
    assert (bench.drive.effort, bench.drive.fault_code) == (-19.0, 0)
    bench.drive.receive(message(bench.profile.command_id, (-25_000).to_bytes(2, "little", signed=True)), START_S + 0.07)
    assert (bench.drive.effort, bench.drive.counters.rejected) == (-19.0, 1)


def test_time_does_not_run_backwards(profile: DriveProfile) -> None:
    bench = Bench(profile)
    bench.cycle(1.0)
    with pytest.raises(ValueError, match="cannot advance"):
        bench.command(0.5, 1.0)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gain", 0.0),
        ("pole", -1.0),
        ("frame_loss", 1.1),
        ("noise_std", -0.1),
        ("cycle_ms", 0.0),
        ("feedback", "sometimes"),
        ("seed", -1),
        ("load", math.nan),
    ],
)
def test_settings_out_of_bounds_are_refused(field: str, value: object) -> None:
    with pytest.raises(ValidationError, match=field):
        SimulationSettings.model_validate({field: value})
