"""The state of the service and of an axis as JSON objects: what `status` and `watch` show."""

import os
from typing import TYPE_CHECKING, Any

from twostage_servo import __version__
from twostage_servo.axis.state import DRIVEN
from twostage_servo.timing.histogram import TimeHistogram

if TYPE_CHECKING:
    from twostage_servo.service.axis_loop import AxisLoop
    from twostage_servo.service.servo_service import ServoService


def report_service(service: "ServoService") -> dict[str, Any]:
    """Return what all axes have in common, ready for JSON."""
    return {
        "version": __version__,
        "pid": os.getpid(),
        "uptime_s": round(service.uptime_s, 3),
        "lease": {"holder": service.desk.authority.holder},
        "ticks": service.statistics.summary(),
        "realtime": None if service.host is None else service.host(),
    }


def report_axis(axis_loop: "AxisLoop") -> dict[str, Any]:
    """Return the state of an axis with its drive and its bus, ready for JSON."""
    axis, estimate, bus, receiver = axis_loop.axis, axis_loop.axis.estimate, axis_loop.bus, axis_loop.receiver
    driven = axis.state in DRIVEN
    age = axis.drive.monitor.ticks_since_fresh
    counters, file = bus.link.counters, axis_loop.event_log.trip_file
    return {
        "axis": {
            "name": axis.settings.name,
            "unit": axis.settings.unit,
            "effort_unit": axis.settings.effort_unit,
            "state": axis.state,
            "cia402": axis.cia402_state,
            "referenced": axis.referenced,
            "reference": axis.reference.source,
            "reference_lost": axis.reference.lost_because or None,
            "position": None if axis.drive.is_stale else axis.drive.position,
            "feedback_age_ms": None if age is None else round(1e3 * age * axis.design.period_s, 3),
            "velocity": estimate.velocity if driven else None,
            "disturbance": estimate.disturbance if driven else None,
            "effort": axis_loop.command.effort,
            "target": axis.set_point if driven else None,
            "following_error": axis.following_error,
            "saturated": driven and axis.saturated,
        },
        "move": None
        if axis.move is None
        else {
            "number": axis.move.number,
            "start": axis.move.start,
            "target": axis.move.target,
            "velocity": axis.move.velocity,
            "outcome": axis.move.outcome,
            "kind": axis.move.kind,
            "reason": axis.move.reason,
        },
        "trip": None
        if axis.trip is None
        else {
            "code": axis.trip.code,
            "cause": axis.trip.cause,
            "next_action": axis.trip.next_action,
            "tick": axis.trip.tick,
            "reaction": axis.trip.reaction.name.lower(),
            "escalation": None if axis.escalation is None else axis.escalation.code,
            "codes": list(axis.trips),
            "file": None if file.path is None else str(file.path),
            "file_error": file.error,
        },
        "drive": {
            "enabled": axis.drive.enabled,
            "disabling": axis.is_disabling,
            "moved": axis.disabled.moved,
            "lasting": [{"code": one.code, "cause": one.cause, "next_action": one.next_action} for one in axis.lasting],
        },
        "inputs": {
            "safe_torque_off": axis.drive.safe_torque_off,
            "positive_limit": axis.drive.positive_limit,
            "negative_limit": axis.drive.negative_limit,
            "home_switch": axis.drive.home_switch,
        },
        "frames": {
            "received": counters.received,
            "sent": counters.sent,
            "rejected": counters.rejected,
            "rejected_by_reason": dict(counters.rejected_by_reason),
            "dropped": counters.dropped,
            "errors": counters.errors,
            "errors_by_kind": dict(counters.errors_by_kind),
            "overflowed": counters.overflowed,
            "overruns": counters.overruns,
            "late": axis.drive.monitor.late,
            "lost": axis.drive.monitor.lost,
            "doubled": axis.drive.monitor.doubled,
            "reordered": axis.drive.monitor.reordered,
            "implausible": axis.drive.monitor.implausible,
            "recent_errors": axis.drive.monitor.recent_errors,
            "predicted": axis.predicted_ticks,
            "age_us": _measured(receiver.frame_age),
            "feedback_to_command_us": _measured(axis_loop.feedback_to_command),
        },
        "bus": {
            "channel": bus.link.settings.channel,
            "open": bus.error is None,
            "error": bus.error,
            "drive_state": receiver.drive_state,
            "controller": bus.link.controller_state,
            "error_counters": bus.link.error_counters,
        },
    }


def _measured(times: TimeHistogram) -> dict[str, float] | None:
    """Return None rather than zeros where nothing has been measured: not every bus dates its frames."""
    return times.summary() if times.count else None
