"""A drive whose frames a DBC file describes, from the controller's end."""

from collections.abc import Mapping, Sequence
from typing import Final

from twostage_servo.axis.messages import Command, Feedback, ForeignCommand, Heartbeat
from twostage_servo.canbus.bus_load import CyclicFrame
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.drive import Decoder
from twostage_servo.drives.frame import FrameRejected, ReceivedFrame
from twostage_servo.drives.start_up import StartUpStep

_NO_START_UP: Final[Sequence[StartUpStep]] = ()
_DEAD_HOST: Final = "by its command time-out, which a DBC does not describe; set it in the drive"


class DbcDrive:
    """A :class:`~twostage_servo.drives.drive.Drive`, made from a compiled profile. It counts its commands.

    Parameters
    ----------
    profile
        The compiled frames.

    Attributes
    ----------
    profile
        As given.
    traits, feedback_id, command_id, decoders, obeyed, start_up, dead_host
        As in :class:`~twostage_servo.drives.drive.Drive`.
    """

    def __init__(self, profile: DriveProfile) -> None:
        self.profile = profile
        self.traits = profile.traits
        self.feedback_id = profile.feedback_id
        self.command_id = profile.command_id
        self.obeyed = (profile.command_id,)
        self.start_up = _NO_START_UP
        self.dead_host = _DEAD_HOST
        self.decoders = self._decoders()
        self._encode_command = profile.encode_command
        self._counter = 0

    def encode(self, command: Command) -> tuple[tuple[Identifier, bytes], ...]:
        """Make the frame of a command.

        Raises
        ------
        ValueError
            When the effort is not finite.
        """
        effort, enable, _ = command
        self._counter = counter = self._counter + 1
        return ((self.command_id, self._encode_command(effort, enable, counter)),)

    def cyclic_frames(self, tick_s: float, heartbeat_s: float) -> list[CyclicFrame]:
        """Return the command, the feedback (each tick, whatever its rhythm), and the heartbeat."""
        profile = self.profile
        command = profile.encode_command(0.0, enable=False, counter=0)
        feedback = profile.encode_feedback(Feedback(0.0))
        frames = [
            CyclicFrame("command", len(command), profile.command_id.extended, tick_s),
            CyclicFrame("feedback", len(feedback), profile.feedback_id.extended, tick_s),
        ]
        if profile.heartbeat_id is not None:
            heartbeat = profile.encode_heartbeat(Heartbeat(0, 0))
            frames.append(CyclicFrame("heartbeat", len(heartbeat), profile.heartbeat_id.extended, heartbeat_s))
        return frames

    def _decoders(self) -> Mapping[Identifier, Decoder]:
        profile = self.profile
        decoders: dict[Identifier, Decoder] = {profile.feedback_id: profile.decode_feedback}
        if profile.index_id is not None:
            decoders[profile.index_id] = profile.decode_index
        if profile.heartbeat_id is not None:
            decoders[profile.heartbeat_id] = profile.decode_heartbeat
        decoders[profile.command_id] = self._foreign
        return decoders

    def _foreign(self, frame: ReceivedFrame) -> ForeignCommand:
        """Read a command that somebody else has sent, as far as the drive would take it for one."""
        if not self.profile.is_command(frame):
            self.profile.decode_command(frame)  # which says what it is instead
        text = f"{self.command_id} [{frame.data.hex(' ')}]"
        try:
            return ForeignCommand(text, self.profile.decode_command(frame))
        except FrameRejected as rejection:
            return ForeignCommand(text, None, rejection.reason)
