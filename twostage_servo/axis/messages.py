"""What crosses between an axis and its drive: feedback and commands."""

from typing import NamedTuple


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
