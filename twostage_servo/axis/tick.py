"""The tick of an axis: in which order its parts have their say."""

from twostage_servo.axis.arming import Arming, Obstacles
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.drive_watch import DriveWatch
from twostage_servo.axis.driven_step import DrivenStep
from twostage_servo.axis.jog_timer import JogTimer
from twostage_servo.axis.messages import Command
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.operation import Operation
from twostage_servo.axis.state import DRIVEN, ENABLED, Event, State
from twostage_servo.axis.state_machine import StateMachine
from twostage_servo.axis.trip_latch import TripLatch
from twostage_servo.axis.trips import TripCode


class AxisTick:
    """Opens a tick, and closes it with a command.

    Parameters
    ----------
    design
        The axis.
    machine, drive, motion
        Its state, what its drive reports, and what moves it.
    watch
        What comes from the drive.
    arming, obstacles, jog
        What an axis that is being armed waits for, what is in its way, and how long a jog goes on.
    operation, driven
        What the axis is about, and what it does while it is driven.
    latch
        Where it trips.
    """

    __slots__ = (
        "_arming", "_design", "_drive", "_driven", "_jog", "_latch", "_machine", "_motion", "_obstacles", "_operation",
        "_settings", "_watch",
    )  # fmt: skip

    def __init__(
        self,
        design: AxisDesign,
        machine: StateMachine,
        drive: DriveReport,
        motion: Motion,
        watch: DriveWatch,
        arming: Arming,
        obstacles: Obstacles,
        jog: JogTimer,
        operation: Operation,
        driven: DrivenStep,
        latch: TripLatch,
    ) -> None:
        self._design = design
        self._settings = design.settings
        self._machine = machine
        self._drive = drive
        self._motion = motion
        self._watch = watch
        self._arming = arming
        self._obstacles = obstacles
        self._jog = jog
        self._operation = operation
        self._driven = driven
        self._latch = latch

    def begin(self, tick: int, missed: int, late_s: float = 0.0) -> None:
        """Open a tick.

        Parameters
        ----------
        tick
            Its index.
        missed
            How many were missed just before it.
        late_s
            How long after its own deadline the last command left, in s.
        """
        motion = self._motion
        motion.act_late(min(1.0, max(0.0, late_s / self._design.period_s)))
        self._latch.begin_tick(tick)
        self._watch.begin_tick(missed)
        driven = self._machine.state in DRIVEN
        if missed and driven:
            motion.skip(missed)
        elif missed:
            motion.lose_track()  # it coasts, or is pushed, and nobody has looked
        self._drive.begin_tick(missed, motion.expected_position(driven=driven))
        motion.begin_tick(missed)
        self._jog.begin_tick(missed)
        if driven and missed > self._settings.limits.missed_ticks:
            self._latch.raise_trip(
                TripCode.MISSED_TICKS,
                f"{missed} ticks of {1e3 * self._design.period_s:g} ms were missed in a row; "
                f"axis.limits.missed_ticks is {self._settings.limits.missed_ticks}",
            )

    def step(self) -> Command:
        """Close the tick: run the law, hold the limits, and return what goes to the drive."""
        command = self._decide()
        self._watch.check_count()
        return command

    def _decide(self) -> Command:
        machine, watch = self._machine, self._watch
        was_driven, was_enabled = machine.state in DRIVEN, machine.state in ENABLED
        watch.look_for_troubles()
        watch.check_obedience(told_enabled=was_enabled)
        if machine.state not in DRIVEN:
            self._motion.track()
        if machine.state is State.ARMING:
            self._arming.step()
        self._obstacles.count_tick()
        if machine.state not in DRIVEN or not was_driven:
            return Command(0.0, enable=machine.state in ENABLED)
        if machine.state is State.JOGGING and self._jog.is_over:
            machine.apply(Event.STOP)
            reason = f"the jog was not renewed within {self._settings.jog_timeout_ms:g} ms"
            self._operation.brake(self._settings.limits.acceleration, MoveOutcome.STOPPED, reason, smooth=True)
        return self._driven.step()
