"""The operator's verbs, clients of a running service: look at the axis, command it, bring it back after a trip."""

import argparse
import csv
import itertools
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.cli.axis_text import describe, line_of, lines_of, progress_line, reports_of, states_of, unheard_of
from twostage_servo.cli.configuration import configuration_problems
from twostage_servo.cli.output import CommandError, ExitCode, Progress, note, print_json, print_line
from twostage_servo.cli.typed_numbers import decimal, whole
from twostage_servo.config.files import find_configuration

if TYPE_CHECKING:
    from collections.abc import Sequence

    from twostage_servo.cli.client import Answer, Client

_DISABLED = {"disarmed", "tripped"}
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
    watch.add_argument("--every", type=whole, default=10, metavar="TICKS", help="ticks between two lines (default 10)")
    watch.add_argument("--count", type=whole, metavar="N", help="end after N lines")
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
    move.add_argument("--by", type=decimal, metavar="DISTANCE", help="relative to the set-point in force")
    move.add_argument("--velocity", type=decimal, help="cruise velocity (default: the config's axis.cruise_velocity)")
    move.add_argument("--wait", action="store_true", help="show progress until the position is reached")
    jog = _verb(verbs, "jog", _jog, "move for as long as this command runs, or for a time")
    jog._negative_number_matcher = re.compile(r"-\.?\d")  # noqa: SLF001 - likewise
    jog.add_argument("velocity", type=decimal, help="velocity, whose sign is the direction")
    jog.add_argument("--seconds", type=decimal, metavar="S", help="end after S seconds (default: at Ctrl-C)")
    home = _verb(verbs, "home", _home, "find the reference from which positions are counted")
    home._negative_number_matcher = re.compile(r"-\.?\d")  # noqa: SLF001 - likewise
    home.add_argument(
        "--here", type=decimal, metavar="POSITION", help="do not search: the axis stands at this position now"
    )
    stop = _verb(
        verbs, "stop", _stop, "bring the axis, or all axes, to rest and hold them there, whoever commands them"
    )
    stop.add_argument("--quick", action="store_true", help="with the quick stop deceleration")
    _verb(verbs, "reset", _reset, "clear a trip; the axis is disarmed afterwards")
    release = _verb(verbs, "release", _release, "give one's own control authority back")
    release.add_argument(
        "--force", action="store_true", help="take it from whoever holds it, while the axis is at rest"
    )
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
    try:
        return (name if equals else None), decimal(number)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{text}: {error}" if equals else str(error)) from error


def _connect(options: argparse.Namespace) -> "Client":
    from twostage_servo.api.address import find_socket
    from twostage_servo.cli.client import Client

    path = options.socket or _socket_of(options.config) or find_socket()
    return Client(path, axis=getattr(options, "axis", None))


def _socket_of(config: Path | None) -> Path | None:
    path = find_configuration(config)
    if path is None:
        return None
    from twostage_servo.config.named_socket import socket_named_in

    with configuration_problems():
        return socket_named_in(path)


def _status(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        status = client.request(op="status")
        if options.recording is not None:
            recording = client.request(op="recording")
            _write_csv(options.recording, recording["fields"], recording["records"])
    if options.json:
        print_json(status)
    else:
        print_line(describe(status))
    reports = reports_of(status).values()
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
                print_line(lines_of(snapshot))
    return ExitCode.DONE


def _arm(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        client.request(op="arm")
        return _finish(options, _wait_while(client, {"arming", "stopping"}))


def _disarm(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        client.request(op="disarm")
        return _finish(options, _wait_while(client, _BRAKING), disabled=True)


def _stop(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        try:
            client.request(op="stop", quick=options.quick)
        except CommandError as error:
            if error.code != "disarmed":
                raise
            note(f"twostage-servo stop: {error}")  # it is as it should be, if the drive is off
            return _finish(options, _wait_while(client, _BRAKING), disabled=True)
        return _finish(options, _wait_while(client, _BRAKING))


def _jog(options: argparse.Namespace) -> ExitCode:
    if options.seconds is not None and not 0.0 <= options.seconds < 1e6:
        raise CommandError(ExitCode.USAGE, "usage", f"--seconds {options.seconds}: from 0 to 1e6 s are possible")
    try:
        with _connect(options) as client:
            is_whole = _renew_jog(client, options)
            code = _finish(options, _wait_while(client, _BRAKING))
            return code if is_whole else ExitCode.FAILED
    except KeyboardInterrupt:
        note("")
    # A connection of its own: Ctrl-C may have come between a request and its answer.
    with _connect(options) as client:
        if client.request(op="status")["axis"]["state"] == "jogging":
            client.request(op="stop")
        return _finish(options, _wait_while(client, _BRAKING))


def _renew_jog(client: "Client", options: argparse.Namespace) -> bool:
    """Ask for a jog until its time is over; return whether it was, or the limit reached, and nothing else ended it."""
    import time

    progress = Progress(quiet=options.json)
    answer = client.request(op="jog", velocity=options.velocity)
    number = answer["move"]["number"]
    is_over = False
    end_s = math.inf if options.seconds is None else time.monotonic() + options.seconds
    try:
        while _is_moving(answer, number):
            progress.show(line_of(answer))
            if is_over := (left_s := end_s - time.monotonic()) <= 0.0:
                break
            time.sleep(min(_JOG_INTERVAL_S, left_s))
            # Looks before it asks again: a jog that a limit or another client has ended is not begun anew.
            answer = client.request(op="status")
            if answer["axis"]["state"] == "jogging" and _is_moving(answer, number):
                answer = client.request(op="jog", velocity=options.velocity)
    finally:
        progress.end()
    if answer["axis"]["state"] == "jogging" and _is_latest(answer, number):
        client.request(op="stop")
    return is_over or (_is_latest(answer, number) and answer["move"]["outcome"] == "reached")


def _is_latest(answer: "Answer", number: int) -> bool:
    """Whether a move is still the one that is told of: another one, or arming anew, ends that."""
    return answer["move"] is not None and answer["move"]["number"] == number


def _is_moving(answer: "Answer", number: int) -> bool:
    return _is_latest(answer, number) and answer["move"]["outcome"] == "moving"


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
        if options.force:
            client.request(op="preempt")
        answer = client.request(op="release")
    if (holder := answer["lease"]["holder"]) is not None:
        text = f"{holder} commands this axis: `release --force` takes authority from it while the axis is at rest."
        raise CommandError(ExitCode.FAILED, RefusalCode.LEASE_HELD, text)
    return _finish(options, answer)


def _reload(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        client.be_patient(LONGEST_RELOAD_S)
        return _finish(options, client.request(op="reload"))


def _reset(options: argparse.Namespace) -> ExitCode:
    with _connect(options) as client:
        client.request(op="reset")
        return _finish(options, _wait_while(client, set()), disabled=True)


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
    numbers = {
        name: report["move"]["number"] for name, report in reports_of(begun).items() if not names or name in names
    }
    snapshot: Answer = {}
    try:
        for snapshot in client.watch(5):
            reports = {name: reports_of(snapshot)[name] for name in numbers}
            progress.show("  ".join(map(progress_line, reports.values())))
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
        return bool(states_of(seen) & states) or any(one["drive"]["disabling"] for one in reports_of(seen).values())

    status = client.request(op="status")
    if goes_on(status):
        status = next(seen for seen in client.watch(1) if not goes_on(seen))
    return {"ok": True} | status


def _finish(options: argparse.Namespace, status: "Answer", *, moved: bool = False, disabled: bool = False) -> ExitCode:
    """Show how the axes are, and return what that means for a verb that moved them or disabled their drives."""
    if options.json:
        print_json(status)
    else:
        print_line(lines_of(status))
    reports = reports_of(status).values()
    if options.verb == "arm" and states_of(status) != {"holding"}:
        return ExitCode.FAILED
    not_reached = moved and any(one["move"] and one["move"]["outcome"] in {"stopped", "tripped"} for one in reports)
    unseen = [one for one in reports if disabled and one["axis"]["state"] in _DISABLED and unheard_of(one)]
    for one in () if options.json else unseen:
        print_line(
            f"{one['axis']['name']}: it is not known whether the drive is off; its own command time-out has to have "
            "stopped it. Look at the axis, and ask again when the drive is heard"
        )
    if options.verb == "disarm":  # a trip has disabled the drive as well
        return ExitCode.FAILED if unseen or any(map(_may_be_enabled, reports)) else ExitCode.DONE
    failed = any(one["trip"] or _may_be_enabled(one) for one in reports) or not_reached or bool(unseen)
    return ExitCode.FAILED if failed else ExitCode.DONE


def _may_be_enabled(status: "Answer") -> bool:
    """Whether the drive of a disabled axis says that it is enabled, or two things at once; also if it is silent now."""
    disabled = status["axis"]["state"] in _DISABLED
    return disabled and bool(status["drive"]["enabled"] or status["drive"]["lasting"])
