"""What the drive sends, frame by frame, taken to the axis; what can't be used is counted by its reason."""

import asyncio
from typing import TYPE_CHECKING

import can
import structlog

from twostage_servo.axis.drive_states import interpret
from twostage_servo.axis.messages import DriveTraits, Feedback, ForeignCommand, Heartbeat, IndexMark, Reception
from twostage_servo.drives.drive import Decoder
from twostage_servo.drives.frame import FrameRejected, PositionRejected
from twostage_servo.timing.histogram import TimeHistogram
from twostage_servo.timing.ticks import Tick

if TYPE_CHECKING:
    from twostage_servo.axis.axis import Axis
    from twostage_servo.canbus.link import Link

_LATE_PERIODS = 0.5
"""Periods for which a frame may have been there, unread, when the bus was drained before."""
_PATIENCE = 1.02
"""Periods without a command after which the drive may have reported by itself."""


class Receiver:
    """Delivers frames to an axis.

    Parameters
    ----------
    traits
        What is known of the drive.
    feedback_number
        Number of the feedback's identifier.
    period_s
        Length of a tick in s.

    Attributes
    ----------
    sample_age_s
        How long before the present tick's deadline the drive took the command that it answers, in s; None before the
        first command.
    drive_state
        The state that the drive's heartbeat reports; None before the first one.
    frame_age
        How old the feedback frames were when the tick took them, where the bus dates them.
    arrived_s
        When the latest of this tick arrived, on the loop's clock in s; None where nobody knows.
    """

    def __init__(self, traits: DriveTraits, feedback_number: int, period_s: float) -> None:
        self._feedback_number = feedback_number
        self._dated = traits.sampling == "cyclic"
        self.frame_age = TimeHistogram()
        self.arrived_s: float | None = None
        self.sample_age_s: float | None = None
        self._lateness_s = 0.0
        self._period_s = period_s
        self._late = False
        self.drive_state: int | None = None
        # Of a heartbeat without a state, or with states that are not CiA 402's, nothing is known.
        self._states = {value: interpret(text) for value, text in traits.state_texts.items()}
        self._log = structlog.get_logger().bind(room="receiver")

    def begin_tick(self, tick: Tick, sent_s: float | None) -> None:
        """Open a tick; the last command left at `sent_s` on the loop's clock, or None if there was none.

        A command that left late was answered late. If more than a period has passed since, a drive that is used to one
        command a period has reported by itself as well, behind its answer.
        """
        self.arrived_s = None
        self.sample_age_s = None if sent_s is None else tick.deadline_s - sent_s
        self._lateness_s = tick.lateness_s
        self._late = sent_s is not None and tick.deadline_s + tick.lateness_s - sent_s > _PATIENCE * self._period_s

    def deliver(self, decode: Decoder, message: can.Message, axis: "Axis", link: "Link") -> None:
        """Deliver one frame to the axis; a command to the drive that is not ours is a second controller.

        The link that brought it knows its age, and counts what is rejected.
        """
        try:
            report = decode(message)
        except FrameRejected as rejection:
            link.counters.count_rejection(rejection.reason)
            self._log.debug("frame rejected", axis=axis.settings.name, reason=rejection.reason, text=rejection)
            if isinstance(rejection, PositionRejected):
                axis.accept_feedback(rejection.feedback, self._reception(message, link))
            elif message.arbitration_id == self._feedback_number:
                axis.drive.monitor.reject()
            return
        if isinstance(report, Feedback):
            axis.accept_feedback(report, self._reception(message, link))
        elif isinstance(report, Heartbeat):
            self.drive_state = report.state
            state = None if report.state is None else self._states.get(report.state)
            axis.record_heartbeat(report.boot_counter, state, late=self._is_late(message, link))
        elif isinstance(report, IndexMark):
            axis.drive.record_index(report.position)
        elif report is not None:
            _record_foreign(report, axis)

    def forget(self) -> None:
        """Start afresh, as after the bus was lost."""
        self.drive_state = None

    def _is_late(self, message: can.Message, link: "Link") -> bool:
        """Whether a frame has waited behind others, or by its date, so that it does not say how things are now."""
        waited_s = link.waited_s(message)
        return link.is_behind or (waited_s is not None and waited_s > _LATE_PERIODS * self._period_s)

    def _reception(self, message: can.Message, link: "Link") -> Reception:
        """Date a frame of feedback."""
        age_s = link.age_s(message)
        if age_s is not None:
            self.frame_age.add(age_s)
            self.arrived_s = asyncio.get_running_loop().time() - age_s
        if self._dated:
            sampled_s = None if age_s is None else age_s - self._lateness_s
            return Reception(sampled_s, False, self._is_late(message, link))
        return Reception(self.sample_age_s, self._late, self._is_late(message, link))


def _record_foreign(foreign: ForeignCommand, axis: "Axis") -> None:
    """Record a command that is not ours in the axis, with what it asks for as far as that can be read."""
    command = foreign.command
    if command is None:
        axis.record_foreign_command(f"{foreign.frame}, which is not a valid command ({foreign.rejected})")
        return
    enables = command.effort != 0.0 if command.enable is None else command.enable
    unit = axis.settings.effort_unit
    asks = f"commands an effort of {command.effort:.4g} {unit}" if enables else "disables the drive"
    axis.record_foreign_command(f"{foreign.frame}, which {asks}", enables=enables)
