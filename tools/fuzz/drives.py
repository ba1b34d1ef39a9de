"""The drives and axes that the fuzzers use: the shipped one, in several configurations, and some with other DBCs."""

import random
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

from cantools.database import load_file
from cantools.database.can import Database, Message
from pydantic import BaseModel

from twostage_servo.axis.settings import LimitSettings
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.config.loader import Config, LoadedConfig, load
from twostage_servo.drives.dbc.checksum import CHECKSUMS
from twostage_servo.drives.dbc.profile import LARGEST_POSITION, DriveProfile
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.faults.frames import compile_profile, protocol_of

_FOLDER = Path(__file__).parent / "dbc"
_BIG = (1e9, -1e12, 3.4028234e38, -1e300, 1e308, -1.7976931348623157e308)
EXTREMES = (
    *(0.0, -0.0, 5e-324, 1e-9, -1e-3, 0.5, 1.0, -50.0, 250.0, 2499.9, -2500.1, 32767.0, 65535.5, 8388.607, 4294967.295),
    *(2147483.647, -2147483.647, -2147483.648, *_BIG, float("nan"), float("inf"), float("-inf")),
)
"""Values at which something may turn over, end, or lose its last digit."""


@dataclass(frozen=True)
class Kind:
    """One of the drive's messages, as the profile packs it and as its DBC describes it.

    Attributes
    ----------
    name
        ``feedback``, ``command``, ``heartbeat``, ...
    identifier
        Its identifier.
    record
        The tuple that the profile decodes it to.
    encode
        Record to data.
    decode
        Message to record.
    message
        Its description by cantools.
    checksum
        Name of the algorithm and index of its byte, or None.
    signals
        The signals that play a role, by the name of the record's field.
    largest
        Largest magnitude of a position that is believed, in the DBC's unit.
    fd
        Whether it is a CAN FD frame.
    """

    name: str
    identifier: Identifier
    record: Any
    encode: Callable[[Any], bytes]
    decode: Callable[[Any], Any]
    message: Message
    checksum: tuple[str, int] | None
    signals: dict[str, str]
    largest: float
    fd: bool

    def repaired(self, data: bytearray) -> bytearray:
        """Put the right checksum into data of the right length."""
        if self.checksum is not None:
            name, index = self.checksum
            data[index] = CHECKSUMS[name](self.identifier.identifier, data[:index] + data[index + 1 :])
        return data

    def random_data(self, rng: random.Random) -> bytes:
        """Return data as the profile packs a random record; extremes are as likely as ordinary values."""
        for _ in range(20):
            try:
                return self.encode(self.record._make([_random_value(rng, name) for name in self.record._fields]))
            except ValueError:  # not finite, where the signal cannot say so
                continue
        return bytes(self.repaired(bytearray(self.message.length)))

    def of(self, **values: Any) -> bytes:
        """Return data with these values, as far as the drive has them, and nothing in its other signals."""
        return self.encode(self.record._make([values.get(name, 0) for name in self.record._fields]))


def _random_value(rng: random.Random, name: str) -> Any:
    if name in {"position", "effort"}:
        return rng.choice(EXTREMES) if rng.random() < 0.5 else rng.gauss(0.0, 10.0 ** rng.uniform(-3.0, 8.0))
    return rng.choice((0, 0, 1, rng.getrandbits(4), rng.getrandbits(8)))


class Drive:
    """A configuration, compiled when it is first used; services of it are made anew for every run.

    Parameters
    ----------
    name
        For texts.
    overrides
        What is different from the embedded configuration.
    """

    def __init__(self, name: str, overrides: Sequence[str]) -> None:
        self.name = name
        self._overrides = overrides

    @cached_property
    def loaded(self) -> LoadedConfig[Config]:
        """The configuration."""
        return load(None, self._overrides)

    @cached_property
    def profile(self) -> DriveProfile:
        """The compiled protocol, for use outside of a service."""
        return compile_profile(self.loaded)

    @cached_property
    def database(self) -> Database:
        """The DBC, as cantools reads it."""
        dbc = protocol_of(self.loaded.config).dbc
        path = self.loaded.folder / dbc if dbc else Path(str(files("twostage_servo_config"))) / "servo_drive.dbc"
        database = load_file(str(path), strict=False)
        assert isinstance(database, Database)  # noqa: S101 - a DBC is nothing else
        return database

    @cached_property
    def kinds(self) -> dict[str, Kind]:
        """The messages that the drive has, by name: whatever the profile decodes."""
        kinds, profile = {}, self.profile
        for attribute in dir(type(profile)):
            name = attribute.removeprefix("decode_")
            identifier = getattr(profile, f"{name}_id", None)
            if name == attribute or identifier is None:
                continue
            decode, encode = getattr(profile, attribute), getattr(profile, f"encode_{name}")
            record = typing.get_type_hints(decode)["return"]
            table = getattr(protocol_of(self.loaded.config), name)
            message = self.database.get_message_by_name(table.message)
            checksum = getattr(table, "checksum", False)
            roles = {role: getattr(table, role, False) for role in record._fields}
            byte = None
            if isinstance(checksum, str):
                byte = protocol_of(self.loaded.config).checksum, message.get_signal_by_name(checksum).start // 8
            scale = protocol_of(self.loaded.config).feedback.position_scale
            kinds[name] = Kind(
                name, identifier, record, _packer(name, encode), decode, message, byte,
                {role: signal for role, signal in roles.items() if isinstance(signal, str)},
                LARGEST_POSITION / abs(scale), self.loaded.config.bus.fd,
            )  # fmt: skip
        return kinds


def _packer(name: str, encode: Callable[..., bytes]) -> Callable[[Any], bytes]:
    if name != "command":
        return encode
    return lambda record: encode(*record)


def _protocol(**tables: dict[str, object]) -> list[str]:
    """Return overrides of the protocol; roles that are not named are ones that the drive does not have."""
    overrides = []
    for table, field in ProtocolSettings.model_fields.items():
        if not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            continue
        given = tables.get(table, {})
        for key, setting in field.annotation.model_fields.items():
            if key in given:
                value = given[key]
                overrides.append(f"protocol.{table}.{key}={value}")
            elif isinstance(setting.default, str) and "False" in str(setting.annotation):
                overrides.append(f"protocol.{table}.{key}=false")
    return overrides


def _tolerant(*keep: str) -> list[str]:
    """Return overrides that lift the limits at which an axis trips, so that it stays driven whatever it reads.

    But for the time that widens the gate with the speed: dates that are off by so much would hide each change of the
    encoder, and such an axis is refused.
    """
    kept = {"effort", "effort_rate", "stall_effort", "velocity", "acceleration", "quick_stop_deceleration", *keep}
    kept.add("innovation_time_ms")
    overrides = ["axis.arming_timeout_ms=50.0"]
    for name, field in LimitSettings.model_fields.items():
        if name in kept or name.startswith("position"):
            continue
        largest = next((bound.le for bound in field.metadata if hasattr(bound, "le")), None)
        if largest is not None:
            overrides.append(f"axis.limits.{name}={int(largest) if field.annotation is int else float(largest)}")
    return overrides


@cache
def all_drives() -> tuple[Drive, ...]:
    """Return every drive; the shipped configuration first."""
    homing = ("axis.homing.required=true", "axis.homing.travel=1e6", "axis.limits.innovation_gate=100.0")
    ieee_float = (
        f'protocol.dbc="{_FOLDER / "ieee_float.dbc"}"', 'protocol.checksum="xor8"',
        *_protocol(
            feedback={
                "message": "Report", "position": "Place", "enabled": "On", "fault_code": "Cause", "counter": "Count",
                "checksum": "Parity", "position_scale": -0.5,
            },
            command={"message": "Order", "effort": "Force", "enable": "On", "counter": "Count", "checksum": "Parity"},
            index={"message": "Mark", "position": "Place", "checksum": "Parity"},
        ),
    )  # fmt: skip
    double = (
        f'protocol.dbc="{_FOLDER / "double.dbc"}"', 'protocol.checksum="none"',
        *_protocol(
            feedback={"message": "Report", "position": "Place"},
            command={"message": "Order", "effort": "Force", "enable": "On"},
        ),
    )  # fmt: skip
    big_endian = (
        f'protocol.dbc="{_FOLDER / "big_endian.dbc"}"', 'protocol.checksum="sum8"',
        *_protocol(
            feedback={
                "message": "Report", "position": "Place", "enabled": "On", "fault": "Bad", "positive_limit": "Right",
                "negative_limit": "Left", "checksum": "Sum", "sampling": "cyclic",
            },
            command={"message": "Order", "effort": "Force", "enable": "On", "counter": "Count", "checksum": "Sum"},
            heartbeat={"message": "Alive", "state": "Mood", "boot_counter": "Boots"},
        ),
        "protocol.command.constants={ Mode = 4 }",
    )  # fmt: skip
    return (
        Drive("shipped", ()),
        Drive("shipped, tolerant", _tolerant()),
        Drive("shipped, tolerant but for jumps", _tolerant("innovation_gate", "overspeed")),
        Drive("shipped, homing on a switch", (*homing, 'axis.homing.method="switch"')),
        Drive("shipped, homing on a hard stop", (*homing, 'axis.homing.method="hard_stop"')),
        Drive("shipped, homing on the index, tolerant", (*_tolerant(), *homing, 'axis.homing.method="index"')),
        Drive("IEEE float, extended, tolerant", (*ieee_float, *_tolerant())),
        Drive("IEEE float, extended", ieee_float),
        Drive("IEEE double, bare, tolerant", (*double, *_tolerant())),
        Drive("big-endian, cyclic", (*big_endian, 'axis.approach.direction="positive"')),
        Drive("big-endian, cyclic, tolerant", (*big_endian, *_tolerant())),
    )
