"""What surrounds the signals of a frame: identifier, length, kind and checksum."""

from typing import Final

from twostage_servo.canbus.identifier import Identifier
from twostage_servo.drives.dbc.checksum import Checksum
from twostage_servo.drives.dbc.message_codec import MessageCodec
from twostage_servo.drives.frame import FrameRejected, ReceivedFrame

_BYTES: Final = tuple(bytes((value,)) for value in range(256))


class Frame:
    """A message on the wire: checks what came in, completes what goes out.

    Parameters
    ----------
    layout
        The compiled message.
    checksum
        Algorithm, with the name of the signal that carries it; None when the message has no checksum.
    identifier
        Identifier, if it is not that of the layout.
    fd
        Whether it is a CAN FD frame.

    Attributes
    ----------
    layout : MessageCodec
        As given.
    identifier : Identifier
        Of the message.

    Raises
    ------
    ValueError
        When the checksum's signal does not fill one whole byte.
    """

    __slots__ = ("_checksum", "_checksum_index", "_checksum_name", "_fd", "_length", "identifier", "layout")

    def __init__(
        self,
        layout: MessageCodec,
        checksum: tuple[Checksum, str] | None = None,
        identifier: Identifier | None = None,
        *,
        fd: bool = False,
    ) -> None:
        self.layout = layout
        self._fd = fd
        self.identifier = identifier or Identifier(layout.identifier, layout.is_extended)
        self._length = layout.length
        self._checksum: Checksum | None = checksum[0] if checksum else None
        self._checksum_name = checksum[1] if checksum else ""
        self._checksum_index = layout.byte_index(checksum[1]) if checksum else 0

    def word(self, message: ReceivedFrame) -> int:
        """Check a received frame and join its bytes to the word.

        Raises
        ------
        FrameRejected
            When it is not this message, or has another kind, length or checksum.
        """
        number, extended = self.identifier
        data = message.data
        if message.is_error_frame:
            raise FrameRejected("error_frame", message, "is an error frame")
        if message.is_remote_frame:
            raise FrameRejected("remote", message, "is a remote frame")
        if message.is_fd != self._fd:
            kinds = ("a classic frame", "a CAN FD frame")
            raise FrameRejected("fd", message, f"is {kinds[message.is_fd]}, {kinds[self._fd]} is expected")
        if message.is_extended_id != extended:
            raise FrameRejected("extended", message, f"its identifier has {11 if extended else 29} bits")
        if message.arbitration_id != number:
            raise FrameRejected("identifier", message, f"{self.layout.name} has identifier {self.identifier}")
        if len(data) != self._length:
            raise FrameRejected("length", message, f"{self.layout.name} has {self._length} bytes, not {len(data)}")
        if self._checksum is not None:
            covered = data[:]
            received = covered.pop(self._checksum_index)
            expected = self._checksum(number, covered)
            if received != expected:
                detail = f"{self._checksum_name} is 0x{received:02x}, computed 0x{expected:02x}"
                raise FrameRejected("checksum", message, detail)
        return self.layout.word(data)

    def data(self, word: int) -> bytes:
        """Split the word into bytes and put the checksum in."""
        data = self.layout.data(word)
        if self._checksum is None:
            return data
        index = self._checksum_index
        before, after = data[:index], data[index + 1 :]
        return before + _BYTES[self._checksum(self.identifier.identifier, before + after)] + after
