"""The identifier of a CAN frame."""

from typing import NamedTuple


class Identifier(NamedTuple):
    """A CAN identifier with its kind: 0x181 with 11 bits and 0x181 with 29 bits are different identifiers.

    Attributes
    ----------
    identifier
        The number.
    extended
        Whether it has 29 bits.
    """

    identifier: int
    extended: bool

    def __str__(self) -> str:
        """Return hexadecimal digits, 3 for 11 bits and 8 for 29."""
        return f"0x{self.identifier:08X}" if self.extended else f"0x{self.identifier:03X}"
