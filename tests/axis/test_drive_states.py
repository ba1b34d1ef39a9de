"""Heartbeat against feedback: what contradicts what, for how long, and which transitions are none."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.axis.rig import PERIOD_S, axis_settings
from twostage_servo.axis.drive_states import DriveState, DriveStateComparison, interpret

SETTINGS = axis_settings()
PATIENCE = 30
"""heartbeat_ms is 300."""
TEXTS = (
    "Not ready to switch on", "Ready to switch on", "Switched on", "Operation enabled", "Fault",
    "Fault reaction active", "Quick stop active", "Switch on disabled",
)  # fmt: skip
ENABLED, READY, FAULT = (interpret(text) for text in ("Operation enabled", "Ready to switch on", "Fault"))


def comparison() -> DriveStateComparison:
    return DriveStateComparison(SETTINGS, PERIOD_S)


def tick(
    compared: DriveStateComparison,
    enabled: bool | None = True,
    faulted: bool | None = False,
    state: DriveState | None = None,
    *,
    reported: bool = True,
    told: bool = True,
    missed: int = 0,
) -> str | None:
    compared.begin_tick()
    if state is not None:
        compared.record(state)
    compared.compare(missed, enabled, faulted, has_reported=reported, told_enabled=told)
    return compared.contradiction


def test_the_names_of_cia_402_are_understood_however_they_are_written() -> None:
    assert all(interpret(text) is not None for text in TEXTS)
    assert interpret("OPERATION_ENABLED") == DriveState("OPERATION_ENABLED", enabled=True, faulted=False)
    assert interpret(" switch  on disabled") == DriveState(" switch  on disabled", enabled=False, faulted=False)
    assert interpret("Running") is None


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("enabled", [True, False, None])
@pytest.mark.parametrize("faulted", [True, False, None])
def test_what_contradicts_what(text: str, enabled: bool | None, faulted: bool | None) -> None:
    state = interpret(text)
    assert state is not None
    compared = comparison()
    seen = [tick(compared, enabled, faulted, state if n % 10 == 0 else None) for n in range(200)]
    about_enabling = enabled is not None and state.enabled is not None and enabled != state.enabled
    by_what_it_was_told = enabled is None and state.enabled is False
    about_fault = (text.startswith("Fault") and faulted is False) or (text == "Operation enabled" and faulted is True)
    assert (seen[-1] is not None) == (about_enabling or by_what_it_was_told or about_fault)


@given(st.integers(1, 30), st.integers(0, 30))
def test_it_lasts_after_three_heartbeats_and_the_time_in_which_one_is_certain(period: int, offset: int) -> None:
    compared = comparison()
    first = next(
        n for n in range(400) if tick(compared, state=FAULT if n >= offset and (n - offset) % period == 0 else None)
    )
    assert max(PATIENCE, 2 * period) <= first - offset <= max(PATIENCE, 2 * period) + period


@given(
    period=st.integers(1, 30),
    behind=st.integers(0, 2),
    runs=st.lists(st.tuples(st.booleans(), st.integers(1, 90)), min_size=1, max_size=12),
)
def test_a_heartbeat_that_is_up_to_a_period_behind_contradicts_nothing(
    period: int, behind: int, runs: list[tuple[bool, int]]
) -> None:
    """Each heartbeat tells the state as it was so many heartbeats ago, up to one; the feedback tells it at once."""
    compared = comparison()
    enabled = [state for state, ticks in runs for _ in range(ticks)]
    told: list[DriveState | None] = []
    for n, now in enumerate(enabled):
        state = None
        if n % period == 0:
            told.append(ENABLED if now else READY)
            state = told[max(0, len(told) - 1 - min(behind, 1))]
        assert tick(compared, enabled=now, state=state) is None


@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=10, max_size=200))
def test_one_heartbeat_that_agrees_ends_it(heard: list[tuple[bool, bool]]) -> None:
    compared, row = comparison(), 0
    for beats, agrees in heard:
        contradiction = tick(compared, state=(ENABLED if agrees else READY) if beats else None)
        row = row if not beats else 0 if agrees else row + 1
        assert row >= 3 or contradiction is None


def test_feedback_that_is_old_proves_nothing() -> None:
    compared = comparison()
    tick(compared)
    assert all(tick(compared, state=FAULT, reported=False) is None for _ in range(200))


def test_what_feedback_says_anew_begins_anew() -> None:
    compared = comparison()
    for n in range(300):
        assert tick(compared, enabled=n // 25 % 2 == 0, state=FAULT, faulted=False) is None


def test_a_drive_without_the_bit_has_its_time_to_follow() -> None:
    compared = comparison()
    for _ in range(100):
        assert tick(compared, None, state=READY, told=False) is None
    first = next(n for n in range(400) if tick(compared, None, state=READY))
    assert first == 51 + PATIENCE
    # Told to be off, it is the watch on a disabled drive that looks at what it says.
    assert all(tick(compared, None, state=ENABLED, told=False) is None for _ in range(200))


def test_the_cause_has_its_numbers_and_outlives_a_reload_but_not_the_bus() -> None:
    compared = comparison()
    for _ in range(41):
        tick(compared, faulted=None, state=FAULT)
    text = "for 400 ms the drive's heartbeat has said 'Fault', but its feedback has said enabled"
    assert compared.contradiction == text
    other = comparison()
    other.continue_from(compared)
    assert other.contradiction == text
    other.forget()
    assert other.contradiction is None


@pytest.mark.parametrize("missed", [0, 1, 4])
def test_missed_ticks_are_time_in_which_a_drive_could_follow_and_contradict(missed: int) -> None:
    compared = comparison()
    tick(compared, None, told=False)
    first = next(n for n in range(400) if tick(compared, None, state=READY, missed=missed))
    follows = math.ceil(51 / (1 + missed))
    assert first == follows + math.ceil(PATIENCE / (1 + missed))
    assert compared.contradiction is not None
    assert f"for {10 * (first - follows) * (1 + missed)} ms" in compared.contradiction


def test_feedback_counts_that_has_come_at_any_time_since_the_heartbeat_before() -> None:
    compared = comparison()
    for n in range(100):
        tick(compared, state=FAULT if n % 10 == 9 else None, reported=n % 10 == 0)
    assert compared.contradiction is not None


def test_after_the_bus_was_lost_everything_is_counted_anew() -> None:
    compared = comparison()
    for _ in range(100):
        tick(compared, None, state=READY)
    compared.forget()
    assert compared.new is None
    assert tick(compared, None, state=READY, reported=False) is None
    first = next(n for n in range(1, 400) if tick(compared, None, state=READY))
    assert first == 50 + PATIENCE
    compared.forget()
    heard = [tick(compared, state=FAULT if n % 40 == 0 else None) for n in range(200)]
    assert next(n for n, text in enumerate(heard) if text) == 80  # the third heartbeat


def test_before_the_first_heartbeat_none_has_come() -> None:
    assert [DriveStateComparison(axis_settings(), PERIOD_S).new] == [None]
