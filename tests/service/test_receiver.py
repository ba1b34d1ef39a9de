"""What is heard in frames that are not as they should be."""

import math
from typing import Any, cast

import can
import pytest

from tests.service.rig import BUS, World, simulate
from twostage_servo.axis.messages import DriveTraits, Feedback, Reception
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.canbus.link import Link
from twostage_servo.drives.frame import FrameRejected, PositionRejected
from twostage_servo.service.receiver import Receiver
from twostage_servo.timing.ticks import Tick
from twostage_servo.timing.virtual_clock import run

NOWHERE = Feedback(math.nan, 0, enabled=True, fault=False, fault_code=0)


@pytest.mark.parametrize(
    ("kind", "reason"), [({"is_extended_id": True}, "extended"), ({"is_remote_frame": True}, "remote")]
)
def test_a_frame_that_only_has_the_number_of_the_command_is_rejected(kind: dict[str, bool], reason: str) -> None:
    async def script(world: World) -> None:
        await world.cruising()
        number = world.profile.command_id.identifier
        message = can.Message(arbitration_id=number, **{"is_extended_id": False} | kind)
        world.hear(message)
        assert world.state() is State.SPEED_STAGE
        assert world.axis_loop.bus.link.counters.rejected_by_reason[reason] == 1

    simulate(script)


def test_a_command_of_another_length_is_a_second_controller_too() -> None:
    async def script(world: World) -> None:
        await world.cruising()
        number = world.profile.command_id.identifier
        world.hear(can.Message(arbitration_id=number, is_extended_id=False, data=b"1"))
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.FOREIGN_COMMAND
        assert "0x201 [31]" in world.axis.trip.cause

    simulate(script)


def test_a_frame_goes_by_its_number_so_that_one_of_the_other_kind_is_rejected_and_counted() -> None:
    async def script(world: World) -> None:
        await world.armed()
        errors, link = world.axis.drive.monitor.rejected, world.axis_loop.bus.link
        number, _ = world.profile.feedback_id
        data = world.profile.encode_feedback(Feedback(0.0, 1))
        world.hear(can.Message(arbitration_id=number, is_extended_id=True, data=data))
        assert world.axis.drive.monitor.rejected == errors + 1
        assert link.counters.rejected_by_reason["extended"] == 1
        world.hear(can.Message(arbitration_id=0x701, is_extended_id=False, data=b"\0"))  # a heartbeat has two bytes
        assert world.axis.drive.monitor.rejected == errors + 1
        assert link.counters.rejected_by_reason["length"] == 1

    simulate(script)


@pytest.mark.parametrize("good_frame_follows", [True, False])
@pytest.mark.parametrize(
    ("lost", "code"),
    [
        (NOWHERE._replace(fault=True, fault_code=4), TripCode.DRIVE_FAULT),
        (NOWHERE._replace(safe_torque_off=True), TripCode.SAFE_TORQUE_OFF),
    ],
)
def test_what_a_drive_without_encoder_says_is_heard_in_the_same_tick(
    lost: Feedback, code: TripCode, *, good_frame_follows: bool
) -> None:
    async def script(world: World) -> None:
        await world.cruising()
        profile, axis = world.profile, world.axis
        counter = (axis.drive.monitor._counter or 0) + 1
        whole = Feedback(axis.drive.position or 0.0, counter + 1, enabled=True, fault=False, fault_code=0)
        axis.begin_tick(world.service.statistics.count + 1, 0)
        for feedback in [lost._replace(counter=counter), whole] if good_frame_follows else [lost]:
            world.hear(
                can.Message(
                    arbitration_id=profile.feedback_id.identifier,
                    is_extended_id=False,
                    data=profile.encode_feedback(feedback),
                ),
            )
        command = axis.step()
        assert axis.trip is not None
        assert axis.trip.code is code
        assert (command.effort, command.enable) == (0.0, False)
        assert world.axis_loop.bus.link.counters.rejected_by_reason["reserved_value"] == 1

    simulate(script)


def test_a_wrong_checksum_is_not_heard_at_all() -> None:
    async def script(world: World) -> None:
        await world.armed()
        profile = world.profile
        data = bytearray(profile.encode_feedback(Feedback(float("nan"), 1, enabled=True, fault=True, fault_code=4)))
        data[-1] ^= 1
        message = can.Message(arbitration_id=profile.feedback_id.identifier, is_extended_id=False, data=data)
        with pytest.raises(FrameRejected) as caught:
            profile.decode_feedback(message)
        assert not isinstance(caught.value, PositionRejected)
        world.hear(message)
        assert world.axis.drive.fault_code is None

    simulate(script)


# What a frame means ---------------------------------------------------------------------------------------------------


class TakingAxis:
    """An axis that keeps what it is given."""

    def __init__(self) -> None:
        self.taken: list[tuple[Feedback, Reception]] = []

    def accept_feedback(self, feedback: Feedback, reception: Reception) -> None:
        self.taken.append((feedback, reception))


def received(
    *, dated: bool = False, sent_s: float | None = None, lateness_s: float = 0.0, link: Link | None = None
) -> Reception:
    """Return what an axis is told of how a frame came, in the tick whose deadline is at 1 s."""

    async def take() -> Reception:
        receiver = receiver_of(dated=dated)
        axis = TakingAxis()
        receiver.begin_tick(Tick(100, 1.0, lateness_s, 0), sent_s)
        receiver.deliver(lambda _: HERE, can.Message(), cast("Any", axis), link or Link(BUS, []))
        ((feedback, reception),) = axis.taken
        assert feedback is HERE  # nothing is copied on the way
        return reception

    return run(take())


def receiver_of(*, dated: bool) -> Receiver:
    return Receiver(DriveTraits(sampling="cyclic" if dated else "on_command"), 0x181, 0.01)


HERE = Feedback(12.5, 7, enabled=True, fault=False, fault_code=None)


def test_a_sample_is_as_old_as_the_command_that_it_answers() -> None:
    assert received().age_s is None  # before the first one
    assert received(sent_s=0.9902, lateness_s=0.003).age_s == pytest.approx(0.0098)


@pytest.mark.parametrize(("sent_s", "unasked"), [(None, False), (0.99, False), (0.9899, False), (0.9797, True)])
def test_a_drive_that_was_not_asked_for_longer_than_a_period_may_have_reported_by_itself(
    sent_s: float | None, *, unasked: bool
) -> None:
    assert received(sent_s=sent_s).unasked is unasked
    assert received(sent_s=sent_s, dated=True).unasked is False  # which reports as it likes
    if sent_s is not None:
        assert received(sent_s=sent_s, lateness_s=0.005).unasked is True  # nor had been when this tick began


def test_where_the_bus_dates_its_frames_a_drive_of_its_own_rhythm_is_dated_by_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    link = Link(BUS, [])
    assert received(dated=True, sent_s=0.99, link=link).age_s is None
    monkeypatch.setattr(link, "age_s", lambda _: 0.004)
    assert received(dated=True, sent_s=0.99, lateness_s=0.001, link=link).age_s == pytest.approx(0.003)
    assert received(dated=False, sent_s=0.99, lateness_s=0.001, link=link).age_s == pytest.approx(0.01)


@pytest.mark.parametrize(("waited_s", "late"), [(None, False), (0.0, False), (0.0049, False), (0.0051, True)])
def test_a_frame_that_has_waited_for_more_than_half_a_period_does_not_say_how_things_are_now(
    monkeypatch: pytest.MonkeyPatch, waited_s: float | None, *, late: bool
) -> None:
    link = Link(BUS, [])
    monkeypatch.setattr(link, "waited_s", lambda _: waited_s)
    assert received(link=link).late is late
    link.is_behind = True
    assert received(link=link).late is True


def test_how_old_the_frames_were_and_when_the_latest_came_is_known_where_the_bus_dates_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def take() -> None:
        receiver, axis, link = receiver_of(dated=False), TakingAxis(), Link(BUS, [])
        receiver.begin_tick(Tick(0, 0.0, 0.0, 0), None)
        receiver.deliver(lambda _: HERE, can.Message(), cast("Any", axis), link)
        assert (receiver.arrived_s, receiver.frame_age.count) == (None, 0)
        monkeypatch.setattr(link, "age_s", lambda _: 0.002)
        receiver.deliver(lambda _: HERE, can.Message(), cast("Any", axis), link)
        assert receiver.arrived_s == pytest.approx(-0.002)
        assert receiver.frame_age.largest_us == pytest.approx(2000.0)
        receiver.begin_tick(Tick(1, 0.01, 0.0, 0), 0.0)
        assert receiver.arrived_s is None

    run(take())
