"""The drive profile: a drive's protocol, compiled from its DBC, seen from the controller and from the drive."""

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Final, Self

from twostage_servo.axis.messages import Command, DriveTraits, Feedback, Heartbeat, IndexMark
from twostage_servo.drives.dbc.compiler import ABSENT, Compiler
from twostage_servo.drives.dbc.settings import (
    ProtocolSettings,
)
from twostage_servo.drives.dbc.signal_codec import SignalCodec, UndecodableValue
from twostage_servo.drives.frame import FrameRejected, PositionRejected, ReceivedFrame
from twostage_servo.drives.protocol_error import ProtocolError

LARGEST_POSITION: Final = 1e9
"""Largest magnitude of a position that is believed, axis units: what a set-point may be at most."""


class DriveProfile:
    """A compiled protocol: frames to tuples and back, in one or two microseconds. Make one with :meth:`compile`.

    Every ``decode_`` method raises :class:`FrameRejected` and nothing else, whatever the frame. Values beyond what a
    signal can carry are saturated by the ``encode_`` methods, counters are reduced by their modulus. A position
    wraps where its signal has all raw values of its bits, save one that is reserved for "position invalid".

    Attributes
    ----------
    feedback_id, command_id : Identifier
        Identifiers of the two messages.
    index_id, heartbeat_id : Identifier or None
        Identifiers of the index message and of the heartbeat; None when the drive has none.
    traits : DriveTraits
        What an axis has to know of the drive beforehand. The position has a period where it wraps: not as an IEEE
        float, nor in a signal that its DBC limits to less than the range of its bits.
    command_counter_modulus, index_counter_modulus : int
        Number of values of the alive counter of command and index; 1 when there is none.
    boot_counter_modulus : int
        Number of values of the boot counter; 1 when there is none.
    """

    def __init__(self, compiler: Compiler, axis_unit: str) -> None:
        self._feedback, feedback = compiler.feedback(axis_unit)
        self._command, command, self._constants = compiler.command()
        self._index, index = compiler.index(feedback["position"])
        self._heartbeat, heartbeat = compiler.heartbeat()
        frames = (self._feedback, self._command, self._index, self._heartbeat)
        identifiers = [frame.identifier for frame in frames if frame]
        if len(set(identifiers)) < len(identifiers):
            raise ProtocolError(
                ("protocol",),
                "feedback, command, index and heartbeat must be different messages, but have the identifiers "
                f"{', '.join(map(str, identifiers))}. Name a message for each.",
            )
        self.feedback_id = self._feedback.identifier
        self.command_id = self._command.identifier
        self.index_id = self._index.identifier if self._index else None
        self.heartbeat_id = self._heartbeat.identifier if self._heartbeat else None

        self.command_counter_modulus = int(command["counter"].maximum) + 1
        self.index_counter_modulus = int(index["counter"].maximum) + 1
        self.boot_counter_modulus = int(heartbeat["boot_counter"].maximum) + 1
        self.traits = _traits(compiler, feedback, command, heartbeat, has_heartbeat=self._heartbeat is not None)

        # In the order of the tuples' fields. The functions themselves, not their codecs: fewer look-ups a frame.
        self._feedback_decoders = tuple(feedback[role].decode for role in Feedback._fields)
        self._feedback_encoders = tuple(feedback[role].encode for role in Feedback._fields)
        self._command_decoders = tuple(command[role].decode for role in Command._fields)
        self._command_encoders = tuple(command[role].encode for role in Command._fields)
        self._index_decoders = tuple(index[role].decode for role in IndexMark._fields)
        self._index_encoders = tuple(index[role].encode for role in IndexMark._fields)
        self._heartbeat_decoders = tuple(heartbeat[role].decode for role in Heartbeat._fields)
        self._heartbeat_encoders = tuple(heartbeat[role].encode for role in Heartbeat._fields)

    @classmethod
    def compile(cls, settings: ProtocolSettings, folder: Path, axis_unit: str, *, fd: bool = False) -> Self:
        """Compile the protocol that the settings name.

        Parameters
        ----------
        settings
            The protocol settings.
        folder
            Folder of the config file; a relative ``settings.dbc`` starts there.
        axis_unit
            Unit of the axis, compared with the unit that the DBC gives for the position.
        fd
            Whether the frames are CAN FD frames.

        Returns
        -------
        DriveProfile
            The compiled profile.

        Raises
        ------
        ProtocolError
            When settings and DBC do not fit; its ``key`` says which setting to change.
        """
        return cls(Compiler(settings, folder, fd=fd), axis_unit)

    def is_command(self, message: ReceivedFrame) -> bool:
        """Whether the drive would take the frame for a command, as far as its identifier and kind tell."""
        number, extended = self.command_id
        return (
            message.arbitration_id == number
            and message.is_extended_id == extended
            and not (message.is_remote_frame or message.is_error_frame)
        )

    def encode_command(self, effort: float, enable: bool | None, counter: int) -> bytes:
        """Make the data of a command.

        Raises
        ------
        ValueError
            When ``effort`` is not finite.
        """
        encode_effort, encode_enable, encode_counter = self._command_encoders
        return self._command.data(
            self._constants
            | encode_effort(effort)
            | encode_enable(enable or False)
            | encode_counter(counter % self.command_counter_modulus)
        )

    def decode_command(self, message: ReceivedFrame) -> Command:
        """Read a command, as the drive does."""
        word = self._command.word(message)
        try:
            return Command._make([decode(word) for decode in self._command_decoders])
        except UndecodableValue as error:
            raise FrameRejected(error.reason, message, str(error)) from error

    def encode_feedback(self, feedback: Feedback) -> bytes:
        """Make the data of a feedback, as the drive does. None counts as 0, NaN as an invalid position.

        Raises
        ------
        ValueError
            When the position is not finite, and its signal has no raw value for an invalid one.
        """
        if feedback.counter is not None:
            feedback = feedback._replace(counter=feedback.counter % self.traits.counter_modulus)
        return self._feedback.data(_encode(self._feedback_encoders, feedback))

    def decode_feedback(self, message: ReceivedFrame) -> Feedback:
        """Read a feedback; a position beyond :data:`LARGEST_POSITION` is none.

        Raises
        ------
        FrameRejected
            If the frame must not be used; a :class:`PositionRejected`, if all but its position may be.
        """
        word = self._feedback.word(message)
        position, counter, enabled, fault, fault_code, timeout, torque_off, positive, negative, home = (
            self._feedback_decoders
        )
        lost: UndecodableValue | None = None
        try:
            place = position(word)
            _check_position(place)
        except UndecodableValue as error:
            place, lost = math.nan, error
        try:
            feedback = Feedback(
                place,
                counter(word),
                enabled(word),
                fault(word),
                fault_code(word),
                timeout(word),
                torque_off(word),
                positive(word),
                negative(word),
                home(word),
            )
        except UndecodableValue as error:
            raise FrameRejected(error.reason, message, str(error)) from error
        if lost is not None:
            raise PositionRejected(lost.reason, message, str(lost), feedback) from lost
        return feedback

    def encode_index(self, index: IndexMark) -> bytes:
        """Make the data of an index message, as the drive does. None counts as 0, NaN as an invalid position.

        Raises
        ------
        ValueError
            When the drive has no index message, or as in :meth:`encode_feedback`.
        """
        if self._index is None:
            raise ValueError("this drive has no index message: protocol.index.message is false")
        if index.counter is not None:
            index = index._replace(counter=index.counter % self.index_counter_modulus)
        return self._index.data(_encode(self._index_encoders, index))

    def decode_index(self, message: ReceivedFrame) -> IndexMark:
        """Read an index message."""
        if self._index is None:
            raise FrameRejected("identifier", message, "this drive has no index message")
        word = self._index.word(message)
        try:
            index = IndexMark._make([decode(word) for decode in self._index_decoders])
            _check_position(index.position)
        except UndecodableValue as error:
            raise FrameRejected(error.reason, message, str(error)) from error
        return index

    def encode_heartbeat(self, heartbeat: Heartbeat) -> bytes:
        """Make the data of a heartbeat, as the drive does. None counts as 0.

        Raises
        ------
        ValueError
            When the drive has no heartbeat.
        """
        if self._heartbeat is None:
            raise ValueError("this drive has no heartbeat: protocol.heartbeat.message is false")
        if heartbeat.boot_counter is not None:
            heartbeat = heartbeat._replace(boot_counter=heartbeat.boot_counter % self.boot_counter_modulus)
        return self._heartbeat.data(_encode(self._heartbeat_encoders, heartbeat))

    def decode_heartbeat(self, message: ReceivedFrame) -> Heartbeat:
        """Read a heartbeat."""
        if self._heartbeat is None:
            raise FrameRejected("identifier", message, "this drive has no heartbeat")
        word = self._heartbeat.word(message)
        try:
            heartbeat = Heartbeat._make([decode(word) for decode in self._heartbeat_decoders])
        except UndecodableValue as error:
            raise FrameRejected(error.reason, message, str(error)) from error
        if self.traits.state_texts and heartbeat.state not in self.traits.state_texts:
            raise FrameRejected("reserved_value", message, f"state {heartbeat.state} is not in the DBC's value table")
        return heartbeat


def _traits(
    compiler: Compiler,
    feedback: Mapping[str, SignalCodec],
    command: Mapping[str, SignalCodec],
    heartbeat: Mapping[str, SignalCodec],
    *,
    has_heartbeat: bool,
) -> DriveTraits:
    """Say what the codecs of each message's roles come to for an axis."""
    effort, position = command["effort"], feedback["position"]
    return DriveTraits(
        counter_modulus=int(feedback["counter"].maximum) + 1,
        position_period=position.period,
        position_quantum=position.quantum,
        position_unit=position.unit,
        says_invalid=_says_invalid(position),
        effort_limit=min(effort.maximum, -effort.minimum),
        effort_quantum=effort.quantum,
        effort_unit=effort.unit,
        sampling=compiler.sampling,
        has_heartbeat=has_heartbeat,
        counts_boots=heartbeat["boot_counter"] is not ABSENT,
        tells_enabled=feedback["enabled"] is not ABSENT,
        fault_texts=feedback["fault_code"].choices,
        state_texts=heartbeat["state"].choices,
        digest=compiler.dbc_digest,
    )


def _says_invalid(position: SignalCodec) -> bool:
    try:
        position.encode(math.nan)
    except ValueError:
        return False
    return True


def _check_position(position: float) -> None:
    if not -LARGEST_POSITION <= position <= LARGEST_POSITION:
        raise UndecodableValue("too_large", f"the position {position:g} is beyond {LARGEST_POSITION:g}")


def _encode(encoders: Iterable[Callable[[float], int]], values: Iterable[float | None]) -> int:
    word = 0
    for encode, value in zip(encoders, values, strict=True):
        word |= encode(0.0 if value is None else value)
    return word
