"""What goes into and out of an axis: feedback and commands, moves, and refusals to the operator."""

from dataclasses import dataclass
from typing import Literal, NamedTuple


class Refused(Exception):  # noqa: N818 - not a fault of the program: the axis' answer to a request
    """A request that the axis does not carry out; ``code`` is stable, the text is for the operator."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class Feedback(NamedTuple):
    """What one frame says of the drive. None: the drive has no such signal.

    Attributes
    ----------
    position
        Measured position in axis unit, as the encoder counts it.
    counter
        Alive counter.
    enabled
        Whether the drive is enabled.
    fault_code
        Fault code while the drive reports a fault, else None.
    safe_torque_off, positive_limit, negative_limit, home_switch
        Whether these inputs of the drive are active.
    age_s
        How long before the tick the sample was taken, in s; None: at the instant of the last command.
    unasked
        Whether the drive may have reported by itself, so that a frame before it in the same tick is the answer.
    late
        Whether the frame has waited, unread, for longer than it may: what it says of the drive's state still counts,
        its position is not of now.
    faulted
        Whether the drive says that it has a fault.
    """

    position: float
    counter: int | None = None
    enabled: bool | None = None
    fault_code: int | None = None
    safe_torque_off: bool | None = None
    positive_limit: bool | None = None
    negative_limit: bool | None = None
    home_switch: bool | None = None
    age_s: float | None = None
    unasked: bool = False
    late: bool = False
    faulted: bool | None = None


class Command(NamedTuple):
    """What goes to the drive this tick: effort in effort unit, and whether the drive shall be enabled."""

    effort: float
    enable: bool


NO_EFFORT = Command(0.0, enable=False)


@dataclass(slots=True)
class Move:
    """One motion that was asked for, and what became of it.

    Attributes
    ----------
    number
        Counts the moves of an axis.
    kind
        ``move`` to a set-point, ``jog`` or ``home``.
    target, velocity, start
        Set-point (axis unit), speed (axis unit/s), and where the axis was when it was asked for.
    outcome
        ``moving``, ``reached``, ``replaced``, ``stopped`` or ``tripped``.
    reason
        Why it was stopped, if not by the operator's `stop`.
    """

    number: int
    kind: Literal["move", "jog", "home"]
    target: float
    velocity: float
    start: float
    outcome: str = "moving"
    reason: str | None = None
