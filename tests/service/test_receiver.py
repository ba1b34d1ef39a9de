"""What is heard in frames that are not as they should be."""

import math

import can
import pytest

from tests.service.rig import World, simulate
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.canbus.profile import Feedback, FrameRejected, PositionRejected

NOWHERE = Feedback(math.nan, 0, enabled=True, fault=False, fault_code=0)


@pytest.mark.parametrize(
    ("kind", "reason"), [({"is_extended_id": True}, "extended"), ({"is_remote_frame": True}, "remote")]
)
def test_a_frame_that_only_has_the_number_of_the_command_is_rejected(kind: dict[str, bool], reason: str) -> None:
    async def script(world: World) -> None:
        await world.cruising()
        number = world.station.profile.command_id.identifier
        message = can.Message(arbitration_id=number, **{"is_extended_id": False} | kind)
        world.station.take(message)
        assert world.state() is State.SPEED_STAGE
        assert world.station.port.link.counters.rejected_by_reason[reason] == 1

    simulate(script)


def test_a_command_of_another_length_is_a_second_controller_too() -> None:
    async def script(world: World) -> None:
        await world.cruising()
        number = world.station.profile.command_id.identifier
        world.station.receiver.take(
            can.Message(arbitration_id=number, is_extended_id=False, data=b"1"), world.axis, world.station.port.link
        )
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.FOREIGN_COMMAND
        assert "0x201 [31]" in world.axis.trip.cause

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
        profile, axis = world.station.profile, world.axis
        counter = (axis.drive.monitor._counter or 0) + 1
        whole = Feedback(axis.drive.position or 0.0, counter + 1, enabled=True, fault=False, fault_code=0)
        axis.begin_tick(world.service.statistics.count + 1, 0)
        for feedback in [lost._replace(counter=counter), whole] if good_frame_follows else [lost]:
            world.station.take(
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
        assert world.station.port.link.counters.rejected_by_reason["reserved_value"] == 1

    simulate(script)


def test_a_wrong_checksum_is_not_heard_at_all() -> None:
    async def script(world: World) -> None:
        await world.armed()
        profile = world.station.profile
        data = bytearray(profile.encode_feedback(Feedback(float("nan"), 1, enabled=True, fault=True, fault_code=4)))
        data[-1] ^= 1
        message = can.Message(arbitration_id=profile.feedback_id.identifier, is_extended_id=False, data=data)
        with pytest.raises(FrameRejected) as caught:
            profile.decode_feedback(message)
        assert not isinstance(caught.value, PositionRejected)
        world.station.take(message)
        assert world.axis.drive.fault_code is None

    simulate(script)
