"""Settings of the drive's protocol: which messages of which DBC, and which signal plays which role."""

from typing import Literal

from pydantic import Field, field_validator

from twostage_servo.drives.settings import DriveSettings
from twostage_servo.settings.base import Settings, quantity

Role = str | Literal[False]
"""Name of a message or signal; ``false`` says that the drive has none."""


class FeedbackSettings(Settings):
    """Message that brings position and status of the drive."""

    message: str = Field("DriveFeedback", description="Message with the feedback")
    position: str = Field("Position", description="Signal with the measured position")
    position_scale: float = quantity(
        1.0,
        unit="axis unit per DBC unit",
        description="Multiplies the position of the DBC; negative reverses the direction",
    )
    enabled: Role = Field("Enabled", description="Signal that is 1 while the drive is enabled; false: none")
    fault: Role = Field("Fault", description="Signal that is 1 while the drive has a fault; false: none")
    fault_code: Role = Field("FaultCode", description="Signal with the code of the fault; false: none")
    command_timeout: Role = Field(
        "CommandTimeout", description="Signal that is 1 after the drive stopped because commands ceased; false: none"
    )
    safe_torque_off: Role = Field(
        "SafeTorqueOff", description="Signal that is 1 while safe torque off is active; false: none"
    )
    positive_limit: Role = Field(
        "PositiveLimit", description="Signal of the limit switch at the end of larger axis positions; false: none"
    )
    negative_limit: Role = Field(
        "NegativeLimit", description="Signal of the limit switch at the end of smaller axis positions; false: none"
    )
    home_switch: Role = Field("HomeSwitch", description="Signal that is 1 while the home switch is active; false: none")
    counter: Role = Field("AliveCounter", description="Signal that counts the feedback frames; false: none")
    checksum: Role = Field("Checksum", description="Signal with the checksum byte; false: none")
    sampling: Literal["on_command", "cyclic"] = Field(
        "on_command",
        description="When the drive samples: as it receives the command that it answers, or on its own clock, so "
        "that the arrival time dates the sample",
    )

    @field_validator("position_scale")
    @classmethod
    def _is_not_zero(cls, value: float) -> float:
        if value == 0.0:
            raise ValueError("must not be 0: the position would always read 0")
        return value


class CommandSettings(Settings):
    """Message that takes the effort to the drive."""

    message: str = Field("DriveCommand", description="Message with the command")
    effort: str = Field("Effort", description="Signal with the effort")
    enable: Role = Field("Enable", description="Signal that is 1 to enable the drive; false: none")
    counter: Role = Field("AliveCounter", description="Signal that counts the command frames; false: none")
    checksum: Role = Field("Checksum", description="Signal with the checksum byte; false: none")
    constants: dict[str, float] = Field(
        default_factory=dict, description="Value of each further signal of the message, in the DBC's unit"
    )


class IndexSettings(Settings):
    """Message that brings the position which the encoder latched at its index mark, for homing."""

    message: Role = Field("DriveIndex", description="Message sent as the encoder passes its index mark; false: none")
    position: str = Field(
        "Position", description="Signal with the position latched at the mark; feedback.position_scale applies"
    )
    counter: Role = Field("AliveCounter", description="Signal that counts the index frames; false: none")
    checksum: Role = Field("Checksum", description="Signal with the checksum byte; false: none")


class HeartbeatSettings(Settings):
    """Message that says which state the drive is in and whether it rebooted."""

    message: Role = Field("DriveHeartbeat", description="Message with the heartbeat; false: none")
    state: Role = Field("State", description="Signal with the state of the drive; false: none")
    boot_counter: Role = Field("BootCounter", description="Signal that changes when the drive boots; false: none")


class ProtocolSettings(DriveSettings):
    """Protocol of the drive; the defaults are those of the shipped ``servo_drive.dbc``."""

    dbc: str = Field(
        "", description="DBC file, relative to the folder of this file; empty: the shipped servo_drive.dbc"
    )
    identifier_offset: int = quantity(
        0,
        unit="1",
        description="Added to the identifiers of the DBC, for example a node number: for drives of one kind on one bus",
        ge=0,
        le=0x1FFFFFFF,
    )
    checksum: Literal["crc8_j1850", "xor8", "sum8", "none"] = Field(
        "crc8_j1850", description="Algorithm of the checksum bytes"
    )
    feedback: FeedbackSettings = Field(FeedbackSettings(), description="Message with position and status")
    command: CommandSettings = Field(CommandSettings(), description="Message with the effort")
    index: IndexSettings = Field(IndexSettings(), description="Message with the latched index position")
    heartbeat: HeartbeatSettings = Field(HeartbeatSettings(), description="Message with the drive's state")
