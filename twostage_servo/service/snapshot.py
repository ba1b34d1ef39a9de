"""The state of the service and of an axis, as `status` and `watch` show it."""

import os
from typing import TYPE_CHECKING

from twostage_servo import __version__
from twostage_servo.api.status import (
    AxisReport,
    AxisStatus,
    BusStatus,
    DriveStatus,
    FrameStatus,
    InputStatus,
    LeaseStatus,
    MoveStatus,
    ServiceStatus,
    Times,
    TripStatus,
    Trouble,
)
from twostage_servo.axis.state import DRIVEN
from twostage_servo.service.statistics import times_of
from twostage_servo.timing.histogram import TimeHistogram

if TYPE_CHECKING:
    from twostage_servo.axis.moves import Move
    from twostage_servo.service.axis_loop import AxisLoop
    from twostage_servo.service.servo_service import ServoService


def report_service(service: "ServoService") -> ServiceStatus:
    """Return what all axes have in common."""
    return ServiceStatus(
        version=__version__,
        pid=os.getpid(),
        uptime_s=round(service.uptime_s, 3),
        lease=LeaseStatus(holder=service.desk.authority.holder),
        ticks=service.statistics.summary(),
        realtime=None if service.host is None else service.host(),
    )


def report_axis(axis_loop: "AxisLoop") -> AxisReport:
    """Return the state of an axis with its drive and its bus."""
    axis, bus = axis_loop.axis, axis_loop.bus
    drive = axis.drive
    return AxisReport(
        axis=_axis_status(axis_loop),
        move=_move_status(axis.move),
        trip=_trip_status(axis_loop),
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


def _trip_status(axis_loop: "AxisLoop") -> TripStatus | None:
    axis, file = axis_loop.axis, axis_loop.event_log.trip_file
    if axis.trip is None:
        return None
    return TripStatus(
        code=axis.trip.code,
        cause=axis.trip.cause,
        next_action=axis.trip.next_action,
        tick=axis.trip.tick,
        reaction=axis.trip.reaction.name.lower(),
        escalation=None if axis.escalation is None else axis.escalation.code,
        codes=list(axis.trips),
        file=None if file.path is None else str(file.path),
        file_error=file.error,
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
