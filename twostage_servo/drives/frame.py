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
    """A frame to be sent.

    Attributes
    ----------
    identifier
        With 11 or 29 bits.
    data
        The data bytes.
    """

    identifier: Identifier
    data: bytes


class FrameRejected(Exception):  # noqa: N818 - not an error of the program: a finding about a frame
    """A frame that must not be used. Its text shows the frame in hexadecimal.

    The service counts it by its reason. One with the identifier of the feedback counts as a feedback error as well.

    Parameters
    ----------
    reason
        In one word; see the attribute.
    message
        The frame.
    detail
        What is wrong with it, for the log.

    Attributes
    ----------
    reason : str
        What ``rejected_by_reason`` in the status counts it as. A drive by its DBC has ``"error_frame"``; ``"remote"``;
        ``"fd"`` (a classic frame where CAN FD is expected, or the reverse); ``"extended"`` (11 bits of identifier where
        29 are expected, or the reverse); ``"identifier"`` (of another message); ``"length"``; ``"checksum"``;
        ``"reserved_value"`` (a value outside the signal's limits, or a state without a name); ``"too_large"`` (a
        position beyond 1e9 axis units); ``"not_finite"``. Another type of drive may have words of its own.
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

    A decoder raises it instead of :class:`FrameRejected`, so that the axis hears of a fault all the same.

    Attributes
    ----------
    feedback : Feedback
        What else the frame says; its position is NaN.
    """

    def __init__(self, reason: str, message: ReceivedFrame, detail: str, feedback: Feedback) -> None:
        super().__init__(reason, message, detail)
        self.feedback = feedback
