# PYTHON_ARGCOMPLETE_OK
"""``twostage-servo``: the verbs, and what is common to them."""

import argparse
import functools
import os
import sys
from collections.abc import Mapping, Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, NoReturn, TextIO, TypeAlias

from twostage_servo.cli import operate
from twostage_servo.cli.output import CommandError, ExitCode, note, print_json
from twostage_servo.printable import printable
from twostage_servo.version import __version__

if TYPE_CHECKING:
    _Verbs: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # noqa: SLF001 - it has no public name

_EPILOG = """\
exit codes: 0 done, 1 its output cannot be written, or a defect, 2 bad usage or configuration, 3 the axis tripped or
did not carry out the command, 4 no service answers, 130 interrupted
start here: twostage-servo demo
"""


LONG_RUNNING: Final = ("run", "drive")
"""The verbs of :mod:`twostage_servo.cli.serve`."""


class _Parser(argparse.ArgumentParser):
    """Repeats what it was given, which may be anything, only in characters that a terminal shows; or in JSON."""

    def __init__(self, *, as_json: bool = False, **settings: Any) -> None:
        super().__init__(**settings)
        self._as_json = as_json

    def error(self, message: str) -> NoReturn:
        if self._as_json:
            _print_error("usage", message, {})
            self.exit(ExitCode.USAGE)
        super().error(message)

    def _print_message(self, message: str, file: "IO[str] | None" = None) -> None:  # type: ignore[override]
        super()._print_message(printable(message), file)


def build_parser(verb: str | None = None, *, as_json: bool = False) -> argparse.ArgumentParser:
    """Return the parser of the whole command line.

    Parameters
    ----------
    verb
        The one that is going to be parsed, if that is known. With one of the operator's, no other is declared. With
        one that runs for long, only those are: all of them take 10 ms of the service's start.
    as_json
        Whether to print one JSON object about bad usage, as about any other error.
    """
    parser = _Parser(
        as_json=as_json,
        prog="twostage-servo",
        description="Two-stage servo control over CAN: the service, its simulated drive, and the commands to both.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"twostage-servo {__version__}")
    of_a_verb: type[_Parser] = functools.partial(_Parser, as_json=as_json)  # type: ignore[assignment]  # argparse calls it
    verbs: _Verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True, parser_class=of_a_verb)
    if verb in operate.VERBS:
        operate.add_verbs(verbs, verb)
        return parser
    from twostage_servo.cli import serve

    if verb in LONG_RUNNING:
        serve.add_verbs(verbs)
        return parser
    from twostage_servo.cli import check, demo, design, faults, host, install_service, paper

    for group in (demo, serve, check, design, host, faults, paper, operate, install_service):
        group.add_verbs(verbs)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; return its exit code."""
    _prepare_streams()
    # Our matrices are of order 6 at most: numpy's threads would only wait for each other, and for a busy core.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(build_parser())
    given = sys.argv[1:] if arguments is None else arguments
    options = build_parser(given[0] if given else None, as_json=_asks_for_json(given)).parse_args(given)
    try:
        return int(options.run(options))
    except CommandError as error:
        if error.code == "output":
            _discard_output()
        elif options.json:
            _print_error(error.code, str(error), error.details)
            return error.exit_code
        note(f"twostage-servo {options.verb}: {error}")
        return error.exit_code
    except BrokenPipeError:  # whoever read our output has enough
        _discard_output()
        return ExitCode.DONE
    except KeyboardInterrupt:
        return 130


def _asks_for_json(given: Sequence[str]) -> bool:
    """Whether --json is among arguments that are not parsed yet; argparse takes its beginning for it as well."""
    return any(len(one) > len("--") and "--json".startswith(one) for one in given)


def _print_error(code: str, message: str, details: Mapping[str, Any]) -> None:
    print_json({"ok": False, "error": {"code": code, "message": message, **details}})


def _prepare_streams() -> None:
    """Let nothing that is printed fail: for want of stdout or stderr, or of a character in their encoding."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, _nowhere())
        elif isinstance(stream := getattr(sys, name), TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without µ shows a question mark


def _discard_output() -> None:
    """Keep the interpreter's last flush from failing once more."""
    sys.stdout = _nowhere()


def _nowhere() -> TextIO:
    return Path(os.devnull).open("w", encoding="utf-8")


def entry_point() -> None:
    """Console script."""
    sys.exit(main())
