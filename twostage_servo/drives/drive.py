"""What a drive is to an axis: frames to reports, commands to frames, and what is known of it beforehand.

Pure: bytes in, reports out, and the way back. No bus, no clock; a drive may remember what its frames have said.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Protocol, TypeAlias

from twostage_servo.axis.messages import Command, DriveTraits, Feedback, ForeignCommand, Heartbeat, IndexMark
from twostage_servo.canbus.bus_load import CyclicFrame
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.drives.frame import ReceivedFrame, SentFrame
from twostage_servo.drives.start_up import StartUpStep

Report: TypeAlias = Feedback | Heartbeat | IndexMark | ForeignCommand
"""What one frame comes to."""

Decoder: TypeAlias = Callable[[ReceivedFrame], Report | None]
"""Reads a frame; None where it says nothing to the axis.

Raises :class:`~twostage_servo.drives.frame.FrameRejected` and nothing else, whatever the frame.
"""


class Drive(Protocol):
    """One axis' drive, from the controller's end. What it remembers is this axis' alone."""

    @property
    def traits(self) -> DriveTraits:
        """What the axis has to know of the drive beforehand."""

    @property
    def feedback_id(self) -> Identifier:
        """Identifier of the frame that brings the position."""

    @property
    def command_id(self) -> Identifier:
        """Identifier of the frame that takes the effort."""

    @property
    def decoders(self) -> Mapping[Identifier, Decoder]:
        """Everything that the controller listens to.

        A command to the drive, which only somebody else can have sent, comes to a
        :class:`~twostage_servo.axis.messages.ForeignCommand`.
        """

    @property
    def obeyed(self) -> Collection[Identifier]:
        """Those of them that the drive obeys; not listened to on a bus that brings a sender's own frames back."""

    @property
    def start_up(self) -> Sequence[StartUpStep]:
        """What has to be sent and heard before the drive can be used; empty for a drive that needs nothing."""

    @property
    def dead_host(self) -> str:
        """By which time-out the drive stops when the controller has died, and how it is set: ends a sentence."""

    def encode(self, command: Command) -> Sequence[tuple[Identifier, bytes]]:
        """Make the frames of a command: pairs as in :class:`~twostage_servo.drives.frame.SentFrame`, for every tick.

        An effort beyond what its signal carries is saturated.

        Raises
        ------
        ValueError
            When the effort is not finite.
        """

    def cyclic_frames(self, tick_s: float, heartbeat_s: float, /) -> Sequence[CyclicFrame]:
        """Return what controller and drive exchange for ever, on a tick of so many s.

        A heartbeat is taken to come every `heartbeat_s`. What comes once, as in homing or at the start, is left out.
        """


class DriveSide(Protocol):
    """The drive's own end of the same frames, for a simulated drive. What it remembers is this drive's alone."""

    @property
    def identifiers(self) -> Sequence[Identifier]:
        """What the drive listens to."""

    @property
    def has_heartbeat(self) -> bool:
        """Whether it sends a heartbeat."""

    @property
    def has_index(self) -> bool:
        """Whether it sends a message at the encoder's index mark."""

    def decode(self, frame: ReceivedFrame) -> Command | None:
        """Read a frame as the drive does; None where it is no command.

        Raises
        ------
        FrameRejected
            If the frame must not be used.
        """

    def answers(self) -> Sequence[SentFrame]:
        """Return, once, what the drive has to answer to the frames that were no commands."""

    def feedback(self, feedback: Feedback, /) -> Sequence[SentFrame]:
        """Make the frames that report a feedback; a counter is reduced by its modulus."""

    def index(self, mark: IndexMark, /) -> Sequence[SentFrame]:
        """Make the frames that report the index mark."""

    def heartbeat(self, heartbeat: Heartbeat, /) -> Sequence[SentFrame]:
        """Make the frames of a heartbeat, whose state is numbered as in the shipped DBC."""
