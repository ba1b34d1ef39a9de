"""Checks of the folders that the service writes to."""

import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Final

from twostage_servo.host.findings import Finding, Status

_LEAST_BYTES: Final = 10 << 20
_SAFE_BYTES: Final = 100 << 20
"""Free space at which a full disk is near, or far: 50 trip files of the default length take some 5 MB."""


def folder_finding(
    name: str,
    folder: Path,
    setting: str,
    *,
    may_write: Callable[[Path], bool] = lambda folder: os.access(folder, os.W_OK | os.X_OK),
    free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
) -> Finding:
    """Check a folder that is made when it is needed: permissions, and the space on its disk.

    Parameters
    ----------
    name
        Of the finding.
    folder
        The folder; it need not exist.
    setting
        The configuration key that names it.
    may_write, free_bytes
        Stand in for the system in tests.
    """
    elsewhere = f"set {setting} to another path"
    try:
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        mode = existing.stat().st_mode
    except OSError as error:
        return Finding(name, Status.FAIL, f"{folder} cannot be examined: {error.strerror}", elsewhere)
    if not stat.S_ISDIR(mode):
        return Finding(name, Status.FAIL, f"{existing} is not a folder", f"remove it, or {elsewhere}")
    if existing == folder and mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
        found = f"everybody can write to {folder} and replace its files"
        return Finding(name, Status.FAIL, found, f"chmod o-w {folder}")
    if not may_write(existing):
        found = f"{folder} cannot be written" if existing == folder else f"{folder} cannot be created in {existing}"
        return Finding(name, Status.FAIL, found, f"change the owner of {existing}, or {elsewhere}")
    free = free_bytes(existing)
    found = f"{folder}{'' if existing == folder else ' (will be created)'}, {free >> 20} MiB free"
    if free >= _SAFE_BYTES:
        return Finding(name, Status.OK, found)
    status = Status.WARN if free >= _LEAST_BYTES else Status.FAIL
    return Finding(name, status, found, f"free space there, or {elsewhere}")
