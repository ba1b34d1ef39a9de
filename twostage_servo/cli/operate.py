"""The operator's verbs as they are typed; :mod:`~twostage_servo.cli.operator_verbs` carries them out."""

import argparse
import re
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from twostage_servo.cli.typed_names import file_path, utf8
from twostage_servo.cli.typed_numbers import decimal, whole

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from twostage_servo.cli.output import ExitCode

    _Verbs: TypeAlias = "argparse._SubParsersAction[Any]"  # noqa: SLF001 - argparse has no public name for it


def add_verbs(verbs: "_Verbs", only: str | None = None) -> None:
    """Declare the verbs, or only the one that is wanted: what is called by hand and in scripts is quick."""
    for verb, add in VERBS.items():
        if only in (None, verb):
            add(verbs)


def _add_status(verbs: "_Verbs") -> None:
    status = _verb(verbs, "status", "show the state of service and axis")
    status.add_argument(
        "--recording",
        type=file_path,
        metavar="FILE",
        help="write the last ticks, or those before the trip, as CSV",
    )


def _add_watch(verbs: "_Verbs") -> None:
    watch = _verb(verbs, "watch", "follow the axis live")
    watch.add_argument("--every", type=whole, default=10, metavar="TICKS", help="ticks between two lines (default 10)")
    watch.add_argument("--count", type=whole, metavar="N", help="end after N lines")


def _add_arm(verbs: "_Verbs") -> None:
    _verb(verbs, "arm", "enable the drive and hold the present position")


def _add_disarm(verbs: "_Verbs") -> None:
    _verb(verbs, "disarm", "bring the axis to rest and disable the drive")


def _add_move(verbs: "_Verbs") -> None:
    move = _verb(verbs, "move", "move to a set-point")
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


def _add_jog(verbs: "_Verbs") -> None:
    jog = _verb(verbs, "jog", "move while this command runs, or for a given time")
    jog._negative_number_matcher = re.compile(r"-\.?\d")  # noqa: SLF001 - likewise
    jog.add_argument("velocity", type=decimal, help="velocity; its sign is the direction")
    jog.add_argument("--seconds", type=decimal, metavar="S", help="end after S seconds (default: at Ctrl-C)")


def _add_override(verbs: "_Verbs") -> None:
    override = _verb(verbs, "override", "change the speed of moves and jogs, also of one under way; 0 holds the axis")
    override._negative_number_matcher = re.compile(r"-\.?\d")  # noqa: SLF001 - likewise
    override.add_argument(
        "percent",
        type=decimal,
        help="0 to 200, of the speed that is asked for and within axis.limits.velocity; 100 again after each arming",
    )


def _add_home(verbs: "_Verbs") -> None:
    home = _verb(verbs, "home", "find the reference of the positions")
    home._negative_number_matcher = re.compile(r"-\.?\d")  # noqa: SLF001 - likewise
    home.add_argument(
        "--here", type=decimal, metavar="POSITION", help="do not search: the axis stands at this position now"
    )


def _add_stop(verbs: "_Verbs") -> None:
    stop = _verb(verbs, "stop", "bring the axis, or all axes, to rest and hold them there, whoever holds authority")
    stop.add_argument("--quick", action="store_true", help="brake with axis.limits.quick_stop_deceleration")


def _add_reset(verbs: "_Verbs") -> None:
    _verb(verbs, "reset", "clear a trip; the axis is disarmed afterwards")


def _add_forget(verbs: "_Verbs") -> None:
    _verb(verbs, "forget", "make the law forget what it has learned of its plant; only while the axis is at rest")


def _add_release(verbs: "_Verbs") -> None:
    release = _verb(verbs, "release", "release your control authority")
    release.add_argument(
        "--force", action="store_true", help="also take it from another client; only while the axis is at rest"
    )


def _add_reload(verbs: "_Verbs") -> None:
    _verb(verbs, "reload", "make the service read its configuration again; only while the axis is disarmed")


VERBS: "Final[Mapping[str, Callable[[_Verbs], None]]]" = {
    "status": _add_status,
    "watch": _add_watch,
    "arm": _add_arm,
    "disarm": _add_disarm,
    "move": _add_move,
    "jog": _add_jog,
    "override": _add_override,
    "home": _add_home,
    "stop": _add_stop,
    "reset": _add_reset,
    "forget": _add_forget,
    "release": _add_release,
    "reload": _add_reload,
}


def _verb(verbs: "_Verbs", name: str, text: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    if name not in {"release", "reload"}:
        parser.add_argument("--axis", type=utf8, metavar="NAME", help="which axis, where the service has several")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--socket", type=file_path, metavar="PATH", help="control socket of the service")
    where.add_argument("--config", type=file_path, metavar="FILE", help="configuration that names the socket")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=_run)
    return parser


def _set_point(text: str) -> tuple[str | None, float]:
    name, equals, number = text.rpartition("=")
    try:
        return (utf8(name) if equals else None), decimal(number)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{text}: {error}" if equals else str(error)) from error


def _run(options: argparse.Namespace) -> "ExitCode":
    import gc

    gc.disable()  # what is imported stays: to look for garbage in it takes longer than to ask the service
    from twostage_servo.cli import operator_verbs

    gc.enable()
    return operator_verbs.run(options)
