"""The operator's verbs, clients of a running service: look at the axis, command it, bring it back after a trip."""

import argparse
import csv
import itertools
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twostage_servo.cli.configuration import find_configuration
from twostage_servo.cli.output import CommandError, ExitCode, Progress, bar, note, print_json, print_line

if TYPE_CHECKING:
    from collections.abc import Sequence

    from twostage_servo.cli.client import Answer, Client

_ARMED = {
    "holding", "moving_speed_stage", "moving_position_stage", "jogging", "homing", "stopping", "quick_stopping",
    "disarming",
}  # fmt: skip
_BRAKING = {"stopping", "quick_stopping", "disarming", "tripped_stopping", "tripped_quick_stop"}
_JOG_INTERVAL_S = 0.1
LONGEST_RELOAD_S = 65.0
"""Longer than the service lets the process take that reads a configuration again."""


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verbs."""
    status = _verb(verbs, "status", _status, "show the state of service and axis")
    status.add_argument(
        "--recording", type=Path, metavar="FILE", help="write the last ticks, or those before the trip, to a CSV file"
    )
    watch = _verb(verbs, "watch", _watch, "follow the axis live")
    watch.add_argument("--every", type=int, default=10, metavar="TICKS", help="ticks between two lines (default 10)")
    watch.add_argument("--count", type=int, metavar="N", help="end after N lines")
    _verb(verbs, "arm", _arm, "enable the drive and hold the position at which the axis is")
    _verb(verbs, "disarm", _disarm, "bring the axis to rest and disable the drive")
    move = _verb(verbs, "move", _move, "move to a set-point")
    move._negative_number_matcher = re.compile(r"-\.?\d")  # noqa: SLF001 - argparse takes -1e3 for an option
    move.add_argument(
        "position",
        type=_set_point,
        nargs="*",
        help="absolute set-point, in the axis' unit; NAME=POSITION for each of several axes, which arrive together",
    )
    move.add_argument("--by", type=float, metavar="DISTANCE", help="relative to the set-point in force")
    move.add_argument("--velocity", type=float, help="cruise velocity (default: the config's axis.cruise_velocity)")
    move.add_argument("--wait", action="store_true", help="show progress until the position is reached")
    jog = _verb(verbs, "jog", _jog, "move for as long as this command runs, or for a time")
    jog._negative_number_matcher = re.compile(r"-\.?\d")  # noqa: SLF001 - likewise
    jog.add_argument("velocity", type=float, help="velocity, whose sign is the direction")
    jog.add_argument("--seconds", type=float, metavar="S", help="end after S seconds (default: at Ctrl-C)")
    home = _verb(verbs, "home", _home, "find the reference from which positions are counted")
    home._negative_number_matcher = re.compile(r"-\.?\d")  # noqa: SLF001 - likewise
    home.add_argument(
        "--here", type=float, metavar="POSITION", help="do not search: the axis stands at this position now"
    )
    stop = _verb(
        verbs, "stop", _stop, "bring the axis, or all axes, to rest and hold them there, whoever commands them"
    )
    stop.add_argument("--quick", action="store_true", help="with the quick stop deceleration")
    _verb(verbs, "reset", _reset, "clear a trip; the axis is disarmed afterwards")
    _verb(verbs, "release", _release, "take the lease from whoever holds it, while the axis is at rest")
    _verb(verbs, "reload", _reload, "let the service read its configuration again, while the axis is disarmed")


def _verb(verbs: Any, name: str, run: Any, text: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    if name not in {"release", "reload"}:
        parser.add_argument("--axis", metavar="NAME", help="which axis, where the service has several")
    parser.add_argument("--socket", type=Path, metavar="PATH", help="control socket of the service")
    parser.add_argument("--config", type=Path, metavar="FILE", help="take the socket's path from this configuration")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)
    return parser


def _set_point(text: str) -> tuple[str | None, float]:
    name, equals, number = text.rpartition("=")
    return (name if equals else None), float(number)


def _connect(options: argparse.Namespace) -> "Client":
    from twostage_servo.cli.client import Client
    from twostage_servo.service.address import find_socket

    path = options.socket or _socket_of(options.config) or find_socket()
    return Client(path, axis=getattr(options, "axis", None))


def _reports(answer: "Answer") -> "dict[str, Answer]":
    """Return what an answer says of each axis."""
    axes: dict[str, Answer] = answer.get("axes") or {answer["axis"]["name"]: answer}
    return axes


def _states(answer: "Answer") -> set[str]:
    return {report["axis"]["state"] for report in _reports(answer).values()}


def _socket_of(config: Path | None) -> Path | None:
    config = find_configuration(config)
    if config is None:
        return None
    import tomllib  # the whole loader would take longer than the command

    try:
        table = tomllib.loads(config.read_text(encoding="utf-8"))
    except OSError as error:
        raise CommandError(ExitCode.USAGE, "config", f"{config} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise CommandError(ExitCode.USAGE, "config", f"{config} is not TOML: {error}; `check` says more") from error
    service = table.get("service", {})
    named = service.get("socket", "") if isinstance(service, dict) else None
    if not isinstance(named, str):
        raise CommandError(ExitCode.USAGE, "config", f"{config}: service.socket is not a text; `check` says more")
    return Path(named) if named else None


def _status(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        status = client.request(op="status")
        if options.recording is not None:
            recording = client.request(op="recording")
            _write_csv(options.recording, recording["fields"], recording["records"])
    if options.json:
        print_json(status)
    else:
        print_line(_describe(status))
    reports = _reports(status).values()
    return ExitCode.FAILED if any(one["trip"] or one["drive"]["lasting"] for one in reports) else ExitCode.DONE


def _write_csv(path: Path, fields: list[str], records: list[list[Any]]) -> None:
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows([fields, *records])
    except OSError as error:
        raise CommandError(ExitCode.FAILED, "recording", f"the recording cannot be written: {error}") from error
    note(f"{len(records)} ticks written to {path}")


def _watch(options: argparse.Namespace) -> ExitCode:
    if not 1 <= options.every <= 10_000:
        raise CommandError(ExitCode.USAGE, "usage", f"--every {options.every}: from 1 to 10000 ticks are possible")
    if options.count is not None and options.count < 1:
        raise CommandError(ExitCode.USAGE, "usage", f"--count {options.count}: at least 1 line is needed")
    with _connect(options) as client:
        for snapshot in itertools.islice(client.watch(options.every), options.count):
            if options.json:
                print_json(snapshot)
            else:
                print_line(_lines(snapshot))
    return ExitCode.DONE


def _arm(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        client.request(op="arm")
        return _finish(options, _wait_while(client, {"arming", "stopping"}))


def _disarm(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        client.request(op="disarm")
        return _finish(options, _wait_while(client, _BRAKING))


def _stop(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        client.request(op="stop", quick=options.quick)
        return _finish(options, _wait_while(client, _BRAKING))


def _jog(options: argparse.Namespace) -> ExitCode:
    if options.seconds is not None and not 0.0 <= options.seconds < 1e6:
        raise CommandError(ExitCode.USAGE, "usage", f"--seconds {options.seconds}: from 0 to 1e6 s are possible")
    try:
        with _connect(options) as client:
            _renew_jog(client, options)
            return _finish(options, _wait_while(client, _BRAKING))
    except KeyboardInterrupt:
        note("")
    # A connection of its own: Ctrl-C may have come between a request and its answer.
    with _connect(options) as client:
        if client.request(op="status")["axis"]["state"] == "jogging":
            client.request(op="stop")
        return _finish(options, _wait_while(client, _BRAKING))


def _renew_jog(client: "Client", options: argparse.Namespace) -> None:
    import time

    progress = Progress(quiet=options.json)
    answer = client.request(op="jog", velocity=options.velocity)
    number = answer["move"]["number"]
    end_s = math.inf if options.seconds is None else time.monotonic() + options.seconds
    try:
        while answer["move"]["number"] == number and answer["move"]["outcome"] == "moving":
            progress.show(_one_line(answer))
            if (left_s := end_s - time.monotonic()) <= 0.0:
                break
            time.sleep(min(_JOG_INTERVAL_S, left_s))
            # Looks before it asks again: a jog that a limit or another client has ended is not begun anew.
            answer = client.request(op="status")
            if answer["axis"]["state"] == "jogging":
                answer = client.request(op="jog", velocity=options.velocity)
    finally:
        progress.end()
    if answer["axis"]["state"] == "jogging":
        client.request(op="stop")


def _home(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        if options.here is not None:
            return _finish(options, client.request(op="home", position=options.here))
        answer = client.request(op="home")
        if answer["axis"]["state"] != "homing":  # the place where the axis stands is the reference
            return _finish(options, answer)
        return _finish(options, _follow(client, answer, quiet=options.json), moved=True)


def _release(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        client.request(op="take")
        return _finish(options, client.request(op="release"))


def _reload(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        client.be_patient(LONGEST_RELOAD_S)
        return _finish(options, client.request(op="reload"))


def _reset(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        client.request(op="reset")
        return _finish(options, _wait_while(client, set()))


def _move(options: argparse.Namespace) -> ExitCode:
    wanted = {**_wanted(options), "velocity": options.velocity}
    with _connect(options) as client:
        answer = client.request(op="move", **{key: value for key, value in wanted.items() if value is not None})
        if options.wait:
            answer = _follow(client, answer, options.wanted, quiet=options.json)
    return _finish(options, answer, moved=True)


def _wanted(options: argparse.Namespace) -> dict[str, Any]:
    """Return the set-point that was asked for as the request has it."""
    names = [name for name, _ in options.position]
    options.wanted = [name for name in names if name is not None]
    if (len(names) == 0) == (options.by is None) or len(set(names)) < len(names) or (None in names and len(names) > 1):
        text = "give one position, or NAME=POSITION for each of several axes, or --by DISTANCE"
        raise CommandError(ExitCode.USAGE, "usage", text)
    if names == [None]:
        return {"position": options.position[0][1]}
    return {"positions": dict(options.position)} if names else {"by": options.by}


def _follow(client: "Client", begun: "Answer", names: "Sequence[str]" = (), *, quiet: bool) -> "Answer":
    """Show progress until the moves that an answer tells of, of all axes or of those named, have ended."""
    progress = Progress(quiet=quiet)
    numbers = {name: report["move"]["number"] for name, report in _reports(begun).items() if not names or name in names}
    snapshot: Answer = {}
    try:
        for snapshot in client.watch(5):
            reports = {name: _reports(snapshot)[name] for name in numbers}
            progress.show("  ".join(map(_progress_line, reports.values())))
            if any(
                report["move"] is None or report["move"]["number"] != numbers[name] for name, report in reports.items()
            ):
                raise CommandError(
                    ExitCode.FAILED,
                    "replaced",
                    "another client's set-point has replaced this one",
                    {"status": snapshot},
                )
            if all(report["move"]["outcome"] != "moving" for report in reports.values()):
                break
    except KeyboardInterrupt:
        note("\nno longer watching; the axis goes on to its set-point. `twostage-servo stop` stops it.")
        raise
    finally:
        progress.end()
    return {"ok": True} | snapshot


def _wait_while(client: "Client", states: set[str]) -> "Answer":
    """Return the first state that is none of these, with every drive that is told to disable seen to be off.

    The service bounds each of them, or the operator with Ctrl-C.
    """

    def goes_on(seen: "Answer") -> bool:
        return bool(_states(seen) & states) or any(one["drive"]["disabling"] for one in _reports(seen).values())

    status = client.request(op="status")
    if goes_on(status):
        status = next(seen for seen in client.watch(1) if not goes_on(seen))
    return {"ok": True} | status


def _finish(options: argparse.Namespace, status: "Answer", *, moved: bool = False) -> ExitCode:
    if options.json:
        print_json(status)
    else:
        print_line(_lines(status))
    reports = _reports(status).values()
    if options.verb == "arm" and _states(status) != {"holding"}:
        return ExitCode.FAILED
    not_reached = moved and any(one["move"] and one["move"]["outcome"] in {"stopped", "tripped"} for one in reports)
    if options.verb == "disarm":  # a trip has disabled the drive as well
        return ExitCode.FAILED if any(map(_may_be_enabled, reports)) else ExitCode.DONE
    failed = any(one["trip"] or _may_be_enabled(one) for one in reports) or not_reached
    return ExitCode.FAILED if failed else ExitCode.DONE


def _may_be_enabled(status: "Answer") -> bool:
    """Whether the drive of a disabled axis says that it is enabled, or two things at once; also if it is silent now."""
    disabled = status["axis"]["state"] in {"disarmed", "tripped"}
    return disabled and bool(status["drive"]["enabled"] or status["drive"]["lasting"])


def _number(value: float | None, unit: str) -> str:
    return f"unknown {unit}" if value is None else f"{value:.3f} {unit}"


def _lines(status: "Answer") -> str:
    return "\n".join(map(_one_line, _reports(status).values()))


def _one_line(status: "Answer") -> str:
    axis, move, trip = status["axis"], status["move"], status["trip"]
    text = f"{axis['name']}: {axis['state']} at {_number(axis['position'], axis['unit'])}"
    if axis["velocity"] is not None and axis["state"] != "holding":
        text += f", {axis['velocity']:.1f} {axis['unit']}/s"
    if not axis["referenced"]:
        text += ", not homed"
    if move and axis["state"] in _ARMED and move["outcome"] != "replaced":
        what = f"set-point {move['target']:g} {axis['unit']}" if move["kind"] == "move" else move["kind"]
        text += f"; {what} {move['outcome']}" + (f": {move['reason']}" if move["reason"] else "")
    if status["drive"]["moved"] is not None:
        text += f"; moved by {status['drive']['moved']:+.3f} {axis['unit']} while disabled"
    if trip:
        text += f"\ntrip {trip['code']}: {trip['cause']}\nnext: {trip['next_action']}"
        if trip["file"]:
            text += f"\nfile: {trip['file']}"
    for one in status["drive"]["lasting"]:
        text += f"\nlasts {one['code']}: {one['cause']}"
        text += f"\nnext: {one['next_action']}" if not trip or one["code"] != trip["code"] else ""
    return text


def _progress_line(snapshot: "Answer") -> str:
    axis, move = snapshot["axis"], snapshot["move"]
    if move is None or axis["position"] is None:
        return _one_line(snapshot)
    length = move["target"] - move["start"]
    share = (axis["position"] - move["start"]) / length if length else 1.0
    return f"{bar(share)} {axis['position']:10.3f} {axis['unit']} of {move['target']:g}, {axis['state']}"


def _describe(status: "Answer") -> str:
    rows = [row for report in _reports(status).values() for row in _rows_of_axis(report)]
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


def _rows_of_axis(status: "Answer") -> list[tuple[str, str]]:
    axis, frames, bus = status["axis"], status["frames"], status["bus"]
    return [
        ("axis", _one_line(status)),
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
