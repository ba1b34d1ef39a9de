"""A node that leaves out idle cycles sends the same frames at the same times as one that does not."""

import asyncio
import functools
from typing import Any

import can
import pytest

from twostage_servo.canbus.link import BusSettings, Link
from twostage_servo.drives.dbc.drive_side import DbcDriveSide
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.simulation.bus import Wire
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.simulation.node import DriveNode
from twostage_servo.simulation.settings import SimulationSettings
from twostage_servo.timing.virtual_clock import run

CYCLES = [0]


async def heard(
    profile: DriveProfile, tick_s: float, *, sparse: bool, **settings: Any
) -> list[tuple[float, int, bytes]]:
    """Command a drive on a tick that comes late, rests and goes on; return all that arrives, with its time."""
    loop = asyncio.get_running_loop()
    wire = Wire(loop.time)
    drive = SimulatedDrive(SimulationSettings(**settings), DbcDriveSide(profile), loop.time())
    bus = BusSettings(interface="virtual", channel="x")
    link = Link(bus, [profile.command_id], functools.partial(wire.attach, "drive"))
    place = wire.node("drive")
    cycle_s = drive._settings.cycle_ms / 1e3
    node = DriveNode(drive, link, cycle_s, arrival_s=(lambda: place.next_arrival_s) if sparse else None)
    place.listen(node.wake)
    drive_cycle = drive.cycle

    def counted(now_s: float) -> Any:
        CYCLES[0] += 1
        return drive_cycle(now_s)

    drive.cycle = counted  # type: ignore[method-assign]
    running = asyncio.create_task(node.run())
    controller = wire.attach("controller")
    frames: list[tuple[float, int, bytes]] = []
    for index in range(1, 200):
        late_s = (0.0, 0.37 * tick_s, 0.0, 0.45 * tick_s)[index % 4]
        await asyncio.sleep(max(0.0, index * tick_s + late_s - loop.time()))
        while (frame := controller.recv(0)) is not None:
            frames.append((round(frame.timestamp, 9), frame.arbitration_id, bytes(frame.data)))
        if not 60 <= index < 100:
            data = profile.encode_command(0.01 * index, enable=index > 2, counter=index)
            controller.send(can.Message(arbitration_id=profile.command_id[0], is_extended_id=False, data=data))
        if index == 150:
            drive.reboot(loop.time(), 0.0153)
            node.wake()
    node.stop()
    node.wake()
    await running
    controller.shutdown()
    return frames


@pytest.mark.parametrize(
    ("tick_s", "settings"),
    [
        (0.01, {}),
        (0.01, {"feedback": "cyclic", "feedback_period_ms": 7.0, "cycle_ms": 0.5}),
        (0.002, {"cycle_ms": 1.0, "feedback_period_ms": 2.0}),
        (0.1, {"command_timeout_ms": 1000.0, "feedback_period_ms": 50.0, "delay_ms": 3.0}),
    ],
)
def test_the_frames_are_the_same(profile: DriveProfile, tick_s: float, settings: dict[str, Any]) -> None:
    CYCLES[0] = 0
    every = run(heard(profile, tick_s, sparse=False, **settings))
    dense, CYCLES[0] = CYCLES[0], 0
    some = run(heard(profile, tick_s, sparse=True, **settings))
    assert some == every
    assert len(every) > 150
    assert CYCLES[0] <= dense


def test_idle_cycles_are_left_out(profile: DriveProfile) -> None:
    CYCLES[0] = 0
    run(heard(profile, 0.01, sparse=True))
    assert CYCLES[0] < 700  # of 2,000
