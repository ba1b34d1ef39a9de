"""What the operator is shown of an axis: a line, or the rows of `status`."""

from typing import TYPE_CHECKING

from twostage_servo.cli.output import bar

if TYPE_CHECKING:
    from twostage_servo.cli.client import Answer

_ARMED = {
    "holding", "moving_speed_stage", "moving_position_stage", "jogging", "homing", "stopping", "quick_stopping",
    "disarming",
}  # fmt: skip


def reports_of(answer: "Answer") -> "dict[str, Answer]":
    """Return what an answer says of each axis."""
    axes: dict[str, Answer] = answer.get("axes") or {answer["axis"]["name"]: answer}
    return axes


def states_of(answer: "Answer") -> set[str]:
    """Return the states of all axes that an answer tells of."""
    return {report["axis"]["state"] for report in reports_of(answer).values()}


def _number(value: float | None, unit: str) -> str:
    return f"unknown {unit}" if value is None else f"{value:.3f} {unit}"


def lines_of(status: "Answer") -> str:
    """Return how each axis is, in a line or some."""
    return "\n".join(map(line_of, reports_of(status).values()))


def line_of(status: "Answer") -> str:
    """Return how one axis is: a line, and more for a trip and what lasts."""
    axis, move, trip = status["axis"], status["move"], status["trip"]
    text = f"{axis['name']}: {axis['state']} at {_number(axis['position'], axis['unit'])}"
    if axis["velocity"] is not None and axis["state"] != "holding":
        text += f", {axis['velocity']:.1f} {axis['unit']}/s"
    if not axis["referenced"]:
        text += ", not homed"
    if unheard := unheard_of(status):
        text += f"; {unheard}"
    if move and axis["state"] in _ARMED and move["outcome"] != "replaced":
        what = f"set-point {move['target']:g} {axis['unit']}" if move["kind"] == "move" else move["kind"]
        text += f"; {what} {move['outcome']}" + (f": {move['reason']}" if move["reason"] else "")
    if status["drive"]["moved"] is not None:
        text += f"; moved by {status['drive']['moved']:+.3f} {axis['unit']} while disabled"
    if trip:
        text += _of_trip(trip)
    for one in status["drive"]["lasting"]:
        text += f"\nlasts {one['code']}: {one['cause']}"
        text += f"\nnext: {one['next_action']}" if not trip or one["code"] != trip["code"] else ""
    return text


def _of_trip(trip: "Answer") -> str:
    text = f"\ntrip {trip['code']}: {trip['cause']}\nnext: {trip['next_action']}"
    if len(trip["codes"]) > 1:
        text += f"\ntripped by as well: {', '.join(trip['codes'][1:])}"
    if trip["file"]:
        text += f"\nfile: {trip['file']}"
    if trip["file_error"]:
        text += f"\nfile: {trip['file_error']}; `status --recording FILE` saves what is in memory, until `reset`"
    return text


def unheard_of(status: "Answer") -> str:
    """Return why nothing is known of the drive at this moment; empty if it is heard."""
    if not status["bus"]["open"]:
        return f"the bus is closed: {status['bus']['error'].rstrip('.')}"
    if status["axis"]["position"] is not None:
        return ""
    age_ms = status["axis"]["feedback_age_ms"]
    return (
        "no position has come from the drive"
        if age_ms is None
        else f"no fresh feedback from the drive for {age_ms:g} ms"
    )


def progress_line(snapshot: "Answer") -> str:
    """Return how far a move has come."""
    axis, move = snapshot["axis"], snapshot["move"]
    if move is None or axis["position"] is None:
        return line_of(snapshot)
    length = move["target"] - move["start"]
    share = (axis["position"] - move["start"]) / length if length else 1.0
    return f"{bar(share)} {axis['position']:10.3f} {axis['unit']} of {move['target']:g}, {axis['state']}"


def describe(status: "Answer") -> str:
    """Return all that `status` shows."""
    rows = [row for report in reports_of(status).values() for row in _rows_of_axis(report)]
    ticks = status["ticks"]
    lateness, whole = ticks["lateness_us"], ticks["duration_us"]["whole"]
    rows += [
        ("commanded by", status["lease"]["holder"] or "nobody"),
        (
            "ticks",
            (
                f"{ticks['count']}, {ticks['missed']} missed; lateness p50 {lateness['p50']:g}, "
                f"p99 {lateness['p99']:g}, max {lateness['max']:g} µs; duration p50 {whole['p50']:g}, "
                f"p99 {whole['p99']:g} µs"
            ),
        ),
        ("service", f"version {status['version']}, process {status['pid']}, up {status['uptime_s']:.0f} s"),
    ]
    return "\n".join(f"{name:16} {text}" for name, text in rows)


def _reference(axis: "Answer") -> str:
    """Return on what the positions of an axis rest."""
    if not axis["referenced"]:
        return f"not known: {axis['reference_lost']}"
    seen = "" if axis["position"] is not None else "; the axis is not seen just now"
    if axis["reference"] == "encoder":
        return "as the encoder counts them; the axis has not been homed since the service started" + seen
    return "homed" + seen


def _rows_of_axis(status: "Answer") -> list[tuple[str, str]]:
    axis, frames, bus = status["axis"], status["frames"], status["bus"]
    return [
        ("axis", line_of(status)),
        ("positions", _reference(axis)),
        ("effort", f"{axis['effort']:.3f} {axis['effort_unit']}" + (" (at its limit)" if axis["saturated"] else "")),
        ("following error", f"{axis['following_error']:.3f} {axis['unit']}"),
        ("bus", f"open, controller {bus['controller']}" if bus["open"] else f"closed: {bus['error']}"),
        ("drive inputs", ", ".join(name for name, active in status["inputs"].items() if active) or "none active"),
        (
            "frames",
            (
                f"{frames['received']} received, {frames['sent']} sent, {frames['rejected']} rejected, "
                f"{frames['lost']} lost, {frames['dropped']} dropped"
            ),
        ),
    ]
