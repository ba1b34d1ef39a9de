"""Processes that compute a share of something, and must not stay when the one that began them is gone."""

import multiprocessing
import os
import threading
from multiprocessing.connection import wait
from typing import Final

_ORPHANED: Final = 1
"""Exit code of a process whose parent is gone; nobody is there to read it."""


def end_with_parent() -> None:
    """End this process as soon as the one that began it has ended, in whatever way; a pool's ``initializer``.

    A worker of a pool waits for its next task on a pipe of which it holds the other end as well: where its parent is
    killed, it would wait for ever.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_outlive, args=(parent.sentinel,), name="parent", daemon=True).start()


def _outlive(parent: int) -> None:
    wait([parent])
    os._exit(_ORPHANED)
