"""The command line, that also says on SIGUSR2 what its process holds: ``PARENT REPORT VERB ...``.

The report is a file with one JSON object: ``tasks`` of the loop, also ``tasks_by_name``, ``threads``, ``descriptors``,
``resident_mb``, ``processor_s`` used so far, and the ``number`` of the request for it. The service itself writes it,
since nobody else can count its tasks.
"""

import asyncio
import gc
import itertools
import json
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from twostage_servo.cli.main import main as run_verb
from twostage_servo.faults.child import die_with

_PAGE_MB = os.sysconf("SC_PAGE_SIZE") / (1 << 20)


def report_to(path: Path) -> None:
    """Answer each SIGUSR2 with a report in a file, which appears whole."""
    numbers = itertools.count(1)

    def answer(*_: object) -> None:
        gc.collect()
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        tasks = [getattr(task.get_coro(), "__qualname__", "") for task in asyncio.all_tasks()]
        report = {
            "number": next(numbers),
            "tasks": len(tasks),
            "tasks_by_name": dict(Counter(sorted(tasks))),
            "threads": threading.active_count(),
            "descriptors": len(os.listdir("/proc/self/fd")) - 1,  # noqa: PTH208 - the one that lists them
            "processor_s": time.process_time(),
            "resident_mb": round(pages * _PAGE_MB, 3),
        }
        unfinished = path.with_suffix(".part")
        unfinished.write_text(json.dumps(report), encoding="ascii")
        unfinished.replace(path)

    signal.signal(signal.SIGUSR2, answer)


def main(arguments: Sequence[str]) -> int:
    """Run a verb; return its exit code."""
    parent, report, *verb = arguments
    die_with(int(parent))
    report_to(Path(report))
    return run_verb(verb)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
