"""What the drive sends, frame by frame, taken to the axis; what can't be used is counted by its reason."""

import asyncio
from typing import TYPE_CHECKING

import can
import structlog

from twostage_servo.axis.drive_states import interpret
from twostage_servo.axis.messages import Feedback
from twostage_servo.axis.state import DRIVEN
from twostage_servo.drives.dbc.profile import DriveProfile, PositionRejected
from twostage_servo.drives.dbc.profile import Feedback as Reported
from twostage_servo.drives.frame import FrameRejected
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
    """Takes frames to an axis.

    Parameters
    ----------
    profile
        How the drive's frames are packed.
    period_s
        Length of a tick in s.
    dated
        Whether the drive samples at a rhythm of its own, so that a frame's age dates its sample.

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

    def __init__(self, profile: DriveProfile, period_s: float, *, dated: bool) -> None:
        self._profile = profile
        self._dated = dated
        self.frame_age = TimeHistogram()
        self.arrived_s: float | None = None
        self.sample_age_s: float | None = None
        self._lateness_s = 0.0
        self._period_s = period_s
        self._late = False
        self.drive_state: int | None = None
        # Of a heartbeat without a state, or with states that are not CiA 402's, nothing is known.
        self._states = {value: interpret(text) for value, text in profile.traits.state_texts.items()}
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

    def take(self, message: can.Message, axis: "Axis", link: "Link") -> None:
        """Take one frame to the axis; a command to the drive that is not ours is a second controller.

        The link that brought it knows its age, and counts what is rejected.
        """
        profile = self._profile
        try:
            if profile.is_feedback(message):
                self._take(profile.decode_feedback(message), message, axis, link)
            elif profile.is_heartbeat(message):
                heartbeat = profile.decode_heartbeat(message)
                self.drive_state = heartbeat.state
                state = None if heartbeat.state is None else self._states.get(heartbeat.state)
                axis.take_heartbeat(heartbeat.boot_counter, state, late=self._is_late(message, link))
            elif profile.is_index(message):
                axis.drive.take_index(profile.decode_index(message).position)
            elif profile.is_command(message):
                self._take_foreign(message, axis)
            else:
                profile.decode_command(message)  # which says what it is instead
        except FrameRejected as rejection:
            link.counters.count_rejection(rejection.reason)
            if isinstance(rejection, PositionRejected):
                self._take(rejection.feedback, message, axis, link)
            elif profile.is_feedback(message):
                axis.drive.monitor.reject()
            self._log.debug("frame rejected", reason=rejection.reason, text=rejection)

    def forget(self) -> None:
        """Start afresh, as after the bus was lost."""
        self.drive_state = None

    def _is_late(self, message: can.Message, link: "Link") -> bool:
        """Whether a frame has waited behind others, or by its date, so that it does not say how things are now."""
        waited_s = link.waited_s(message)
        return link.is_behind or (waited_s is not None and waited_s > _LATE_PERIODS * self._period_s)

    def _take(self, feedback: Reported, message: can.Message, axis: "Axis", link: "Link") -> None:
        age_s = link.age_s(message)
        if age_s is not None:
            self.frame_age.add(age_s)
            self.arrived_s = asyncio.get_running_loop().time() - age_s
        faulty = (
            feedback.fault
            or (feedback.fault is None and feedback.fault_code)
            or (feedback.command_timeout and axis.state in DRIVEN)
        )
        axis.take_feedback(
            Feedback(
                feedback.position,
                feedback.counter,
                feedback.enabled,
                (feedback.fault_code or 0) if faulty else None,
                feedback.safe_torque_off,
                feedback.positive_limit,
                feedback.negative_limit,
                feedback.home_switch,
                self._dated_age_s(age_s) if self._dated else self.sample_age_s,
                unasked=self._late and not self._dated,
                late=self._is_late(message, link),
                faulted=_tells_fault(feedback),
            )
        )

    def _take_foreign(self, message: can.Message, axis: "Axis") -> None:
        """Take a command that is not ours to the axis, with what it asks for as far as that can be read."""
        frame = f"{self._profile.command_id} [{message.data.hex(' ')}]"
        try:
            effort, enable, _ = self._profile.decode_command(message)
        except FrameRejected as rejection:
            axis.take_foreign_command(f"{frame}, which is no valid command ({rejection.reason})")
            return
        enables = effort != 0.0 if enable is None else enable
        asks = f"asks for an effort of {effort:.4g} {axis.settings.effort_unit}" if enables else "disables the drive"
        axis.take_foreign_command(f"{frame}, which {asks}", enables=enables)

    def _dated_age_s(self, age_s: float | None) -> float | None:
        return None if age_s is None else age_s - self._lateness_s


def _tells_fault(feedback: Reported) -> bool | None:
    """Return whether the drive says that it has a fault; None where it does not tell, or tells a time-out alone."""
    told = feedback.fault
    if told is None and feedback.fault_code is not None:
        told = feedback.fault_code != 0
    return None if feedback.command_timeout and not told else told
