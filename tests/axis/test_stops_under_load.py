"""Stops on a host under load: commands and samples are late, ticks are missed, and what has acted goes on acting."""

import random
from dataclasses import dataclass, field

import pytest

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.messages import Command, Feedback, Reception
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode

LATE_SHARE = 0.9
"""Largest share of its period by which a command is late."""


@dataclass
class LoadedRig(AxisRig):
    """A rig whose commands come late, which the drive samples at, and some of whose ticks are missed."""

    chance: random.Random = field(default_factory=lambda: random.Random(1))  # noqa: S311 - not for secrets
    dated: bool = False
    missing: float = 0.0
    acting: float = 0.0
    age_s: float = PERIOD_S

    def part(self, duration_s: float) -> None:
        sampled = self.plant.discretise(duration_s)
        self.position += sampled.a12 * self.velocity + sampled.b1 * self.acting
        self.velocity = sampled.a22 * self.velocity + sampled.b2 * self.acting

    def tick(self, missed: int = 0) -> Command:
        if self.chance.random() < self.missing:
            missed += self.chance.randint(1, 4)
        self.tick_index += 1 + missed
        for _ in range(missed):
            self.part(PERIOD_S)
        self.axis.begin_tick(self.tick_index, missed)
        self.counter = (self.counter + 1) % 16
        age_s = self.age_s if self.dated else None
        self.axis.accept_feedback(Feedback(self.sample, self.counter, self.enabled), Reception(age_s))
        command = self.axis.step()
        self.enabled = command.enable is True
        late_s = PERIOD_S * self.chance.uniform(1e-3, LATE_SHARE)
        self.part(late_s)
        self.sample, self.age_s = self.position, PERIOD_S - late_s
        self.acting = command.effort if command.enable else 0.0
        self.part(PERIOD_S - late_s)
        self.commands.append(command)
        self.states.append(self.axis.state)
        return command


def stopped(seed: int, *, dated: bool, missing: float) -> LoadedRig | None:
    """Return a rig that has just come to rest from a jog; None if the host has made it trip before."""
    settings = axis_settings(missed_ticks=40, stale_feedback_ms=400.0)
    chance = random.Random(seed)  # noqa: S311 - not for secrets
    rig = LoadedRig(
        Axis(design_axis(settings, PERIOD_S), TRAITS),
        chance=chance,
        dated=dated,
    )
    rig.armed()
    rig.missing = missing
    for _ in range(60):
        if rig.axis.trip is None:
            rig.axis.jog(40.0 if seed % 2 else -20.0)
        rig.tick()
    if rig.axis.trip is None:
        rig.axis.stop()
    for _ in range(200):
        if rig.state() is not State.STOPPING:
            break
        rig.tick()
    return rig if rig.state() is State.HOLDING else None


def comes_to_rest(rig: LoadedRig) -> bool:
    for _ in range(30):
        if abs(rig.axis.law.observer.velocity) <= rig.axis.design.rest_velocity:
            return rig.state() is State.HOLDING
        rig.tick()
    return False


@pytest.mark.long
@pytest.mark.parametrize("missing", [0.0, 0.15])
@pytest.mark.parametrize("dated", [False, True])
def test_a_quick_stop_near_rest_does_not_kick_the_axis(*, dated: bool, missing: float) -> None:
    """What late samples leave standing was taken for a speed, and braked at once, by up to 8 V: up to 3.7 mm."""
    tried = 0
    for seed in range(60):
        rig = stopped(seed, dated=dated, missing=missing)
        if rig is None or not comes_to_rest(rig):
            continue
        start, speed = rig.position, abs(rig.velocity)
        first = len(rig.commands)
        rig.axis.raise_trip(TripCode.POSITION_LIMIT, "for the test")
        rig.seconds(1.0)
        tried += 1
        assert max(abs(command.effort) for command in rig.commands[first:]) < 1.5
        assert abs(rig.position - start) < 0.35 + speed * (1.0 / 14.0 + PERIOD_S)
    assert tried > 20


@pytest.mark.parametrize("ticks", range(9))
@pytest.mark.parametrize("quick", [False, True])
def test_an_encoder_that_freezes_in_a_stop_does_not_drive_the_axis_on(ticks: int, *, quick: bool) -> None:
    """Neither by a gain that explains the first still sample, nor by what would hold an axis that stands."""
    rig = AxisRig().cruising(2000.0, 100.0)
    start = rig.position
    rig.axis.stop(quick=quick)
    rig.seconds(ticks * PERIOD_S)
    frozen = rig.sample
    rig.sees = lambda _: frozen
    farthest = 0.0
    for _ in range(150):
        rig.tick()
        farthest = max(farthest, abs(rig.position - start))
    assert farthest < 7.0


@pytest.mark.parametrize(("load", "stops"), [(-4.0, False), (4.0, True), (-1.0, True)])
def test_a_stop_by_the_model_alone_ends_where_a_load_that_it_supposes_would_push_the_axis_on(
    load: float, *, stops: bool
) -> None:
    """There is no such load: at the 2.5 V that a stop behind a still encoder may give, it went 27 mm the other way."""
    rig = AxisRig().cruising(2000.0, 20.0)
    frozen = rig.sample
    rig.sees = lambda _: frozen
    rig.seconds(3 * PERIOD_S)
    rig.axis.raise_trip(TripCode.STALL, "for the test")
    observer = rig.axis.motion.law.observer
    observer.correct(20.0, -load)
    start, braked = rig.position, 0
    for _ in range(300):
        rig.tick()
        braked += rig.state() is State.TRIPPED_QUICK_STOP
    assert rig.state() is State.TRIPPED
    assert abs(rig.position - start) < 2.0
    assert (braked > 0) == stops
