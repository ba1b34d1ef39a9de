"""A process of the fault campaign: a service or its drives, but that it dies with whoever started it, and can hang.

``python -m twostage_servo.faults.child PARENT run|drive CONFIG KEY=VALUE...``, with the process id of the parent. It
prints what became of it as one JSON object. On SIGUSR1 the main thread spins for ever: the loop of the service hangs as
it would in a defect.
"""

import argparse
import ctypes
import json
import os
import resource
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from twostage_servo.api.fields import JsonObject
from twostage_servo.printable import printable_json

if TYPE_CHECKING:
    from twostage_servo.service.ending_signals import EndingSignals

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_FAILED = 3


def die_with(parent: int) -> None:
    """Let this process be killed when its parent, of the given process id, ends; at once if it has ended already.

    The campaign may be killed itself, and nothing that drives an axis must be left running then.
    """
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def leave_no_core() -> None:
    """Let SIGABRT leave no file: with a limit of 1 byte Linux neither writes a core nor feeds a collector of cores."""
    _, most = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (0 if most == 0 else 1, most))


def hang(*_: object) -> None:
    """Never return."""
    while True:
        pass


def main(arguments: Sequence[str]) -> int:
    """Run a service or its drives; return the exit code of the process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parent", type=int)
    parser.add_argument("verb", choices=("run", "drive"))
    parser.add_argument("config", type=Path)
    parser.add_argument("overrides", nargs="*")
    options = parser.parse_args(arguments)
    die_with(options.parent)
    leave_no_core()
    signal.signal(signal.SIGUSR1, hang)
    # What follows takes a while, and the parent may die in it.
    from twostage_servo.service.ending_signals import EndingSignals  # noqa: PLC0415

    with EndingSignals() as signals:
        code = _run(options, signals)
        return signals.exit_code or code


def _run(options: argparse.Namespace, signals: "EndingSignals") -> int:
    from twostage_servo.app.serve import serve  # noqa: PLC0415 - likewise
    from twostage_servo.app.simulate import simulate  # noqa: PLC0415
    from twostage_servo.config.machine import load_machine  # noqa: PLC0415

    machine = load_machine(options.config, options.overrides)
    if options.verb == "run":
        served = serve(machine, signals, options.config, options.overrides)
        _tell(served.snapshot)
        return _FAILED if served.not_disabled else 0
    _tell(simulate(machine, signals)[0])
    return 0


def _tell(result: JsonObject) -> None:
    """Print what came of it, for the parent."""
    print(printable_json(json.dumps(result)), flush=True)  # noqa: T201 - to a file, as an object of JSON


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
