"""A message of a DBC file, compiled to shifts and masks on one integer that holds the whole frame.

The frame is read as one integer, the *word*. A little-endian signal is a run of adjacent bits in the little-endian
word, a big-endian signal a run in the big-endian word; a message that has big-endian signals gets both, the big-endian
one above the other, so that a signal is always ``word >> shift & mask``.
"""

import difflib
from collections.abc import Callable, Iterable
from functools import partial

from cantools.database.can import Database, Message, Signal

from twostage_servo.drives.dbc.signal_codec import SignalCodec, count_codec, flag_codec, position_codec, quantity_codec

_FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)
"""Of CAN FD frames with more than 8 data bytes, ISO 11898-1."""


class MessageCodec:
    """Layout of one message. Every signal can be used for one purpose only.

    Parameters
    ----------
    database
        The loaded DBC.
    name
        Name of the message.
    source
        Path of the DBC file, for error texts.
    fd
        Whether it goes into a CAN FD frame.

    Attributes
    ----------
    name : str
        Name of the message.
    identifier : int
        CAN identifier.
    is_extended : bool
        Whether the identifier has 29 bits.
    length : int
        Number of data bytes.

    Raises
    ------
    ValueError
        When there is no such message, it does not fit the frame, or its signals overlap.
    """

    def __init__(self, database: Database, name: str, source: str, *, fd: bool = False) -> None:
        messages: dict[str, Message] = {message.name: message for message in database.messages}
        if name not in messages:
            raise ValueError(f"{source} has no message {name!r}. {_name_those('messages', name, messages)}")
        message = messages[name]
        self.name: str = name
        self.identifier: int = message.frame_id
        self.is_extended: bool = message.is_extended_frame
        self.length: int = message.length
        self._where = f"{source}, message {name}"
        if self.length > 8 and not fd:
            raise ValueError(
                f"{self._where}: {self.length} bytes need CAN FD. Name a message of at most 8 bytes, or set "
                "bus.fd = true."
            )
        if self.length > 8 and self.length not in _FD_LENGTHS:
            raise ValueError(
                f"{self._where}: no CAN FD frame has {self.length} bytes. Lengths above 8 are "
                f"{', '.join(map(str, _FD_LENGTHS))}."
            )
        try:
            message.refresh(strict=True)
        except Exception as error:  # cantools raises several unrelated types here
            raise ValueError(
                f"{self._where}: {error}. Correct the signals' start bits and lengths in the DBC."
            ) from error
        self._signals: dict[str, Signal] = {signal.name: signal for signal in message.signals}
        self._free = set(self._signals)
        self._has_big_endian = any(signal.byte_order == "big_endian" for signal in message.signals)

    @property
    def unused_signals(self) -> list[str]:
        """Names of the signals that nobody has taken yet, in the order of the DBC."""
        return [name for name in self._signals if name in self._free]

    def word(self, data: bytes | bytearray) -> int:
        """Join the bytes of a frame to the word. ``data`` must have ``length`` bytes."""
        if self._has_big_endian:
            data = data + data[::-1]
        return int.from_bytes(data, "little")

    def data(self, word: int) -> bytes:
        """Split the word into the ``length`` bytes of a frame."""
        length = self.length
        if not self._has_big_endian:
            return word.to_bytes(length, "little")
        both = word.to_bytes(2 * length, "little")
        return bytes(map(int.__or__, both[:length], both[: length - 1 : -1]))

    def quantity(self, name: str, factor: float = 1) -> SignalCodec:
        """Claim a signal that carries a physical quantity, see :func:`quantity_codec`.

        Raises
        ------
        ValueError
            When there is no such signal, it is multiplexed or taken already, or :func:`quantity_codec` refuses it.
        """
        return self._take(name, partial(quantity_codec, factor=factor))

    def position(self, name: str, factor: float = 1) -> SignalCodec:
        """Claim a signal that carries a position, see :func:`position_codec`; raises as :meth:`quantity` does."""
        return self._take(name, partial(position_codec, factor=factor))

    def count(self, name: str) -> SignalCodec:
        """Claim a signal that carries a plain count, see :func:`count_codec`; raises as :meth:`quantity` does."""
        return self._take(name, count_codec)

    def flag(self, name: str) -> SignalCodec:
        """Claim a signal that says yes or no, see :func:`flag_codec`; raises as :meth:`quantity` does."""
        return self._take(name, flag_codec)

    def byte_index(self, name: str) -> int:
        """Return the index of the whole byte that a signal fills.

        Raises
        ------
        ValueError
            When the signal does not fill exactly one byte with a plain count.
        """
        signal, where = self._find(name)
        last_bit = signal.start % 8 == (0 if signal.byte_order == "little_endian" else 7)
        if signal.length != 8 or not last_bit:
            raise ValueError(
                f"{where}: a checksum must fill one whole byte, but this signal has {signal.length} bits from bit "
                f"{signal.start} on. Name another signal or correct the DBC."
            )
        if self.count(name).maximum != 255:
            raise ValueError(f"{where}: a checksum takes all values from 0 to 255. Correct its limits in the DBC.")
        return int(signal.start) // 8

    def _find(self, name: str) -> tuple[Signal, str]:
        if name not in self._signals:
            raise ValueError(f"{self._where} has no signal {name!r}. {_name_those('signals', name, self._signals)}")
        return self._signals[name], f"{self._where}, signal {name}"

    def _take(self, name: str, compile_signal: Callable[[Signal, int, str], SignalCodec]) -> SignalCodec:
        signal, where = self._find(name)
        if name not in self._free:
            raise ValueError(f"{where}: is used for two purposes. Name each signal once.")
        if signal.is_multiplexer or signal.multiplexer_ids:
            raise ValueError(
                f"{where}: is multiplexed, which is not supported: it would be missing from some frames. "
                "Name a signal that every frame carries."
            )
        self._free.remove(name)
        return compile_signal(signal, self._shift(signal), where)

    def _shift(self, signal: Signal) -> int:
        if signal.byte_order == "little_endian":
            return int(signal.start)
        # A DBC gives a big-endian signal's most significant bit: 8 * byte + bit, bit 0 the lowest of its byte.
        byte, bit = divmod(int(signal.start), 8)
        most_significant = 8 * (self.length - 1 - byte) + bit
        return 8 * self.length + most_significant - signal.length + 1


def _name_those(kind: str, name: str, names: Iterable[str]) -> str:
    names = list(names)
    nearest = difflib.get_close_matches(name, names, 1, 0.5)
    advice = f" Did you mean {nearest[0]!r}?" if nearest else ""
    return f"Its {kind}: {', '.join(names) or 'none'}.{advice}"
