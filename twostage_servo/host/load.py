"""Load on every processor, to measure a host at its worst: processes of our own, which end with us."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

_HOG = """\
import os, sys
parent = int(sys.argv[1])
while os.getppid() == parent:
    sum(range(100000))
"""
"""Ends as well if it has lost its parent, which may have been killed."""


@contextlib.contextmanager
def processor_load(count: int | None = None) -> Iterator[int]:
    """Keep processors busy while the context lasts.

    Parameters
    ----------
    count
        Number of busy processes; by default one for each CPU that this process may use.

    Yields
    ------
    int
        Their number.
    """
    count = len(os.sched_getaffinity(0)) if count is None else count
    hogs: list[subprocess.Popen[bytes]] = []
    try:
        for _ in range(count):
            hogs.append(  # noqa: PERF401 - what has been started must be known even if the next one fails
                subprocess.Popen(  # noqa: S603 - our own interpreter and text
                    [sys.executable, "-I", "-S", "-c", _HOG, str(os.getpid())],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )
        yield count
    finally:
        for hog in hogs:
            hog.kill()
        for hog in hogs:
            hog.wait()
