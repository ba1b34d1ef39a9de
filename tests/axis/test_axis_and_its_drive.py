"""What an axis hands on to the watches of its drive, and what it says of one that lasts in a wrong state."""

import math

import pytest

from tests.axis.rig import PERIOD_S, AxisRig, axis_settings, check_what_is_told
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.drive_states import interpret
from twostage_servo.axis.messages import Command, DriveTraits, Feedback
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode

READY = interpret("Ready to switch on")
ENABLED = interpret("Operation enabled")


def axis_of(*, tells_enabled: bool = True, resolution: float = 0.001, innovation_gate: float = 0.5) -> Axis:
    design = design_axis(axis_settings(innovation_gate=innovation_gate), PERIOD_S)
    return Axis(design, DriveTraits(counter_modulus=16, position_quantum=resolution, tells_enabled=tells_enabled))


class Silent(AxisRig):
    """A rig whose drive does not tell whether it is enabled but by the state of its heartbeat."""

    state_told = READY
    every = 10

    def tick(self, missed: int = 0) -> Command:
        self.tick_index += 1 + missed
        self.axis.begin_tick(self.tick_index, missed)
        self.counter = (self.counter + 1) % 16
        self.axis.accept_feedback(Feedback(self.sample, self.counter))
        if self.tick_index % self.every == 0:
            self.axis.record_heartbeat(None, self.state_told)
        command = self.axis.step()
        self.commands.append(command)
        check_what_is_told(self.axis, self.tick_index)
        return command


# A drive that tells its state by its heartbeat alone -----------------------------------------------------------------


def test_a_drive_that_says_it_is_off_while_it_is_told_to_be_enabled_trips() -> None:
    rig = Silent(axis_of(tells_enabled=False)).armed(for_s=0.3)
    rig.seconds(1.0)
    assert list(rig.axis.trips) == [TripCode.DRIVE_STATE_MISMATCH]
    assert (
        "heartbeat has said 'Ready to switch on', but its feedback has said enabled"
        in rig.axis.trips[TripCode.DRIVE_STATE_MISMATCH].cause
    )


def test_one_that_says_that_it_is_enabled_while_it_is_told_to_be_disabled_has_a_heartbeats_time_more() -> None:
    """500 ms to obey and 300 ms until a heartbeat comes for certain, and two ticks for the way to and fro."""
    rig = Silent(axis_of(tells_enabled=False))
    rig.every = 30
    rig.state_told = ENABLED
    ticks = 0
    while rig.state() is State.DISARMED and ticks < 400:
        rig.tick()
        ticks += 1
    assert list(rig.axis.trips) == [TripCode.DRIVE_NOT_DISABLED]
    assert ticks == 90  # the first heartbeat after 82
    assert "disable 890 ms ago, and has since reported for 890 ms" in rig.axis.trips[TripCode.DRIVE_NOT_DISABLED].cause


def test_only_a_drive_that_is_told_to_disable_is_disabling() -> None:
    rig = AxisRig().armed()
    assert rig.enabled
    assert [rig.axis.is_disabling] == [False]
    rig.axis.disarm()
    rig.enabled = True
    rig.tick()
    assert [rig.axis.is_disabling] == [True]
    rig.seconds(0.1)
    assert [rig.axis.is_disabling] == [False]


# Arming --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("enables", "why"), [(False, "the drive did not report that it is enabled"), (True, "the speed is unknown")]
)
def test_what_arming_has_waited_for_is_told(enables: bool, why: str) -> None:
    rig = AxisRig(enables=enables).seconds(0.1)
    rig.axis.arm()
    for _ in range(60):
        rig.tick(missed=int(enables))
    assert rig.axis.trip is not None
    assert rig.axis.trip.code is TripCode.DRIVE_NOT_ENABLED
    assert rig.axis.trip.cause.startswith(why)
    assert rig.axis.trip.cause.endswith("within 500 ms of arming")


# Somebody else's commands --------------------------------------------------------------------------------------------


def test_a_command_of_somebody_else_lasts_with_its_frame_and_tick_without_a_trip() -> None:
    rig = AxisRig().seconds(0.1)
    assert not rig.axis.lasting
    rig.axis.record_foreign_command("0x201 enables", enables=True)
    rig.tick()
    (told,) = rig.axis.lasting
    assert (told.code, told.tick) == (TripCode.FOREIGN_COMMAND, rig.tick_index)
    assert told.cause == "another node on the bus commands this drive: 0x201 enables (frame 1, 10 ms ago)"
    assert (rig.axis.trip, rig.axis.hazards) == (None, ())
    rig.seconds(0.6)
    assert not rig.axis.lasting


def test_one_that_trips_is_told_once() -> None:
    rig = AxisRig().seconds(0.1)
    rig.axis.record_foreign_command("0x201", enables=True)
    rig.enabled = True
    rig.tick()
    assert [one.code for one in rig.axis.lasting] == [TripCode.FOREIGN_COMMAND]
    assert rig.axis.hazards == rig.axis.lasting


@pytest.mark.parametrize(("enables", "told"), [(True, True), (None, True), (False, False)])
def test_a_drive_that_does_not_tell_is_taken_to_obey_what_it_has_been_told(enables: bool | None, *, told: bool) -> None:
    rig = Silent(axis_of(tells_enabled=False)).seconds(0.1)
    rig.axis.record_foreign_command("0x201", enables=enables)
    rig.tick()
    assert (TripCode.FOREIGN_COMMAND in rig.axis.trips) is told
    assert [one.code for one in rig.axis.lasting] == [TripCode.FOREIGN_COMMAND]


# What a disabled axis may have moved ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("resolution", "told"), [(0.001, True), (1.0, False)])
def test_a_step_of_a_coarse_encoder_is_no_motion(resolution: float, *, told: bool) -> None:
    rig = AxisRig(axis_of(resolution=resolution)).seconds(1.0)
    rig.position = 0.8
    rig.seconds(0.2)
    assert (rig.axis.disabled.moved is not None) is told


# How far an axis may go unseen ---------------------------------------------------------------------------------------


def test_an_axis_on_a_coarse_encoder_coasts_by_its_speed_and_not_by_the_last_two_samples() -> None:
    """They show the same step of 1 mm; at 40 mm/s it may go 4 mm more, which is more than a sample may be off."""
    rig = AxisRig(axis_of(resolution=1.0, innovation_gate=1.2))
    rig.sees = lambda position: float(math.floor(position))
    rig.seconds(0.1)
    rig.axis.record_heartbeat(7)
    rig.axis.set_position(0.0)

    def carried(distance: float) -> None:
        rig.velocity = 0.0
        rig.position += distance
        rig.sample = rig.sees(rig.position)
        rig.tick()

    for _ in range(62):
        carried(0.4)
    assert rig.sees(rig.position) == rig.sees(rig.position - 0.4) == 24.0
    rig.silent = True
    for _ in range(20):
        carried(4.2 / 20.0)
    rig.silent = False
    rig.seconds(0.1)
    rig.axis.record_heartbeat(7)
    assert rig.axis.reference.lost_because == ""
    rig.silent = True
    for _ in range(20):
        carried(4.2 / 20.0)
    rig.silent = False
    rig.seconds(0.1)
    assert "moved by +5 mm" in rig.axis.reference.lost_because  # as much, from rest


def test_an_axis_that_speeds_up_as_its_bus_is_lost_may_come_to_the_speed_that_it_was_asked_for() -> None:
    """Its drive has the effort of the cruise as its last one, goes on with it for 450 of 500 ms, and coasts then."""
    rig = AxisRig(axis_of()).seconds(0.1)
    rig.axis.record_heartbeat(7)
    rig.axis.set_position(0.0)
    rig.armed().axis.move_to(700.0, 100.0)
    rig.seconds(0.05)
    assert rig.velocity < 40.0
    effort, rig.silent = rig.plant.cruise_effort(100.0), True
    for tick in range(60):
        rig.enabled = False
        rig.tick()
        if tick < 45:
            rig.move(effort)
    assert rig.position > 30.0
    rig.silent, rig.enabled, rig.sample = False, False, rig.position
    rig.seconds(0.1)
    rig.axis.record_heartbeat(7)
    assert rig.axis.reference.lost_because == ""
