"""What the operator's verbs do: each asks the service as any other client does, and tells what has come of it."""

import argparse
import contextlib
import itertools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from twostage_servo.api.status import AxisReport, Recording, Status
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.state import ENABLED, State
from twostage_servo.cli.axis_text import describe, line_of, lines_of, progress_line, unheard_of
from twostage_servo.cli.configuration import configuration_problems
from twostage_servo.cli.output import CommandError, ExitCode, Progress, note, print_json, print_line
from twostage_servo.cli.result_file import as_csv, write_result
from twostage_servo.client.blocking import ServoClient, connect
from twostage_servo.client.errors import ConfigError, Interrupted, Refused, ServoError, Tripped, Unreachable
from twostage_servo.config.files import find_configuration

BAD_USAGE: Final = frozenset(
    {
        RefusalCode.BAD_REQUEST, RefusalCode.POSITION_LIMIT, RefusalCode.VELOCITY_LIMIT, RefusalCode.WHICH_AXIS,
        RefusalCode.CONFIG,
    }
)  # fmt: skip
"""Refusals for which the request or the configuration alone is to blame, whatever the axis does."""
_WITHOUT_PLACE: Final = frozenset({"arm", "jog"})
"""Verbs that name no position: one that is beyond the limits is the axis' own."""


def run(options: argparse.Namespace) -> ExitCode:
    """Carry out the verb that the arguments name.

    Raises
    ------
    CommandError
        If the service refuses it, or none answers.
    """
    try:
        return _VERBS[options.verb](options)
    except ServoError as error:
        raise _command_error(error, options.verb) from error


def _command_error(error: ServoError, verb: str) -> CommandError:
    if isinstance(error, Unreachable):
        return CommandError(ExitCode.UNREACHABLE, error.code, str(error))
    if isinstance(error, ConfigError):
        return CommandError(ExitCode.USAGE, error.code, str(error))
    of_the_axis = verb in _WITHOUT_PLACE and error.code == RefusalCode.POSITION_LIMIT
    is_bad_usage = isinstance(error, Refused) and error.code in BAD_USAGE and not of_the_axis
    return CommandError(ExitCode.USAGE if is_bad_usage else ExitCode.FAILED, error.code, str(error))


def _bad_usage(text: str) -> CommandError:
    return CommandError(ExitCode.USAGE, "usage", text)


@contextlib.contextmanager
def _connected(options: argparse.Namespace) -> Iterator[ServoClient]:
    """Connect; leaving on purpose is not dying: what was asked for goes on, however the verb ends."""
    client = connect(options.socket or _socket_of(options.config), getattr(options, "axis", None))
    with contextlib.closing(client):
        yield client


def _socket_of(config: Path | None) -> Path | None:
    path = find_configuration(config)
    if path is None:
        return None
    from twostage_servo.config.named_socket import socket_named_in

    with configuration_problems():
        return socket_named_in(path)


# Looking --------------------------------------------------------------------------------------------------------------


def _status(options: argparse.Namespace) -> ExitCode:
    with _connected(options) as client:
        status = client.status()
        if options.recording is not None:
            _write_recording(options.recording, client.recording())
    if options.json:
        _print_status(status)
    else:
        print_line(describe(status))
    is_well = all(report.trip is None and not report.drive.lasting for report in status.axes.values())
    return ExitCode.DONE if is_well else ExitCode.FAILED


def _write_recording(path: Path, recording: Recording) -> None:
    write_result(path, as_csv([recording.fields, *recording.records]), "recording")
    note(f"{len(recording.records)} ticks written to {path}")


def _watch(options: argparse.Namespace) -> ExitCode:
    if not 1 <= options.every <= 10_000:
        raise _bad_usage(f"--every {options.every}: must be from 1 to 10000 ticks")
    if options.count is not None and options.count < 1:
        raise _bad_usage(f"--count {options.count}: must be at least 1 line")
    with _connected(options) as client, contextlib.closing(client.watch(options.every)) as snapshots:
        for status in itertools.islice(snapshots, options.count):
            if options.json:
                print_json(status.to_json())
            else:
                print_line(lines_of(status))
    return ExitCode.DONE


# Commands -------------------------------------------------------------------------------------------------------------


def _arm(options: argparse.Namespace) -> ExitCode:
    with _connected(options) as client:
        return _finish(options, _even_if_ended(client.arm))


def _disarm(options: argparse.Namespace) -> ExitCode:
    with _connected(options) as client:
        return _finish(options, client.disarm(), disabled=True)


def _stop(options: argparse.Namespace) -> ExitCode:
    with _connected(options) as client:
        try:
            return _finish(options, client.stop(quick=options.quick))
        except Refused as error:
            if error.code is not RefusalCode.DISARMED:
                raise
            note(f"twostage-servo stop: {error}")  # it is as it should be, if the drive is off
            return _finish(options, client.wait_until_settled(), disabled=True)


def _jog(options: argparse.Namespace) -> ExitCode:
    if options.seconds is not None and not 0.0 <= options.seconds < 1e6:
        raise _bad_usage(f"--seconds {options.seconds}: must be from 0 to 1e6 s")
    progress = Progress(quiet=options.json)
    seconds = math.inf if options.seconds is None else options.seconds
    try:
        with _connected(options) as client, _ended(progress):
            try:
                status = client.jog(options.velocity, seconds, progress=lambda seen: progress.show(line_of(seen.only)))
            except (Tripped, Interrupted) as error:
                _finish(options, error.status)
                return ExitCode.FAILED
        return _finish(options, status)
    except KeyboardInterrupt:
        note("")
    # A connection of its own: Ctrl-C may have come between a request and its answer.
    with _connected(options) as client:
        if client.status().axis.state is State.JOGGING:
            client.stop()
        return _finish(options, client.wait_until_settled())


def _override(options: argparse.Namespace) -> ExitCode:
    with _connected(options) as client:
        return _finish(options, client.override(options.percent))


def _home(options: argparse.Namespace) -> ExitCode:
    with _connected(options) as client:
        if options.here is not None:
            return _finish(options, client.home(options.here))
        status = _followed(options, lambda show: client.home(progress=show))
        return _finish(options, status, moved=True)


def _release(options: argparse.Namespace) -> ExitCode:
    with _connected(options) as client:
        if options.force:
            client.acquire(preempt=True)
        status = client.release()
    if (holder := status.service.authority.holder) is not None:
        text = f"{holder} commands this axis: `release --force` takes authority from it while the axis is at rest."
        raise CommandError(ExitCode.FAILED, RefusalCode.AUTHORITY_HELD, text)
    return _finish(options, status)


def _reload(options: argparse.Namespace) -> ExitCode:
    with _connected(options) as client:
        return _finish(options, client.reload())


def _reset(options: argparse.Namespace) -> ExitCode:
    with _connected(options) as client:
        return _finish(options, client.reset(), disabled=True)


def _forget(options: argparse.Namespace) -> ExitCode:
    with _connected(options) as client:
        status = client.forget()
    for name, report in status.axes.items():
        if report.law.file_error:
            note(f"twostage-servo forget: axis {name}: {report.law.file_error}")
    return _finish(options, status)


def _move(options: argparse.Namespace) -> ExitCode:
    wanted = _wanted(options)
    names = list(wanted) if isinstance(wanted, dict) else []

    def ask(show: Callable[[Status], None] | None) -> Status:
        if wanted is None:
            return client.move_by(options.by, options.velocity, wait=options.wait, progress=show)
        return client.move(wanted, options.velocity, wait=options.wait, progress=show)

    with _connected(options) as client:
        status = _followed(options, ask, names) if options.wait else ask(None)
    return _finish(options, status, moved=True)


def _wanted(options: argparse.Namespace) -> float | dict[str, float] | None:
    """Return the set-point that was asked for, or those of several axes by their names; None if it is relative."""
    positions: list[tuple[str | None, float]] = options.position
    names = [name for name, _ in positions]
    if (len(names) == 0) == (options.by is None) or (None in names and len(names) > 1):
        raise _bad_usage("give one position, or NAME=POSITION for each of several axes, or --by DISTANCE")
    if twice := next((name for number, name in enumerate(names) if name in names[:number]), None):
        raise _bad_usage(f"{twice} is given twice: give one set-point for each axis")
    if names == [None]:
        return positions[0][1]
    wanted = {name: position for name, position in positions if name is not None}
    if wanted and options.axis is not None:
        raise _bad_usage(f"the set-points name their axes ({', '.join(wanted)}): leave --axis {options.axis} out")
    return wanted or None


def _followed(
    options: argparse.Namespace, verb: Callable[[Callable[[Status], None]], Status], names: list[str] | None = None
) -> Status:
    """Show progress until a motion has ended; return the status of then, whatever it has come to."""
    progress = Progress(quiet=options.json)

    def show(status: Status) -> None:
        progress.show("  ".join(progress_line(report) for name, report in status.axes.items() if name in shown))

    shown = names or _Every()
    with _ended(progress):
        try:
            return _even_if_ended(lambda: verb(show))
        except Interrupted as error:  # by another one
            text = "another client's set-point has replaced this one"
            details = {"status": error.status.to_json()}
            raise CommandError(ExitCode.FAILED, error.code, text, details) from error
        except KeyboardInterrupt:
            note("\nno longer watching; the axis continues to its set-point. `twostage-servo stop` stops it.")
            raise


class _Every:
    """Contains every name."""

    def __contains__(self, _: object) -> bool:
        return True


def _even_if_ended(verb: Callable[[], Status]) -> Status:
    """Return what a verb comes to, also where a trip or a stop has ended it."""
    try:
        return verb()
    except Tripped as error:
        return error.status
    except Interrupted as error:
        if error.outcome is MoveOutcome.REPLACED:
            raise
        return error.status


@contextlib.contextmanager
def _ended(progress: Progress) -> Iterator[None]:
    try:
        yield
    finally:
        progress.end()


# What is shown, and what it means -------------------------------------------------------------------------------------


def _print_status(status: Status) -> None:
    print_json({"ok": True} | status.to_json())


def _finish(options: argparse.Namespace, status: Status, *, moved: bool = False, disabled: bool = False) -> ExitCode:
    """Show how the axes are, and return what that means for a verb that moved them or disabled their drives."""
    if options.json:
        _print_status(status)
    else:
        print_line(lines_of(status))
    reports = status.axes.values()
    if options.verb == "arm" and any(one.axis.state is not State.HOLDING for one in reports):
        return ExitCode.FAILED
    unseen = [one for one in reports if disabled and one.axis.state not in ENABLED and unheard_of(one)]
    for one in () if options.json else [one for one in unseen if not one.drive.lasting]:  # which says it already
        print_line(
            f"{one.axis.name}: nobody knows whether the drive is off; its own command time-out should have "
            "stopped it. Look at the axis, and check `status` when the drive responds again"
        )
    if options.verb == "disarm":  # a trip has disabled the drive as well
        return ExitCode.FAILED if unseen or any(map(_may_be_enabled, reports)) else ExitCode.DONE
    not_reached = moved and any(map(_has_not_arrived, reports))
    failed = any(one.trip or _may_be_enabled(one) for one in reports) or not_reached or bool(unseen)
    return ExitCode.FAILED if failed else ExitCode.DONE


def _has_not_arrived(report: AxisReport) -> bool:
    return report.move is not None and report.move.outcome in {MoveOutcome.STOPPED, MoveOutcome.TRIPPED}


def _may_be_enabled(report: AxisReport) -> bool:
    """Whether the drive of a disabled axis says that it is enabled, or two things at once; also if it is silent now."""
    return report.axis.state not in ENABLED and bool(report.drive.enabled or report.drive.lasting)


_VERBS: Final[dict[str, Callable[[argparse.Namespace], ExitCode]]] = {
    "status": _status,
    "watch": _watch,
    "arm": _arm,
    "disarm": _disarm,
    "move": _move,
    "jog": _jog,
    "override": _override,
    "home": _home,
    "stop": _stop,
    "reset": _reset,
    "forget": _forget,
    "release": _release,
    "reload": _reload,
}
