"""What the axis knows of its drive: the newest feedback, how old it is, and what it says of the drive's state."""

import math
from collections.abc import Iterator

from twostage_servo.axis.drive_states import DriveState, DriveStateComparison
from twostage_servo.axis.feedback import WINDOW_TICKS, FeedbackMonitor
from twostage_servo.axis.foreign_commands import ForeignCommands
from twostage_servo.axis.heartbeat import Heartbeat
from twostage_servo.axis.messages import IN_TIME, DriveTraits, Feedback, Reception
from twostage_servo.axis.refusals import Obstacle, RefusalCode
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.trips import TripCode
from twostage_servo.axis.unwrapping import Unwrapping


class DriveReport:
    """Keeps the newest fresh feedback of the drive, in positions that count from the axis' own origin.

    Parameters
    ----------
    settings
        Limits and time-outs of the axis.
    period_s
        Length of a tick in s.
    traits
        What is known of the drive beforehand; a heartbeat that it has is missed from the first tick on.

    Attributes
    ----------
    position
        Position of the newest fresh feedback, unwrapped and homed, in axis unit; None before the first and after the
        bus was lost.
    age_s
        How long before its tick that sample was taken, or None: at the instant of the last command.
    enabled
        Whether the drive says it is enabled; None where it does not tell.
    fault_code
        The drive's fault code while it reports a fault, else None.
    faulted
        Whether the drive says that it has a fault; None where it does not tell.
    safe_torque_off, positive_limit, negative_limit, home_switch
        Whether these inputs are active; None where the drive does not tell.
    index
        Position that the drive latched at the encoder's index mark since :meth:`forget_index`, or None.
    encoder
        Which revolution of its encoder this is.
    heartbeat
        Whether the heartbeat comes, and how often the drive has rebooted.
    backlog
        Reads of the bus in a row that came behind others, and of how many frames; None where the last frame was read in
        time.
    fresh
        Whether this tick had fresh feedback.
    told_state
        Whether a frame of this tick has told the drive's state, with or without a position to be used.
    told_present_state
        Whether one has that has not waited for longer than it may, so that it is the state of now.
    monitor
        The alive counter's bookkeeping.
    states
        Whether heartbeat and feedback agree.
    foreign
        What somebody else has told the drive.
    """

    def __init__(self, settings: AxisSettings, period_s: float, traits: DriveTraits) -> None:
        self.monitor = FeedbackMonitor(traits.counter_modulus)
        self.states = DriveStateComparison(settings, period_s)
        self.foreign = ForeignCommands(settings, period_s)
        self.position: float | None = None
        self.age_s: float | None = None
        self.enabled: bool | None = None
        self.fault_code: int | None = None
        self.faulted: bool | None = None
        self.safe_torque_off: bool | None = None
        self.positive_limit: bool | None = None
        self.negative_limit: bool | None = None
        self.home_switch: bool | None = None
        self.index: float | None = None
        self.fresh = False
        self.told_state = self.told_present_state = False
        self._fault_texts = traits.fault_texts
        self._settings = settings
        self._period_ms = 1e3 * period_s
        self.encoder = Unwrapping(settings.limits, period_s, traits.position_period)
        self.heartbeat = Heartbeat(settings, period_s, expected=traits.has_heartbeat)
        self.backlog: tuple[int, int] | None = None
        self._stale_ticks = math.ceil(settings.limits.stale_feedback_ms / self._period_ms)

    def begin_tick(self, missed: int, expected: float | None = None) -> None:
        """Let everything known grow older by this tick and those missed before it.

        ``expected`` is where the axis is by its estimate, in axis unit, to which what the encoder counts is unwrapped;
        without one, the last position has to do.
        """
        self.fresh = self.told_state = self.told_present_state = False
        self.states.begin_tick()
        self.encoder.begin_tick(missed, self.position if expected is None else expected)
        self.monitor.begin_tick(missed)
        self.foreign.begin_tick(missed)
        self.heartbeat.begin_tick(missed)

    # What comes from the drive ---------------------------------------------------------------------------------------

    def accept_feedback(self, feedback: Feedback, reception: Reception = IN_TIME, *, driven: bool = True) -> bool:
        """Record a frame's feedback, if it is new; a fault, drop-out or input of an earlier frame of the tick stays.

        A command time-out of the drive is a fault only while the axis is driven: elsewhere no command is needed.

        Returns
        -------
        bool
            Whether the position is still sure: False where the axis has not been seen for so long that it may have
            gone half a revolution of its encoder or more, so that unwrapping is ambiguous.
        """
        if not math.isfinite(feedback.position):
            self.monitor.reject()
            self._record_state(feedback, reception.late, driven)  # a drive that has lost its encoder may say why
            return True
        age_s, unasked, late = reception
        if not self.monitor.accept(feedback.counter, late=late):
            return True
        if late:
            self._record_state(feedback, late, driven)
            return True
        self.backlog = None
        again = self.fresh
        self.fresh = True
        position, sure = self.encoder.unwrap(feedback.position)
        if not (again and unasked):
            self.position, self.age_s = position, age_s
        self._record_state(feedback, late, driven)
        return sure

    def _record_state(self, feedback: Feedback, late: bool, driven: bool) -> None:
        again, self.told_state = self.told_state, True
        self.told_present_state = self.told_present_state or not late
        code, timed_out = feedback.fault_code, feedback.command_timeout
        faulted = code != 0 if feedback.fault is None and code is not None else feedback.fault
        fault_code = (code or 0) if faulted or (timed_out and driven) else None
        if timed_out and not faulted:  # alone it says nothing of other faults
            faulted = None
        # Written out: a loop over their names took three times as long, on every axis and tick.
        if not again:
            self.enabled, self.faulted, self.fault_code = feedback.enabled, faulted, fault_code
            self.safe_torque_off, self.home_switch = feedback.safe_torque_off, feedback.home_switch
            self.positive_limit, self.negative_limit = feedback.positive_limit, feedback.negative_limit
            return
        # Of several in a tick whatever is wrong in any of them counts.
        self.enabled = False if self.enabled is False else feedback.enabled
        self.fault_code = fault_code if self.fault_code is None else self.fault_code
        self.faulted = self.faulted or faulted
        self.safe_torque_off = self.safe_torque_off or feedback.safe_torque_off
        self.positive_limit = self.positive_limit or feedback.positive_limit
        self.negative_limit = self.negative_limit or feedback.negative_limit
        self.home_switch = self.home_switch or feedback.home_switch

    def record_index(self, position: float) -> None:
        """Record the position that the encoder counted at its index mark, in axis unit."""
        if math.isfinite(position):
            self.index = self.encoder.position(position)

    def record_backlog(self, reads: int, frames: int) -> None:
        """Remember how many reads of the bus in a row came behind one that ended at its bound of so many frames."""
        self.backlog = reads, frames

    def record_heartbeat(
        self, boot_counter: int | None, state: DriveState | None = None, *, late: bool = False
    ) -> bool:
        """Record a heartbeat with what its state claims; return whether the drive has booted since the last one.

        A late one is no sign of life, and says nothing of the present state.
        """
        if not late:
            self.states.record(state)
        return self.heartbeat.record(boot_counter, late=late)

    def forget(self) -> None:
        """Start afresh, as after the bus was lost; wraps are counted on from where the axis was last seen."""
        self.monitor.forget()
        self.backlog = None
        self.position = self.enabled = self.fault_code = self.faulted = self.age_s = None
        self.safe_torque_off = self.positive_limit = self.negative_limit = self.home_switch = None
        self.heartbeat.forget()
        self.states.forget()

    def continue_from(self, former: "DriveReport") -> None:
        """Continue from a former report of the same drive: settings may change, the drive and its place do not."""
        self.monitor = former.monitor
        self.encoder.continue_from(former.encoder)
        self.heartbeat.continue_from(former.heartbeat)
        self.backlog = former.backlog
        self.position, self.age_s, self.index = former.position, former.age_s, former.index
        self.enabled, self.fault_code, self.faulted = former.enabled, former.fault_code, former.faulted
        self.safe_torque_off, self.home_switch = former.safe_torque_off, former.home_switch
        self.positive_limit, self.negative_limit = former.positive_limit, former.negative_limit
        self.states.continue_from(former.states)
        self.foreign.continue_from(former.foreign)

    def forget_index(self) -> None:
        """Wait for the index mark anew."""
        self.index = None

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self.encoder.shift(distance)
        if self.position is not None:
            self.position += distance

    def compare_states(self, missed: int, *, told_enabled: bool) -> None:
        """Compare heartbeat and feedback, once a tick, before which so many were missed."""
        self.states.compare(
            missed, self.enabled, self.faulted, has_reported=self.told_present_state, told_enabled=told_enabled
        )

    # What follows from it --------------------------------------------------------------------------------------------

    @property
    def boots(self) -> int:
        """How often the drive has rebooted since the first heartbeat."""
        return self.heartbeat.state.boots

    @property
    def counts_boots(self) -> bool:
        """Whether the drive has told its count of boots."""
        return self.heartbeat.state.boot_counter is not None

    @property
    def enabled_report(self) -> bool | None:
        """Whether the drive has said in this tick that it is enabled; None if it has said nothing of it.

        A drive whose feedback does not tell may say so by its heartbeat.
        """
        if self.enabled is not None:
            return self.enabled if self.told_present_state else None
        return None if self.states.new is None else self.states.new.enabled

    @property
    def is_stale(self) -> bool:
        """Whether the last fresh feedback is as old as the limit, or there has been none."""
        age = self.monitor.ticks_since_fresh
        return age is None or age >= self._stale_ticks

    @property
    def is_recent(self) -> bool:
        """Whether no sample is missing: the next one is not due yet, by the time between the last two, or only just.

        So it holds for a drive that sends less often than the axis ticks. Where a sample is missing, the axis may have
        been pushed elsewhere, unseen.
        """
        age = self.monitor.ticks_since_fresh
        return age is not None and age < max(2, self.monitor.ticks_between_fresh)

    def blocks(self, direction: float) -> str | None:
        """Return the name of the limit switch that forbids motion in a direction (its sign counts), or None."""
        if direction > 0.0 and self.positive_limit:
            return "positive"
        if direction < 0.0 and self.negative_limit:
            return "negative"
        return None

    def troubles(self, *, arming: bool) -> Iterator[tuple[TripCode, str]]:
        """Yield code and cause of what must trip an enabled axis."""
        limits = self._settings.limits
        if self.safe_torque_off:
            yield TripCode.SAFE_TORQUE_OFF, "the drive reports that safe torque off is active"
        if self.fault_code is not None:
            yield TripCode.DRIVE_FAULT, f"the drive reports {self._fault_text(self.fault_code)}"
        if self.enabled is False and not arming:
            yield TripCode.DRIVE_DROPPED_OUT, "the drive reports that it is no longer enabled"
        if loss := self.heartbeat.loss:
            yield TripCode.HEARTBEAT_LOST, loss
        if self.is_stale:
            yield (
                TripCode.STALE_FEEDBACK,
                (
                    f"no fresh feedback from the drive for {self._period_ms * (self.monitor.ticks_since_fresh or 0):g} "
                    f"ms; axis.limits.stale_feedback_ms is {limits.stale_feedback_ms:g}{self._why_late()}"
                ),
            )
        if (errors := self.monitor.recent_errors) >= limits.feedback_errors:
            yield (
                TripCode.FEEDBACK_ERRORS,
                (
                    f"{errors} feedback frames were lost, corrupted, repeated, out of order or implausible in the last "
                    f"{WINDOW_TICKS} ticks; axis.limits.feedback_errors is {limits.feedback_errors}"
                ),
            )

    def obstacle_to_arming(self) -> Obstacle | None:
        """Return code and text of what on the drive's side keeps the axis from being armed, or None."""
        if self.position is None or self.is_stale:
            return (
                RefusalCode.NO_FEEDBACK,
                (
                    "there is no fresh feedback from the drive: check its supply, its bus and its identifiers"
                    f"{self._why_late()}."
                ),
            )
        if self.foreign.lasts:
            text = f"another node on the bus commands this drive: {self.foreign}. End the other service or tool first."
            return RefusalCode.FOREIGN_COMMAND, text
        if self.enabled is True:
            return RefusalCode.STILL_ENABLED, "the drive is not disabled yet: try again."
        if self.heartbeat.is_awaited:
            return (
                RefusalCode.HEARTBEAT_LOST,
                "no heartbeat has come from the drive yet: try again, or set protocol.heartbeat.message to false.",
            )
        trouble = next(self.troubles(arming=True), None)
        return None if trouble is None else (RefusalCode(trouble[0]), f"{trouble[1]}: remove its cause first.")

    def _fault_text(self, code: int) -> str:
        text = self._fault_texts.get(code)
        return f"fault code {code}" + (f" ({text})" if text else "")

    def _why_late(self) -> str:
        """Return the end of a sentence that says what came too late to count, if anything did."""
        late = self.monitor.late_since_fresh
        if self.backlog is not None:
            reads, frames = self.backlog
            return (
                f"; frames arrive faster than they are read: the last {reads} reads each began with a backlog, because "
                f"the read before stopped at {frames} frames (bus.max_frames_per_tick), so the age of their {late} "
                "feedback frames is unknown"
            )
        return f"; {late} feedback frames arrived too late to count" if late else ""
