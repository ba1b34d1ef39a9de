"""From the names in the protocol settings to the compiled messages and signals of the DBC."""

import functools
import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Final, Literal

from cantools.database.can import Database

from twostage_servo.canbus.identifier import Identifier
from twostage_servo.drives.dbc.checksum import CHECKSUMS
from twostage_servo.drives.dbc.frame import Frame
from twostage_servo.drives.dbc.message_codec import MessageCodec
from twostage_servo.drives.dbc.settings import (
    CommandSettings,
    FeedbackSettings,
    HeartbeatSettings,
    IndexSettings,
    ProtocolSettings,
    Role,
)
from twostage_servo.drives.dbc.signal_codec import SignalCodec
from twostage_servo.drives.protocol_error import ProtocolError

_LARGEST_DBC_BYTES: Final = 16_000_000

ABSENT: Final = SignalCodec("", "", 1.0, 0.0, 0.0, {}, decode=lambda word: None, encode=lambda value: 0)  # noqa: ARG005
"""Stands for a signal that the drive does not have: nothing is read, no bit is set."""


class Compiler:
    """Compiles the messages that the settings name, and puts the setting's key to every refusal.

    Parameters
    ----------
    settings
        The protocol settings.
    folder
        Folder that a relative ``dbc`` starts from.
    fd
        Whether the messages go into CAN FD frames.

    Attributes
    ----------
    sampling : str
        When the drive samples its position, see :class:`FeedbackSettings`.
    dbc_digest : str
        Digest of the DBC file's content, by which another content is known.

    Raises
    ------
    ProtocolError
        When the DBC cannot be read, or the checksum roles and the algorithm contradict each other.
    """

    def __init__(self, settings: ProtocolSettings, folder: Path, *, fd: bool = False) -> None:
        self._fd = fd
        self.sampling: Literal["on_command", "cyclic"] = settings.feedback.sampling
        self._settings = settings
        self._database, self._source, self.dbc_digest = _load(settings.dbc, folder)
        tables = ("feedback", "command") if settings.index.message is False else ("feedback", "command", "index")
        named = [table for table in tables if getattr(settings, table).checksum is not False]
        if settings.checksum == "none" and named:
            no_index = " Without an index message, set index.message to false." if named[0] == "index" else ""
            raise ProtocolError(
                ("protocol", named[0], "checksum"),
                f"protocol.checksum is 'none', but {named[0]}.checksum names a signal. "
                f"Name the algorithm, or set it to false if the drive has no checksum.{no_index}",
            )
        if settings.checksum != "none" and not named:
            raise ProtocolError(
                ("protocol", "checksum"),
                f"protocol.checksum is {settings.checksum!r}, but neither "
                f"{' nor '.join(f'{table}.checksum' for table in tables)} names the signal that carries it. "
                "Name it, or set protocol.checksum to 'none'.",
            )

    def feedback(self, axis_unit: str) -> tuple[Frame, dict[str, SignalCodec]]:
        """Compile the feedback message; returns it with the codec of each role, :data:`ABSENT` for ``false``."""
        table = self._settings.feedback
        frame = self._frame("feedback", table.message, table.checksum)
        layout = frame.layout
        position = self._position("feedback", table.position, layout)
        if position.unit not in {"", axis_unit} and table.position_scale == 1.0:
            raise ProtocolError(
                ("axis", "unit"),
                f"{self._source}: {table.position} is in {position.unit!r}, the axis in {axis_unit!r}. "
                f"Set axis.unit to {position.unit!r}, or position_scale to the {axis_unit} per {position.unit}.",
            )
        roles = _roles(
            layout,
            "feedback",
            table,
            flag=(
                "enabled",
                "fault",
                "command_timeout",
                "safe_torque_off",
                "positive_limit",
                "negative_limit",
                "home_switch",
            ),
            count=("fault_code", "counter"),
        )
        return frame, roles | {"position": position}

    def command(self) -> tuple[Frame, dict[str, SignalCodec], int]:
        """Compile the command message; returns it with the codec of each role and the bits of the constant signals."""
        table = self._settings.command
        frame = self._frame("command", table.message, table.checksum)
        layout = frame.layout
        with _key("command", "effort"):
            effort = layout.quantity(table.effort)
            if effort.minimum >= 0.0 or effort.maximum <= 0.0:
                raise ValueError(
                    f"{self._source}, signal {table.effort}: its range {effort.minimum} to {effort.maximum} does not "
                    "include effort of both signs. Name a signed signal or correct its limits in the DBC."
                )
            if effort.decode(effort.encode(0.0)) != 0.0:
                raise ValueError(
                    f"{self._source}, signal {table.effort}: cannot represent 0 exactly, so no command could "
                    "stop the drive. Correct its scale and offset in the DBC."
                )
        roles = _roles(layout, "command", table, flag=("enable",), count=("counter",))
        constants = 0
        for name, value in table.constants.items():
            with _key("command", "constants", name):
                codec = layout.quantity(name)
                if not codec.minimum <= value <= codec.maximum:
                    raise ValueError(
                        f"{name} = {value} is outside {codec.minimum} to {codec.maximum}. Choose a value in the range."
                    )
                constants |= codec.encode(value)
        if layout.unused_signals:
            raise ProtocolError(
                ("protocol", "command", "constants"),
                f"{self._source}, message {table.message}: there is no value to send in "
                f"{', '.join(layout.unused_signals)}. Give each a value under command.constants.",
            )
        return frame, roles | {"effort": effort}, constants

    def index(self, feedback_position: SignalCodec) -> tuple[Frame | None, dict[str, SignalCodec]]:
        """Compile the index message, if there is one; returns it with the codec of each role.

        Both positions come from one counter of the encoder: unit and wrap period must be those of the feedback.
        """
        table = self._settings.index
        if table.message is False:
            return None, {"position": ABSENT, "counter": ABSENT}
        frame = self._frame("index", table.message, table.checksum)
        position = self._position("index", table.position, frame.layout)
        units = (position.unit, feedback_position.unit)
        periods = tuple(f"{codec.period:.15g}" for codec in (position, feedback_position))
        for what, (ours, theirs) in (("unit", units if all(units) else ("", "")), ("wrap period", periods)):
            if ours != theirs:
                raise ProtocolError(
                    ("protocol", "index", "position"),
                    f"{self._source}, message {table.message}, signal {table.position}: its {what} is {ours}, that of "
                    f"the feedback's position {theirs}. Name the latched position of the same encoder, or set "
                    "index.message to false.",
                )
        return frame, _roles(frame.layout, "index", table, flag=(), count=("counter",)) | {"position": position}

    def heartbeat(self) -> tuple[Frame | None, dict[str, SignalCodec]]:
        """Compile the heartbeat message, if there is one; returns it with the codec of each role."""
        table = self._settings.heartbeat
        if table.message is False:
            return None, {"state": ABSENT, "boot_counter": ABSENT}
        frame = self._frame("heartbeat", table.message, False)
        return frame, _roles(frame.layout, "heartbeat", table, flag=(), count=("state", "boot_counter"))

    def _position(self, table: str, name: str, layout: MessageCodec) -> SignalCodec:
        with _key(table, "position"):
            return layout.position(name, self._settings.feedback.position_scale)

    def _frame(self, table: str, message: str, checksum: Role) -> Frame:
        with _key(table, "message"):
            layout = MessageCodec(self._database, message, self._source, fd=self._fd)
        with _key("identifier_offset"):
            identifier = self._shifted(Identifier(layout.identifier, layout.is_extended), message)
        with _key(table, "checksum"):
            algorithm = (CHECKSUMS[self._settings.checksum], checksum) if checksum is not False else None
            return Frame(layout, algorithm, identifier, fd=self._fd)

    def _shifted(self, identifier: Identifier, message: str) -> Identifier:
        shifted = identifier._replace(identifier=identifier.identifier + self._settings.identifier_offset)
        largest = 0x1FFFFFFF if identifier.extended else 0x7FF
        if shifted.identifier > largest:
            raise ValueError(
                f"{self._source}, message {message}: {identifier} with this offset exceeds 0x{largest:X}, the "
                "largest identifier of its kind"
            )
        return shifted


def _load(dbc: str, folder: Path) -> tuple[Database, str, str]:
    path = _dbc_path(dbc, folder)
    try:
        content = _read(path)
        database = _parse(content)
    except Exception as error:  # the parser, too, raises of its own
        raise _unreadable(path, error) from error
    return database, str(path), _digest(content)


def dbc_digest(dbc: str, folder: Path) -> str:
    """Return the digest of the DBC file that settings name, as it is on the disk now.

    Raises
    ------
    ProtocolError
        If it cannot be read.
    """
    path = _dbc_path(dbc, folder)
    try:
        return _digest(_read(path))
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error


def _dbc_path(dbc: str, folder: Path) -> Path | Traversable:
    return folder / dbc if dbc else files("twostage_servo_config") / "servo_drive.dbc"


def _unreadable(path: Path | Traversable, error: Exception) -> ProtocolError:
    return ProtocolError(("protocol", "dbc"), f"cannot read the DBC file {path}: {error}")


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@functools.lru_cache(maxsize=8)
def _parse(content: bytes) -> Database:
    """Parse a DBC file, which takes some 20 ms: once for all axes whose drives are of one kind. Nothing changes it."""
    # cp1252 is the encoding of DBC files. Not strict: a fault in a message that is not used does not matter.
    database = Database(strict=False)
    database.add_dbc_string(content.decode("cp1252"))
    return database


def _read(path: Path | Traversable) -> bytes:
    if not path.is_file():
        raise ValueError("there is no such file" if not path.is_dir() else "this is a folder")
    with path.open("rb") as file:
        content: bytes = file.read(_LARGEST_DBC_BYTES + 1)
    if len(content) > _LARGEST_DBC_BYTES:
        raise ValueError(f"it is larger than {_LARGEST_DBC_BYTES} bytes")
    return content


@contextmanager
def _key(*key: str) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise ProtocolError(("protocol", *key), str(error)) from error


def _roles(
    layout: MessageCodec,
    table: str,
    settings: FeedbackSettings | CommandSettings | IndexSettings | HeartbeatSettings,
    flag: tuple[str, ...],
    count: tuple[str, ...],
) -> dict[str, SignalCodec]:
    kinds: list[tuple[Callable[[str], SignalCodec], tuple[str, ...]]] = [(layout.flag, flag), (layout.count, count)]
    codecs = {}
    for take, roles in kinds:
        for role in roles:
            name = getattr(settings, role)
            with _key(table, role):
                codecs[role] = ABSENT if name is False else take(name)
    return codecs
