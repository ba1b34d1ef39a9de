"""The watch on an encoder's count, number by number: how far it may have moved, and which silence is a long one."""

import math
from collections.abc import Callable

import pytest

from tests.axis.rig import PERIOD_S, axis_settings
from twostage_servo.axis.count_watch import CountWatch
from twostage_servo.axis.design import design_axis

DESIGN = design_axis(axis_settings(), PERIOD_S)
A_TICK = 3.2
"""At the overspeed of 320 mm/s."""
GATE = 0.5
LONG = 5
"""30 ms of stale feedback and two missed ticks."""
COASTS_S = 1.0 / (0.7 * 14.0) + 0.03
"""With a pole that is 30 % less, and the three ticks until a command to disable shows."""
DRIVEN_S = 0.5
"""axis.arming_timeout_ms."""


def straight(before: float, now: float) -> float:
    return now - before


class Watched:
    """A watch with what it is told besides, where a test does not say otherwise."""

    def __init__(self, resolution: float = 0.0, distance: Callable[[float, float], float] = straight) -> None:
        self.watch = CountWatch(DESIGN, resolution, distance)
        self.speed = 0.0
        self.driven = self.homed = self.counts_boots = False

    def tick(self, position: float | None = None, missed: int = 0) -> str | None:
        return self.watch.update(
            missed, position, self.speed, driven=self.driven, homed=self.homed, counts_boots=self.counts_boots
        )

    def awaits_proof(self) -> bool:
        return self.watch.known.awaits_proof

    def silent(self, ticks: int) -> list[str | None]:
        return [self.tick() for _ in range(ticks)]


def told_beyond(watched: Watched, allowed: float, ticks: int, place: float = 0.0) -> str:
    """Assert that so much is allowed after so many ticks, both ways, and return what is told of more."""
    for way in (-1.0, 1.0):
        other = Watched()
        other.watch.continue_from(watched.watch)
        other.speed, other.driven = watched.speed, watched.driven
        other.homed, other.counts_boots = watched.homed, watched.counts_boots
        other.silent(ticks - 1)
        assert other.tick(place + way * (allowed - 1e-6)) is None
        assert other.watch.known.beyond == 0
    watched.silent(ticks - 1)
    assert watched.tick(place + allowed + 1e-6) is None  # one is a spike
    reason = watched.tick(place + 10.0 * allowed)
    assert reason is not None
    return reason


# By how much a count may have moved ----------------------------------------------------------------------------------


@pytest.mark.parametrize("ticks", [1, 2, 5, 6, 20])
def test_a_count_may_move_as_fast_as_overspeed_for_a_tick_more_than_it_seems(ticks: int) -> None:
    watched = Watched()
    assert watched.tick(0.0) is None
    allowed = (ticks + 1) * A_TICK + GATE
    reason = told_beyond(watched, allowed, ticks)
    assert reason.startswith(
        f"the encoder's count moved by {10.0 * allowed:+.4g} mm within {10 * (ticks + 1)} ms (longest silence: "
        f"{10 * ticks} ms), more than the {allowed + A_TICK:.4g} mm that axis.limits.overspeed allows"
    )


def test_missed_ticks_are_time_as_well() -> None:
    watched = Watched()
    watched.tick(0.0)
    assert watched.tick(6.0 * A_TICK, missed=4) is None
    assert watched.watch.known.beyond == 0


@pytest.mark.parametrize("resolution", [0.1, 1.0])
def test_steps_of_the_encoder_are_allowed_besides(resolution: float) -> None:
    watched = Watched(resolution)
    watched.tick(0.0)
    assert watched.tick(2.0 * A_TICK + GATE + 2.0 * resolution - 1e-6) is None
    assert watched.watch.known.beyond == 0


def test_a_first_sample_is_no_motion_wherever_it_is() -> None:
    watched = Watched()
    assert watched.silent(100) == [None] * 100
    assert watched.tick(1e6) is None
    assert watched.tick(1e6) is None


def test_after_it_was_told_the_count_goes_on_from_there() -> None:
    watched = Watched()
    watched.tick(0.0)
    watched.tick(100.0)
    assert watched.tick(100.0) is not None
    assert watched.silent(3) == [None] * 3
    assert [watched.tick(100.0) for _ in range(5)] == [None] * 5


def test_two_spikes_with_a_good_sample_between_are_two_spikes() -> None:
    watched = Watched()
    for position in (0.0, 100.0, 0.0, 100.0, 0.0):
        assert watched.tick(position) is None


def test_the_shorter_way_round_a_counter_is_how_far_it_has_moved() -> None:
    watched = Watched(distance=lambda before, now: math.remainder(now - before, 100.0))
    watched.tick(49.0)
    assert [watched.tick(-49.0), watched.tick(-49.0)] == [None, None]
    assert watched.watch.known.place == -49.0


# After a long silence of an axis that was homed ----------------------------------------------------------------------


@pytest.mark.parametrize("driven", [True, False])
@pytest.mark.parametrize("speed", [0.0, 20.0, 30.0])
def test_a_homed_axis_may_coast_from_the_speed_that_it_had(speed: float, *, driven: bool) -> None:
    """At 30 mm/s it goes on for 19 mm while it is driven, which is less than overspeed allows in 60 ms."""
    watched = Watched()
    watched.homed = watched.counts_boots = True
    watched.speed, watched.driven = speed, driven
    watched.tick(0.0)
    range_s = COASTS_S + DRIVEN_S * driven
    reason = told_beyond(watched, speed * range_s + GATE, LONG + 1)
    assert "that a coasting axis can move" in reason
    assert f"(longest silence: {10 * (LONG + 1)} ms), more than the " in reason


@pytest.mark.parametrize(("homed", "silent"), [(False, LONG + 1), (True, LONG)])
def test_otherwise_it_may_have_gone_as_fast_as_overspeed(silent: int, *, homed: bool) -> None:
    watched = Watched()
    watched.homed = homed
    watched.tick(0.0)
    assert "axis.limits.overspeed allows" in told_beyond(watched, (silent + 1) * A_TICK + GATE, silent)


def test_an_axis_that_coasts_for_longer_than_the_silence_was_is_held_to_overspeed() -> None:
    watched = Watched()
    watched.homed = watched.counts_boots = True
    watched.speed = 300.0
    watched.tick(0.0)
    assert "axis.limits.overspeed allows" in told_beyond(watched, (LONG + 2) * A_TICK + GATE, LONG + 1)


@pytest.mark.parametrize(("ticks", "shown"), [(1, 40.0), (2, 20.0)])
def test_the_speed_is_at_least_what_the_samples_show(ticks: int, shown: float) -> None:
    watched = Watched()
    watched.homed = watched.counts_boots = True
    watched.tick(0.0)
    watched.silent(ticks - 1)
    watched.tick(-0.4)
    told_beyond(watched, shown * COASTS_S + GATE, LONG + 1, place=-0.4)


def test_the_speed_is_at_most_overspeed() -> None:
    """In three seconds overspeed allows more than the 42 mm that an axis coasts from it."""
    watched = Watched()
    watched.homed = watched.counts_boots = True
    watched.speed = 1000.0
    watched.tick(0.0)
    told_beyond(watched, 320.0 * COASTS_S + GATE, 300)


# Which silence is a long one -----------------------------------------------------------------------------------------


def test_a_homed_axis_whose_drive_counts_no_boots_is_in_doubt_after_a_long_silence() -> None:
    watched = Watched()
    watched.homed = True
    watched.tick(0.0)
    assert watched.silent(LONG) == [None] * LONG
    reason = watched.tick()
    assert reason is not None
    assert reason.startswith("no feedback came for 60 ms, more than the 50 ms of axis.limits.stale_feedback_ms")
    assert not watched.awaits_proof()


def test_missed_ticks_are_silence() -> None:
    watched = Watched()
    watched.homed = True
    watched.tick(0.0)
    assert watched.tick(missed=LONG - 1) is None
    reason = watched.tick(missed=2)
    assert reason is not None
    assert "for 80 ms" in reason


def test_silence_ends_with_any_sample() -> None:
    watched = Watched()
    watched.homed = True
    watched.tick(0.0)
    for _ in range(4):
        assert watched.silent(LONG - 1) == [None] * (LONG - 1)
        assert watched.tick(0.0) is None


def test_before_the_first_sample_and_without_homing_no_silence_is_long() -> None:
    watched = Watched()
    watched.homed = True
    assert watched.silent(20) == [None] * 20
    other = Watched()
    other.tick(0.0)
    assert other.silent(20) == [None] * 20


def test_where_boots_are_counted_the_next_heartbeat_after_a_sample_is_awaited() -> None:
    watched = Watched()
    watched.homed = watched.counts_boots = True
    watched.tick(0.0)
    watched.silent(LONG)
    assert not watched.awaits_proof()
    assert watched.silent(3) == [None] * 3
    assert watched.awaits_proof()
    watched.watch.confirm_count()  # in the silence it proves nothing
    assert watched.awaits_proof()
    watched.counts_boots = False
    assert watched.tick() is None  # it is awaited all the same
    watched.tick(0.0)
    assert watched.awaits_proof()
    watched.watch.confirm_count()
    assert not watched.awaits_proof()


def test_a_drive_that_says_it_has_booted_is_seen_for_the_first_time() -> None:
    watched = Watched()
    watched.homed = watched.counts_boots = True
    watched.tick(0.0)
    watched.silent(LONG + 1)
    watched.tick(100.0)
    watched.watch.restart()
    assert not watched.awaits_proof()
    assert [watched.tick(500.0), watched.tick(500.0)] == [None, None]
    watched.tick(600.0)
    assert watched.tick(600.0) is not None


# Another origin, other settings --------------------------------------------------------------------------------------


def test_another_origin_moves_the_place() -> None:
    watched = Watched()
    watched.watch.shift(50.0)
    watched.tick(0.0)
    watched.watch.shift(100.0)
    assert [watched.tick(100.0), watched.tick(100.0)] == [None, None]
    watched.watch.shift(-100.0)
    watched.tick(50.0)
    reason = watched.tick(50.0)
    assert reason is not None
    assert "moved by +50 mm" in reason


def test_another_watch_goes_on_where_the_former_was() -> None:
    former = Watched()
    former.homed, former.speed, former.driven = True, 20.0, True
    former.tick(0.0)
    former.silent(LONG + 1)
    former.tick(100.0)
    former.silent(2)
    watched = Watched()
    watched.watch.continue_from(former.watch)
    watched.homed = True
    reason = watched.tick(100.0)
    assert reason is not None
    assert "moved by +100 mm within 100 ms (longest silence: 70 ms)" in reason
    assert f"more than the {20.0 * (COASTS_S + DRIVEN_S) + GATE:.4g} mm" in reason


# Samples that are older than others ----------------------------------------------------------------------------------


def aged(watched: Watched, position: float, age_s: float, missed: int = 0) -> str | None:
    return watched.watch.update(
        missed, position, watched.speed, driven=watched.driven, homed=watched.homed,
        counts_boots=watched.counts_boots, age_s=age_s,
    )  # fmt: skip


@pytest.mark.parametrize("homed", [True, False])
def test_the_time_since_an_old_sample_counts_from_its_own_date(*, homed: bool) -> None:
    """The answer to the last command before 1 s in which the service stood still, and then what the drive says now."""
    watched = Watched()
    watched.homed = watched.counts_boots = watched.driven = homed
    watched.speed = 100.0
    for place in (0.0, 1.0):
        assert aged(watched, place, 0.009) is None
    assert aged(watched, 2.0, 0.999, missed=99) is None
    allowed = 100.0 * (COASTS_S + DRIVEN_S) + GATE if homed else 101 * A_TICK + GATE
    within = Watched()
    within.watch.continue_from(watched.watch)
    within.homed = within.counts_boots = homed
    assert aged(within, 2.0 + allowed - 1e-6, 0.009) is None
    assert within.watch.known.beyond == 0
    assert aged(watched, 2.0 + 2.0 * allowed, 0.009) is None
    reason = aged(watched, 2.0 + 2.0 * allowed, 0.009)
    assert reason is not None
    assert "within 1010 ms (longest silence: 1000 ms)" in reason


def test_a_sample_without_a_date_is_as_old_as_the_one_before() -> None:
    watched = Watched()
    aged(watched, 0.0, 0.5)
    assert "within 20 ms" in told_beyond(watched, 2.0 * A_TICK + GATE, 1)


def test_a_sample_that_is_older_than_the_one_before_makes_no_bound_tighter() -> None:
    watched = Watched()
    aged(watched, 0.0, 0.0)
    assert aged(watched, 2.0 * A_TICK, 0.5) is None
    assert watched.watch.known.beyond == 0
