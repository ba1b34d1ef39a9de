"""A process of the fault campaign: the command line as always, but that it dies with whoever started it, and can hang.

``python -m twostage_servo.faults.child PARENT VERB ...``, with the process id of the parent. On SIGUSR1 the main thread
spins for ever: the loop of the service hangs as it would in a defect.
"""

import ctypes
import os
import resource
import signal
import sys
from collections.abc import Sequence

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


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
    """Run a verb; return its exit code."""
    parent, *verb = arguments
    die_with(int(parent))
    leave_no_core()
    signal.signal(signal.SIGUSR1, hang)
    from twostage_servo.cli.main import main as run_verb  # noqa: PLC0415 - takes a while, and the parent may die in it

    return run_verb(verb)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
