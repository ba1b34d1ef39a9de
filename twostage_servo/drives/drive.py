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
"""What a decoded frame can report."""

Decoder: TypeAlias = Callable[[ReceivedFrame], Report | None]
"""Decodes a frame; returns None if it does not concern the axis, or if a later frame completes the report.

Raises :class:`~twostage_servo.drives.frame.FrameRejected` and nothing else, whatever the frame.
"""


class Drive(Protocol):
    """The drive of one axis, as the controller sees it. Its state belongs to this axis only."""

    @property
    def traits(self) -> DriveTraits:
        """What the axis has to know of the drive beforehand."""

    @property
    def feedback_id(self) -> Identifier:
        """Identifier of the frame with the position; a rejected one counts as a feedback error of the axis."""

    @property
    def command_id(self) -> Identifier:
        """Identifier of the frame with the effort."""

    @property
    def decoders(self) -> Mapping[Identifier, Decoder]:
        """The decoder for each identifier that the controller listens to.

        A command to the drive, which only another node can have sent, gives a
        :class:`~twostage_servo.axis.messages.ForeignCommand`.
        """

    @property
    def obeyed(self) -> Collection[Identifier]:
        """Those identifiers that the drive obeys; ignored on a bus that returns a sender's own frames."""

    @property
    def start_up(self) -> Sequence[StartUpStep]:
        """What to send and to expect before the drive can be used; empty for a drive that needs nothing."""

    @property
    def dead_host(self) -> str:
        """The time-out by which the drive stops when the controller has died, and how to set it: ends a sentence."""

    def encode(self, command: Command) -> Sequence[tuple[Identifier, bytes]]:
        """Make the frames of a command: pairs as in :class:`~twostage_servo.drives.frame.SentFrame`, for every tick.

        An effort beyond what its signal carries is saturated.

        Raises
        ------
        ValueError
            When the effort is not finite.
        """

    def cyclic_frames(self, tick_s: float, heartbeat_s: float, /) -> Sequence[CyclicFrame]:
        """Return what controller and drive exchange cyclically, on a tick of so many s.

        A heartbeat is assumed every `heartbeat_s`. Frames that occur once, as in homing or at the start, are left out.
        """


class DriveSide(Protocol):
    """The drive's end of the same frames, for a simulated drive. Its state belongs to this drive only."""

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
        """Return, once, the drive's answers to the frames that were no commands."""

    def feedback(self, feedback: Feedback, /) -> Sequence[SentFrame]:
        """Make the frames that report a feedback; a counter is reduced by its modulus."""

    def index(self, mark: IndexMark, /) -> Sequence[SentFrame]:
        """Make the frames that report the index mark."""

    def heartbeat(self, heartbeat: Heartbeat, /) -> Sequence[SentFrame]:
        """Make the frames of a heartbeat.

        Its state is numbered as in the shipped DBC: 0 not ready to switch on, 1 ready to switch on, 2 switched on,
        3 operation enabled, 4 fault, 5 fault reaction active, 6 quick stop active, 7 switch on disabled. The simulated
        drive is in 1, 3, 4 or 7. Translate them if your drive has other numbers.
        """
