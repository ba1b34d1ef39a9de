"""What can go wrong with the simulated drive in mid-run."""

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite


@dataclass(frozen=True, slots=True)
class DriveFaults:
    """Faults of the drive and its axis; without arguments there is none. :meth:`SimulatedDrive.change` sets them.

    Frozen, because each change has to act from its own time on: the drive first advances the plant up to that time.

    Attributes
    ----------
    measure : callable or None
        From the position that the sound encoder measures (noise included, steps not yet) to the one that it reports,
        both in axis units. A frozen, jumping, spiky, turned round, rescaled or drifting encoder is made with it. NaN
        and infinity are reported as the protocol's "position invalid".
    frozen_counter : bool
        Feedback repeats the alive counter of the feedback before.
    ignores_effort : bool
        The drive keeps applying the effort of the moment at which this was set, whenever it is enabled. It still obeys
        Enable.
    fault_code : int
        Not 0: the drive latches this fault and disables itself. It can be cleared once this is 0 again.
    safe_torque_off : bool
        The power stage is off and said to be; the position is still reported. After that the drive, like a rebooted
        one, enables on an edge of Enable only.
    heartbeat_silent : bool
        No heartbeat is sent.
    heartbeat_state : int or None
        The state that the heartbeat reports, whatever it is. None: the true one.
    stays_enabled : bool
        The power stage is on, also if it was off, and follows the effort of each command whatever its Enable; with
        ``ignores_effort`` it goes on with the one that it had. Neither Enable nor the command time-out switches it off;
        a fault, safe torque off and a reboot do.
    effort_while_disabled : float
        Effort that acts while the drive is disabled and says so, effort unit.
    effort_limit : float or None
        Largest magnitude of the effort that really acts, effort unit; not negative. None: whatever is commanded.
    stalled : bool
        The axis stands still at once, and stays there.
    load : float
        Load in addition to that of the settings, effort unit.
    gain_factor, pole_factor : float
        Multiply gain and pole of the true plant.
    coulomb_friction : float or None
        Takes the place of the settings' friction, effort unit.
    positive_limit, negative_limit, home_switch : bool or None
        What the switch reports wherever the axis is. None: what the settings say for its true position.
    """

    measure: Callable[[float], float] | None = None
    frozen_counter: bool = False
    ignores_effort: bool = False
    fault_code: int = 0
    safe_torque_off: bool = False
    heartbeat_silent: bool = False
    heartbeat_state: int | None = None
    stays_enabled: bool = False
    effort_while_disabled: float = 0.0
    effort_limit: float | None = None
    stalled: bool = False
    load: float = 0.0
    gain_factor: float = 1.0
    pole_factor: float = 1.0
    coulomb_friction: float | None = None
    positive_limit: bool | None = None
    negative_limit: bool | None = None
    home_switch: bool | None = None

    def __post_init__(self) -> None:
        if self.effort_limit is not None and not self.effort_limit >= 0.0:
            raise ValueError(f"effort_limit {self.effort_limit}: it limits the magnitude of the effort, set 0 or more")
        if not isfinite(self.load):
            raise ValueError(f"load {self.load}: must be finite")
        if not isfinite(self.effort_while_disabled):
            raise ValueError(f"effort_while_disabled {self.effort_while_disabled}: must be finite")
