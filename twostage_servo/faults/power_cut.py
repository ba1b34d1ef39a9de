"""Cuts the power of a process that writes trip files, again and again, and looks at the files after each time.

``python -m twostage_servo.faults.power_cut PARENT FOLDER SEED CUTS``, with the process id of the parent. A process that
is killed stands for the power cut. What the disk itself may lose is beyond this: against that stands the ``fsync``.
"""

import itertools
import json
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

from twostage_servo.axis.state import State
from twostage_servo.faults.child import die_with
from twostage_servo.telemetry.trip_files import write_file

RECORDS = 200
"""Ticks in a file: a recording of 2 s."""

_LONGEST_S = 0.05
"""A file takes some milliseconds."""


def content(number: int) -> tuple[dict[str, Any], tuple[tuple[Any, ...], ...]]:
    """Return document and records of the file with a number."""
    records = tuple((tick, number, tick * 0.1, str(State.SPEED_STAGE), None, "x" * 40) for tick in range(RECORDS))
    return {"number": number, "snapshot": {"trip": {"cause": "a power cut"}}, "fields": ["tick", "number"]}, records


def damaged(folder: Path) -> list[str]:
    """Return what is wrong with the files in a folder."""
    files = sorted(folder.glob("*.json"))
    found = [problem for path in files if (problem := _damage(path))]
    return found if files else ["there is no file at all"]


def _damage(path: Path) -> str | None:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        head, records = content(document["number"])
    except (ValueError, KeyError, TypeError) as error:
        return f"{path.name} cannot be read: {error!r}"
    head["snapshot"]["trip"]["file"] = str(path)
    whole = head | {"records": [list(record) for record in records]}
    return None if document == whole else f"{path.name} is not what was written"


def write_for_ever(folder: Path, begun: int) -> None:
    """Write one file after the other; say by a byte that the first one is there."""
    for number in itertools.count():
        write_file(folder, "x-power_cut", *content(number))
        if number == 0:
            os.write(begun, b"!")


def cut(folder: Path, delay_s: float) -> bool:
    """Kill a process that writes after a time in s; return whether it was still writing."""
    parent = os.getpid()
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        try:
            die_with(parent)
            write_for_ever(folder, writing)
        finally:
            os._exit(1)
    os.close(writing)
    os.read(reading, 1)
    os.close(reading)
    time.sleep(delay_s)
    os.kill(process, signal.SIGKILL)
    _, status = os.waitpid(process, 0)
    return os.WIFSIGNALED(status)


def main(arguments: Sequence[str]) -> int:
    """Cut the power so many times, and print what was damaged; return an exit code."""
    parent, name, seed, cuts = arguments
    die_with(int(parent))
    folder, random = Path(name), Random(int(seed))  # noqa: S311 - moments, no secrets
    found: list[str] = []
    for number in range(1, int(cuts) + 1):
        if not cut(folder, random.uniform(0.0, _LONGEST_S)):
            found.append(f"cut {number}: the writing had ended by itself")
        found += [f"cut {number}: {problem}" for problem in damaged(folder)]
    sys.stdout.write(json.dumps({"cuts": int(cuts), "damaged": found}) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
