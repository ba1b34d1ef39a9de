"""What is wrong with the settings of a drive's protocol."""

from twostage_servo.portable_error import PortableError


class ProtocolError(PortableError, ValueError):
    """The protocol settings do not fit the drive, or each other.

    Attributes
    ----------
    key : tuple of str
        Path of the setting in the config, such as ``("protocol", "feedback", "position")``.
    """

    def __init__(self, key: tuple[str, ...], text: str) -> None:
        super().__init__(text)
        self.key = key
