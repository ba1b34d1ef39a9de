"""What crosses between an axis and its drive: the drive's traits, what it reports, and commands."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple


@dataclass(frozen=True, slots=True)
class DriveTraits:
    """What an axis has to know of its drive beforehand. It can be handed to another process.

    Attributes
    ----------
    counter_modulus
        Number of values of the feedback's alive counter; 1 where it has none.
    position_period
        Width in axis unit of the range in which the encoder counts before it comes round to the same count; 0 if it
        does not.
    position_quantum
        Step in which the position is reported, in axis unit; 0 for a floating-point number.
    position_unit
        Unit of the position, as the drive's description gives it; empty where it gives none.
    says_invalid
        Whether the drive can say that a position is invalid.
    effort_limit
        Largest magnitude of the effort that a command carries in both directions.
    effort_quantum
        Step of the effort in a command; 0 for a floating-point number.
    effort_unit
        Unit of the effort, as the drive's description gives it; empty where it gives none.
    sampling
        ``"on_command"`` where a feedback is sampled as the drive takes the command that it answers, ``"cyclic"`` where
        the drive samples at a rhythm of its own, so that a frame's age dates its sample.
    has_heartbeat
        Whether the drive has a heartbeat.
    counts_boots
        Whether the heartbeat counts the drive's boots.
    tells_enabled
        Whether the feedback tells whether the drive is enabled.
    fault_texts, state_texts
        What the codes of faults, and of the heartbeat's states, mean, as far as that is known.
    digest
        Digest of the file that describes the drive, by which another content is known; empty where there is none.
    """

    counter_modulus: int = 1
    position_period: float = 0.0
    position_quantum: float = 0.0
    position_unit: str = ""
    says_invalid: bool = False
    effort_limit: float = math.inf
    effort_quantum: float = 0.0
    effort_unit: str = ""
    sampling: Literal["on_command", "cyclic"] = "on_command"
    has_heartbeat: bool = False
    counts_boots: bool = False
    tells_enabled: bool = True
    fault_texts: Mapping[int, str] = field(default_factory=dict)
    state_texts: Mapping[int, str] = field(default_factory=dict)
    digest: str = ""


class Feedback(NamedTuple):
    """What a drive says of itself, all of it at once, whether it came in one frame or in several.

    None means that the drive has no such signal at all.

    Attributes
    ----------
    position
        Measured position in axis unit, as the encoder counts it; NaN where the drive says that it is invalid.
    counter
        Alive counter.
    enabled
        Whether the drive is enabled.
    fault
        Whether the drive has a fault.
    fault_code
        Which one; 0 for none. Of a drive that has no `fault`, this says whether there is one.
    command_timeout
        Whether the drive has stopped by itself because commands ceased.
    safe_torque_off, positive_limit, negative_limit, home_switch
        Whether these inputs of the drive are active.
    """

    position: float
    counter: int | None = None
    enabled: bool | None = None
    fault: bool | None = None
    fault_code: int | None = None
    command_timeout: bool | None = None
    safe_torque_off: bool | None = None
    positive_limit: bool | None = None
    negative_limit: bool | None = None
    home_switch: bool | None = None


class Reception(NamedTuple):
    """How a frame came to be read, which only who has read it knows.

    Attributes
    ----------
    age_s
        How long before the tick the sample was taken, in s; None: at the instant of the last command.
    unasked
        Whether the drive may have reported by itself, so that a frame before it in the same tick is the answer.
    late
        Whether the frame has waited, unread, for longer than it may: what it says of the drive's state still counts,
        its position is not of now.
    """

    age_s: float | None = None
    unasked: bool = False
    late: bool = False


IN_TIME = Reception()
"""Of a frame that answers the last command, sampled as that arrived, and read at once."""


class Heartbeat(NamedTuple):
    """What a drive's heartbeat says; None where the drive has no such signal.

    Attributes
    ----------
    state
        Number of the state that the drive is in, as its own documents count them; ``DriveTraits.state_texts`` names
        them. States with the names of CiA 402 are compared with the feedback.
    boot_counter
        Count of the drive's boots.
    """

    state: int | None
    boot_counter: int | None


class IndexMark(NamedTuple):
    """Position that the encoder latched at its index mark, in axis unit; no counter where the drive has none."""

    position: float
    counter: int | None


class Command(NamedTuple):
    """What goes to the drive in a tick.

    Attributes
    ----------
    effort
        In effort unit.
    enable
        Whether the drive shall be enabled; None where it has no such signal.
    counter
        Alive counter of the frame that it was read from; None before it is sent.
    """

    effort: float
    enable: bool | None
    counter: int | None = None


NO_EFFORT = Command(0.0, enable=False)


class ForeignCommand(NamedTuple):
    """A command to an axis' drive that somebody else has sent.

    Attributes
    ----------
    frame
        The frame, in hexadecimal.
    command
        What it asks for; None where that cannot be read.
    rejected
        Why it cannot be read; empty where it can.
    """

    frame: str
    command: Command | None
    rejected: str = ""
