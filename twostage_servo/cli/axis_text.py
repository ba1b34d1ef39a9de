"""What the operator is shown of an axis: a line, or the rows of `status`."""

from twostage_servo.api.status import AxisReport, AxisStatus, Status, TripStatus
from twostage_servo.axis.moves import USUAL_OVERRIDE, MoveKind, MoveOutcome
from twostage_servo.axis.reference import ReferenceSource
from twostage_servo.axis.state import DRIVEN, LATCHED, State
from twostage_servo.cli.output import bar

_ARMED = DRIVEN - LATCHED


def lines_of(status: Status) -> str:
    """Return how each axis is, in a line or some."""
    return "\n".join(map(line_of, status.axes.values()))


def line_of(report: AxisReport) -> str:
    """Return how one axis is: a line, and more for a trip and what lasts."""
    axis, move, trip = report.axis, report.move, report.trip
    place = ", position unknown" if axis.position is None else f" at {axis.position:.3f} {axis.unit}"
    text = f"{axis.name}: {axis.state}{place}"
    if axis.velocity is not None and axis.state is not State.HOLDING:
        text += f", {axis.velocity:.1f} {axis.unit}/s"
    if axis.override_percent != USUAL_OVERRIDE:
        text += f", override {axis.override_percent:g} %"
    if not axis.referenced:
        text += ", not homed"
    if unheard := unheard_of(report):
        text += f"; {unheard}"
    if move and axis.state in _ARMED and move.outcome is not MoveOutcome.REPLACED:
        what = f"set-point {move.target:g} {axis.unit}" if move.kind is MoveKind.MOVE else move.kind
        text += f"; {what} {move.outcome}" + (f": {move.reason}" if move.reason else "")
    if report.drive.moved is not None:
        text += f"; moved by {report.drive.moved:+.3f} {axis.unit} while disabled"
    if trip:
        text += _of_trip(trip)
    for one in report.drive.lasting:
        text += f"\nlasts {one.code}: {one.cause}"
        text += f"\nnext: {one.next_action}" if not trip or one.code is not trip.code else ""
    return text


def _of_trip(trip: TripStatus) -> str:
    text = f"\ntrip {trip.code}: {trip.cause}\nnext: {trip.next_action}"
    if len(trip.codes) > 1:
        text += f"\nfurther trips: {', '.join(trip.codes[1:])}"
    if trip.file:
        text += f"\nfile: {trip.file}"
    if trip.file_error:
        text += f"\nfile: {trip.file_error}; `status --recording FILE` saves what is in memory, until `reset`"
    return text


def unheard_of(report: AxisReport) -> str:
    """Return why nothing is known of the drive at this moment; empty if it is heard."""
    if not report.bus.open:
        return f"the bus is closed: {(report.bus.error or '').rstrip('.')}"
    if report.axis.position is not None:
        return ""
    age_ms = report.axis.feedback_age_ms
    return (
        "no position has come from the drive"
        if age_ms is None
        else f"no fresh feedback from the drive for {age_ms:g} ms"
    )


def progress_line(report: AxisReport) -> str:
    """Return how far a move has come."""
    axis, move = report.axis, report.move
    if move is None or axis.position is None:
        return line_of(report)
    length = move.target - move.start
    percent = axis.override_percent
    slowed = f", override {percent:g} %" if percent != USUAL_OVERRIDE else ""
    share = (axis.position - move.start) / length if length else 1.0
    return f"{bar(share)} {axis.position:10.3f} {axis.unit} of {move.target:g}, {axis.state}{slowed}"


def describe(status: Status) -> str:
    """Return all that `status` shows."""
    rows = [row for report in status.axes.values() for row in _rows_of_axis(report)]
    service = status.service
    ticks, lateness, whole = service.ticks, service.ticks.lateness_us, service.ticks.duration_us["whole"]
    rows += [
        ("commanded by", service.authority.holder or "nobody"),
        (
            "ticks",
            (
                f"{ticks.count}, {ticks.missed} missed; lateness p50 {lateness.p50:g}, "
                f"p99 {lateness.p99:g}, max {lateness.max:g} µs; duration p50 {whole.p50:g}, "
                f"p99 {whole.p99:g} µs"
            ),
        ),
        ("service", f"version {service.version}, process {service.pid}, up {service.uptime_s:.0f} s"),
    ]
    return "\n".join(f"{name:16} {text}" for name, text in rows)


def _reference(axis: AxisStatus) -> str:
    """Return on what the positions of an axis rest."""
    if not axis.referenced:
        return f"not known: {axis.reference_lost}"
    seen = "" if axis.position is not None else "; no fresh feedback at present"
    if axis.reference is ReferenceSource.ENCODER:
        return "as counted by the encoder; the axis has not been homed since the service started" + seen
    return "homed" + seen


def _of_law(report: AxisReport) -> str:
    """Return which law drives an axis, and what it has learned."""
    law, axis = report.law, report.axis
    found = law.identified
    rejected = "" if law.rejection is None else f"; rejected ({law.rejection.code}): {law.rejection.cause}"
    if law.rejection is not None and law.rejection.degrades:
        rejected += ". Until a move fits, the law controls as on a plant that is not known"
    if found is None:
        return law.type + rejected
    loads = [
        f"{load:.3g} {axis.effort_unit} {way}"
        for way, load in (("forward", found.load.forward), ("backward", found.load.backward))
        if load is not None
    ]
    return (
        f"{law.type}; from {found.moves} {'move' if found.moves == 1 else 'moves'}: gain {found.gain:.4g} "
        f"{axis.unit}/s²/{axis.effort_unit}, pole {found.pole:.4g} 1/s, delay {found.delay_ticks} ticks, "
        f"load {', '.join(loads) or 'unknown'}" + ("" if law.accepted else "; not yet sure of it") + rejected
    )


def _override(percent: float) -> str:
    """Return what the override is, and what it does to an axis where that is not plain."""
    held = ": the axis is held, and goes on to its set-point when the override rises" if percent == 0.0 else ""
    return f"{percent:g} %{held}"


def _rows_of_axis(report: AxisReport) -> list[tuple[str, str]]:
    axis, frames, bus = report.axis, report.frames, report.bus
    return [
        ("axis", line_of(report)),
        ("positions", _reference(axis)),
        ("speed override", _override(axis.override_percent)),
        ("effort", f"{axis.effort:.3f} {axis.effort_unit}" + (" (at its limit)" if axis.saturated else "")),
        ("following error", f"{axis.following_error:.3f} {axis.unit}"),
        ("law", _of_law(report)),
        *([("file of the law", report.law.file_error)] if report.law.file_error else []),
        ("bus", f"open, controller {bus.controller}" if bus.open else f"closed: {bus.error}"),
        ("drive inputs", ", ".join(name for name, on in report.inputs.to_json().items() if on) or "none active"),
        (
            "frames",
            (
                f"{frames.received} received, {frames.sent} sent, {frames.rejected} rejected, "
                f"{frames.lost} lost, {frames.dropped} dropped"
            ),
        ),
    ]
