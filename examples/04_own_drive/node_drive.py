"""A drive that no DBC describes: it has a node number, and obeys nothing before it has been started.

``pip install ./examples/04_own_drive``, then ``twostage-servo demo --set protocol.type=node --set protocol.node=5``.
"""

import struct
from collections.abc import Sequence
from typing import Any

from twostage_servo.axis.messages import Command, DriveTraits, Feedback, ForeignCommand
from twostage_servo.canbus.bus_load import CyclicFrame
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.drives.frame import FrameRejected, ReceivedFrame, SentFrame
from twostage_servo.drives.registry import DriveType
from twostage_servo.drives.settings import DriveSettings
from twostage_servo.drives.start_up import StartUpStep
from twostage_servo.settings.base import quantity

COMMAND, FEEDBACK = struct.Struct("<h?"), struct.Struct("<iB?B")  # mV, enable; µm, counter, enabled, fault
START, RUNNING = Identifier(0x000, extended=False), b"\x05"


class NodeSettings(DriveSettings):
    node: int = quantity(unit="1", description="Number of the drive's node", ge=1, le=127)


class NodeDrive:
    traits = DriveTraits(counter_modulus=256, position_quantum=1e-3, effort_limit=32.0, effort_quantum=1e-3)
    dead_host = "by a time-out of 100 ms, which cannot be switched off"

    def __init__(self, node: int) -> None:
        numbers = (base + node for base in (0x180, 0x200, 0x700))
        self.feedback_id, self.command_id, self.state_id = (Identifier(one, extended=False) for one in numbers)
        self.start = bytes((1, node))
        failure = f"node {node} does not start: look at protocol.node and the drive's supply"
        self.start_up = (StartUpStep((SentFrame(START, self.start),), self.is_running, 0.1, 3, failure),)
        self.obeyed = (self.command_id,)
        self.decoders = {self.feedback_id: read, self.state_id: lambda _: None, self.command_id: read_foreign}

    def is_running(self, frame: ReceivedFrame) -> bool:
        return frame.arbitration_id == self.state_id.identifier and frame.data == RUNNING

    def encode(self, command: Command) -> Sequence[SentFrame]:
        return (SentFrame(self.command_id, COMMAND.pack(round(1e3 * command.effort), command.enable or False)),)

    def cyclic_frames(self, tick_s: float, _: float) -> Sequence[CyclicFrame]:
        return CyclicFrame("command", 3, False, tick_s), CyclicFrame("feedback", 7, False, tick_s)


def unpack(layout: struct.Struct, frame: ReceivedFrame) -> tuple[Any, ...]:
    if len(frame.data) != layout.size:
        raise FrameRejected("length", frame, f"it should have {layout.size} bytes")
    return layout.unpack(frame.data)


def read(frame: ReceivedFrame) -> Feedback:
    counts, counter, enabled, fault = unpack(FEEDBACK, frame)
    return Feedback(1e-3 * counts, counter, enabled, fault_code=fault)


def read_foreign(frame: ReceivedFrame) -> ForeignCommand:
    return ForeignCommand(f"[{frame.data.hex(' ')}]", None, "not read")


class NodeSide:
    """The drive's own end, for the simulated drive; it is silent until it has been started."""

    has_heartbeat = has_index = False

    def __init__(self, drive: NodeDrive) -> None:
        self._drive, self._runs, self._answers = drive, False, [SentFrame(drive.state_id, RUNNING)]
        self.identifiers = (drive.command_id, START)

    def decode(self, frame: ReceivedFrame) -> Command | None:
        if frame.arbitration_id == START.identifier:
            self._runs = self._runs or frame.data == self._drive.start
            return None
        effort, enable = unpack(COMMAND, frame)
        return Command(1e-3 * effort, enable) if self._runs else None

    def answers(self) -> Sequence[SentFrame]:
        answers, self._answers = (self._answers, []) if self._runs else ([], self._answers)
        return answers

    def feedback(self, report: Feedback) -> Sequence[SentFrame]:
        counts, counter = round(1e3 * report.position), (report.counter or 0) % 256
        data = FEEDBACK.pack(counts, counter, report.enabled or False, report.fault_code or 0)
        return (SentFrame(self._drive.feedback_id, data),) if self._runs else ()

    def nothing(self, _: object) -> Sequence[SentFrame]:
        return ()

    index = heartbeat = nothing


DRIVE = DriveType(NodeSettings, lambda settings, *_: NodeDrive(settings.node), NodeSide)
