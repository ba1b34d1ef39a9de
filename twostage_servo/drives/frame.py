"""Frames as a drive receives and sends them, and the refusal of one that must not be used."""

from typing import NamedTuple, Protocol

from twostage_servo.axis.messages import Feedback
from twostage_servo.canbus.identifier import Identifier


class ReceivedFrame(Protocol):
    """What a drive reads of a frame: those attributes of python-can's ``Message``."""

    @property
    def arbitration_id(self) -> int:
        """The identifier."""

    @property
    def is_extended_id(self) -> bool:
        """Whether the identifier has 29 bits."""

    @property
    def data(self) -> bytearray:
        """The data bytes."""

    @property
    def is_error_frame(self) -> bool:
        """Whether it is an error frame."""

    @property
    def is_remote_frame(self) -> bool:
        """Whether it is a remote frame."""

    @property
    def is_fd(self) -> bool:
        """Whether it is a CAN FD frame."""


class SentFrame(NamedTuple):
    """A frame to be sent."""

    identifier: Identifier
    data: bytes


class FrameRejected(Exception):  # noqa: N818 - not an error of the program: a finding about a frame
    """A frame that must not be used. Its text shows the frame in hexadecimal.

    Attributes
    ----------
    reason : str
        ``"error_frame"``, ``"remote"``, ``"fd"``, ``"extended"``, ``"identifier"``, ``"length"``, ``"checksum"``,
        ``"reserved_value"`` or ``"not_finite"``; a kind of drive may have others.
    """

    def __init__(self, reason: str, message: ReceivedFrame, detail: str) -> None:
        super().__init__(reason, message, detail)
        self.reason = reason
        self._message = message
        self._detail = detail

    def __structlog__(self) -> str:
        """Return the text, for a log that really is written."""
        return str(self)

    def __str__(self) -> str:
        """Return the text. It is put together only here, because a babbling node makes many that nobody reads."""
        identifier = Identifier(self._message.arbitration_id, self._message.is_extended_id)
        return f"frame {identifier} [{self._message.data.hex(' ')}] rejected ({self.reason}): {self._detail}"


class PositionRejected(FrameRejected):
    """A feedback whose position must not be used, though the frame is whole: a drive without encoder still has a state.

    Attributes
    ----------
    feedback : Feedback
        What else the frame says; its position is NaN.
    """

    def __init__(self, reason: str, message: ReceivedFrame, detail: str, feedback: Feedback) -> None:
        super().__init__(reason, message, detail)
        self.feedback = feedback
