"""What the simulated drive counts."""

from dataclasses import dataclass


@dataclass(slots=True)
class DriveCounters:
    """What the drive has seen since it started.

    Attributes
    ----------
    accepted, rejected, stale : int
        Commands taken; malformed, out of range or with a wrong checksum; with the alive counter of the command before.
    lost : int
        Frames that the fault injection took away, in either direction, those that met a booting drive included.
    samples : int
        Positions sampled for feedback, whether the frame then got lost or not.
    command_timeouts : int
        Times the drive disabled itself because commands ceased.
    """

    accepted: int = 0
    rejected: int = 0
    stale: int = 0
    lost: int = 0
    samples: int = 0
    command_timeouts: int = 0
