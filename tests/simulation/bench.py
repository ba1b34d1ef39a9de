"""A simulated drive on a bench: a controller's end of its bus, at times counted from the start of the drive."""

from typing import Any

import can
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from twostage_servo.axis.messages import Feedback, Heartbeat, IndexMark
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.drives.dbc.drive_side import DbcDriveSide
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.simulation.settings import SimulationSettings

GAIN, POLE = 180.0, 14.0
START_S = 1000.0  # a drive must not rely on a clock that begins at 0


class Bench:
    """A drive, and a controller's end of its bus."""

    def __init__(self, profile: DriveProfile, boot_counter: int = 0, **settings: Any) -> None:
        self.profile = profile
        self.drive = SimulatedDrive(SimulationSettings(**settings), DbcDriveSide(profile), START_S, boot_counter)
        self.counter = 0

    def command(self, at_s: float, effort: float = 0.0, *, enable: bool = True, repeat_counter: bool = False) -> None:
        self.counter += not repeat_counter
        data = self.profile.encode_command(effort, enable, self.counter)
        self.drive.receive(message(self.profile.command_id, data), START_S + at_s)

    def enable(self, at_s: float = 0.0, effort: float = 0.0) -> None:
        self.command(at_s, enable=False)
        self.command(at_s, effort)

    def change(self, at_s: float, **faults: Any) -> None:
        self.drive.change(START_S + at_s, **faults)

    def cycle(self, at_s: float) -> list[Feedback | IndexMark | Heartbeat]:
        return [self.decode(*frame) for frame in self.drive.cycle(START_S + at_s)]

    def feedback(self, at_s: float) -> list[Feedback]:
        return [frame for frame in self.cycle(at_s) if isinstance(frame, Feedback)]

    def index(self, at_s: float) -> list[IndexMark]:
        return [frame for frame in self.cycle(at_s) if isinstance(frame, IndexMark)]

    def decode(self, identifier: Identifier, data: bytes) -> Feedback | IndexMark | Heartbeat:
        if identifier == self.profile.index_id:
            return self.profile.decode_index(message(identifier, data))
        if identifier == self.profile.heartbeat_id:
            return self.profile.decode_heartbeat(message(identifier, data))
        return self.profile.decode_feedback(message(identifier, data))


def message(identifier: Identifier, data: bytes) -> can.Message:
    number, extended = identifier
    return can.Message(arbitration_id=number, is_extended_id=extended, data=data, check=True)


def motion(*phases: tuple[float, float]) -> NDArray[np.float64]:
    """Position and velocity from rest after phases of (duration in s, net effort), by the matrix exponential."""
    state = np.zeros(3)
    generator = np.array([[0.0, 1.0, 0.0], [0.0, -POLE, GAIN], [0.0, 0.0, 0.0]])
    for duration_s, effort in phases:
        state[2] = effort
        state = expm(generator * duration_s) @ state
    return state[:2]
