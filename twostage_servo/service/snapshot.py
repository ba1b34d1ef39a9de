"""The state of the service and of an axis, as `status` and `watch` show it."""

import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.law_status import IdentifiedStatus, LawStatus, LoadStatus, RejectionStatus
from twostage_servo.api.status import (
    AuthorityStatus,
    AxisReport,
    AxisStatus,
    BusStatus,
    DriveStatus,
    FrameStatus,
    InputStatus,
    MoveStatus,
    RealtimeStatus,
    ServiceStatus,
    Status,
    Times,
    TripStatus,
    Trouble,
)
from twostage_servo.axis.state import DRIVEN
from twostage_servo.service.statistics import times_of
from twostage_servo.timing.histogram import TimeHistogram
from twostage_servo.version import __version__

if TYPE_CHECKING:
    from twostage_servo.axis.axis import Axis
    from twostage_servo.axis.moves import Move
    from twostage_servo.axis.trips import Trip
    from twostage_servo.service.authority import Authority
    from twostage_servo.service.axis_loop import AxisLoop
    from twostage_servo.service.statistics import TickStatistics


class StatusReport:
    """Tells how a service is.

    Parameters
    ----------
    axis_loops, statistics, authority
        What is reported.
    host
        Tells how punctual the host lets the service be; None where it runs in simulated time.

    Attributes
    ----------
    axis_loops
        As given.
    """

    def __init__(
        self,
        axis_loops: "Sequence[AxisLoop]",
        statistics: "TickStatistics",
        authority: "Authority",
        host: Callable[[], RealtimeStatus] | None = None,
    ) -> None:
        self.axis_loops = axis_loops
        self._statistics = statistics
        self._authority = authority
        self._host = host

    def common(self) -> ServiceStatus:
        """Return what all axes have in common."""
        return ServiceStatus(
            version=__version__,
            pid=os.getpid(),
            uptime_s=round(self._statistics.uptime_s, 3),
            authority=AuthorityStatus(holder=self._authority.holder),
            ticks=self._statistics.summary(),
            realtime=None if self._host is None else self._host(),
        )

    def status(self, axis_loops: "Sequence[AxisLoop] | None" = None) -> Status:
        """Return the state of the service and of some axes, or of all."""
        axis_loops = self.axis_loops if axis_loops is None else axis_loops
        return Status(service=self.common(), axes={axis_loop.name: report_axis(axis_loop) for axis_loop in axis_loops})

    def snapshot(self, axis_loops: "Sequence[AxisLoop] | None" = None) -> JsonObject:
        """Return the same ready for JSON; see :meth:`Status.to_json`."""
        return self.status(axis_loops).to_json()

    def snapshot_of(self, axis_loop: "AxisLoop") -> JsonObject:
        """Return the state of the service and of one axis, ready for JSON."""
        return self.snapshot((axis_loop,))


def report_axis(axis_loop: "AxisLoop") -> AxisReport:
    """Return the state of an axis with its drive and its bus."""
    axis, bus = axis_loop.axis, axis_loop.bus
    drive = axis.drive
    return AxisReport(
        axis=_axis_status(axis_loop),
        move=_move_status(axis.move),
        trip=None if axis.trip is None else _trip_status(axis_loop, axis.trip),
        drive=DriveStatus(
            enabled=drive.enabled,
            disabling=axis.is_disabling,
            moved=axis.disabled.moved,
            lasting=[Trouble(code=one.code, cause=one.cause, next_action=one.next_action) for one in axis.lasting],
        ),
        inputs=InputStatus(
            safe_torque_off=drive.safe_torque_off,
            positive_limit=drive.positive_limit,
            negative_limit=drive.negative_limit,
            home_switch=drive.home_switch,
        ),
        frames=_frame_status(axis_loop),
        bus=BusStatus(
            channel=bus.link.settings.channel,
            open=bus.error is None,
            error=bus.error,
            drive_state=axis_loop.receiver.drive_state,
            controller=bus.link.controller_state,
            error_counters=bus.link.error_counters,
        ),
        law=law_status(axis, axis_loop.learned_file.error),
    )


def law_status(axis: "Axis", file_error: str | None = None) -> LawStatus:
    """Return which law drives an axis, what it has learned of its plant, and what keeps its file from being so."""
    name, learned = axis.settings.law.type, axis.learned
    identified, why = None, None if learned is None else learned.rejection
    if learned is not None and learned.moves:
        forward, backward = learned.load
        identified = IdentifiedStatus(
            gain=learned.gain,
            pole=learned.pole,
            delay_ticks=learned.delay_ticks,
            load=LoadStatus(forward=forward, backward=backward),
            moves=learned.moves,
        )
    return LawStatus(
        type=name,
        identified=identified,
        accepted=None if learned is None or identified is None else learned.is_sure,
        rejection=None if why is None else RejectionStatus(code=str(why.code), cause=why.cause, degrades=why.degrades),
        file_error=file_error,
    )


def _axis_status(axis_loop: "AxisLoop") -> AxisStatus:
    axis, estimate = axis_loop.axis, axis_loop.axis.estimate
    driven = axis.state in DRIVEN
    age = axis.drive.monitor.ticks_since_fresh
    return AxisStatus(
        name=axis.settings.name,
        unit=axis.settings.unit,
        effort_unit=axis.settings.effort_unit,
        state=axis.state,
        cia402=axis.cia402_state,
        referenced=axis.referenced,
        reference=axis.reference.source,
        reference_lost=axis.reference.lost_because or None,
        position=None if axis.drive.is_stale else axis.drive.position,
        feedback_age_ms=None if age is None else round(1e3 * age * axis.design.period_s, 3),
        velocity=estimate.velocity if driven else None,
        disturbance=estimate.disturbance if driven else None,
        effort=axis_loop.command.effort,
        target=axis.set_point if driven else None,
        following_error=axis.following_error,
        saturated=driven and axis.saturated,
        override_percent=axis.override_percent,
    )


def _move_status(move: "Move | None") -> MoveStatus | None:
    if move is None:
        return None
    return MoveStatus(
        number=move.number,
        start=move.start,
        target=move.target,
        velocity=move.velocity,
        outcome=move.outcome,
        kind=move.kind,
        reason=move.reason,
    )


def _trip_status(axis_loop: "AxisLoop", trip: "Trip") -> TripStatus:
    axis = axis_loop.axis
    return TripStatus(
        code=trip.code,
        cause=trip.cause,
        next_action=trip.next_action,
        tick=trip.tick,
        reaction=trip.reaction.name.lower(),
        escalation=None if axis.escalation is None else axis.escalation.code,
        codes=list(axis.trips),
        file=trip.file.path,
        file_error=trip.file.error,
    )


def _frame_status(axis_loop: "AxisLoop") -> FrameStatus:
    counters, monitor = axis_loop.bus.link.counters, axis_loop.axis.drive.monitor
    return FrameStatus(
        received=counters.received,
        sent=counters.sent,
        rejected=counters.rejected,
        rejected_by_reason=dict(counters.rejected_by_reason),
        dropped=counters.dropped,
        errors=counters.errors,
        errors_by_kind=dict(counters.errors_by_kind),
        overflowed=counters.overflowed,
        overruns=counters.overruns,
        late=monitor.late,
        lost=monitor.lost,
        doubled=monitor.doubled,
        reordered=monitor.reordered,
        implausible=monitor.implausible,
        recent_errors=monitor.recent_errors,
        predicted=axis_loop.axis.predicted_ticks,
        age_us=_measured(axis_loop.receiver.frame_age),
        feedback_to_command_us=_measured(axis_loop.feedback_to_command),
    )


def _measured(times: TimeHistogram) -> Times | None:
    """Return None rather than zeros where nothing has been measured: not every bus dates its frames."""
    return times_of(times) if times.count else None
