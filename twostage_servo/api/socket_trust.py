"""Whose a control socket is: another user of this machine must not be able to answer in the service's place.

Used by both sides. Imported by the command line, so it imports next to nothing.

Anybody may make a folder in the shared temporary folder before its rightful owner does, and serve a socket in it. So
each folder on the way to a socket has to belong to root, to whoever looks, or to the server's user; a folder in which
others may make entries is trusted for no entry but root's and one's own, and no symbolic link in it is followed. A
server is believed if the kernel says (``SO_PEERCRED``) that it is run by the user whose socket and folder they are.
"""

import os
import socket
import stat
import struct
from pathlib import Path
from typing import Final, NamedTuple

_ROOT: Final = 0
_MOST_LINKS: Final = 40
"""As many symbolic links as the kernel follows on one way."""
_INITIAL_NAMESPACE: Final = [b"0", b"0", b"4294967295"]
_UNSENT: Final = "Nothing was sent. Find out who made it, and name the service's socket with --socket"


class UntrustedSocketError(PermissionError):
    """Another user could answer at a control socket. The text says who, and what to do."""


class Entry(NamedTuple):
    """The last entry on a way, and what the folders above it are like.

    Attributes
    ----------
    path
        Where it is, without symbolic links; its last part may be missing.
    owner
        User id of the entry; None if it is missing.
    folder_owner
        User id of the folder that it lies in.
    in_open_folder
        Whether everybody may make entries in that folder, and only remove their own.
    strangers
        Folders on the way that are neither root's nor those of whoever looks, by the user id of their owners.
    """

    path: Path
    owner: int | None
    folder_owner: int
    in_open_folder: bool
    strangers: dict[int, Path]


def check_way(path: Path) -> Entry:
    """Follow a path from the root, and check that nobody but the owners of its folders could lead it elsewhere.

    Raises
    ------
    UntrustedSocketError
        If somebody else could.
    OSError
        If a folder on the way is missing, or cannot be looked at.
    """
    own = {_ROOT, os.geteuid()}
    strangers: dict[int, Path] = {}
    names = list(reversed(path.absolute().parts[1:]))
    here, links = Path("/"), 0
    while True:
        folder = here.lstat()
        _check_folder(here, folder)
        if folder.st_uid not in own | _unmapped():
            strangers.setdefault(folder.st_uid, here)
        entry = here.parent if names[-1] == ".." else here / names[-1]
        try:
            there = entry.lstat()
        except FileNotFoundError:
            if names[1:]:
                raise
            return Entry(entry, None, folder.st_uid, _is_open(folder), strangers)
        if _is_shared(folder) and names[-1] != "..":
            _check_shared_entry(entry, there, own if _is_open(folder) else own | {folder.st_uid})
        names.pop()
        if stat.S_ISLNK(there.st_mode):
            links += 1
            if links > _MOST_LINKS:
                raise UntrustedSocketError(
                    f"{path} leads over more than {_MOST_LINKS} symbolic links: use another path"
                )
            target = entry.readlink()
            names += reversed(target.parts[1:] if target.is_absolute() else target.parts)
            here = Path("/") if target.is_absolute() else here
        elif names:
            here = entry
        else:
            return Entry(entry, there.st_uid, folder.st_uid, _is_open(folder), strangers)


def check_folder(path: Path) -> None:
    """Check, as a service, the folder of the own socket, which has to be there.

    Raises
    ------
    UntrustedSocketError
        If another user could exchange the socket, or clients could not tell it from another user's.
    OSError
        If it cannot be looked at.
    """
    entry, user = check_way(path), os.geteuid()
    folder = entry.path.parent
    for stranger, on_the_way in entry.strangers.items():
        if on_the_way != folder:
            raise UntrustedSocketError(
                f"{on_the_way}, on the way to the control socket, is {_named(stranger)}'s, who could put another "
                "socket there; set service.socket to a path below folders of root and of the service's own user"
            )
    # In a folder that is open to everybody the socket's owner decides, and nobody else can remove it.
    if entry.folder_owner != user and not entry.in_open_folder:
        raise UntrustedSocketError(
            f"the folder {folder} of the control socket is {_named(entry.folder_owner)}'s, and the service runs as "
            f"{_named(user)}: give it the folder (`chown {user} {folder}`), or set service.socket to another path"
        )


def check_server(connection: socket.socket, path: Path) -> None:
    """Check, as a client, that whoever answers is the one whose socket it is.

    Parameters
    ----------
    connection
        Connected to the socket.
    path
        Its path.

    Raises
    ------
    UntrustedSocketError
        If it is not; nothing must be sent then.
    OSError
        If the path cannot be looked at.
    """
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    process, server, _ = struct.unpack("3i", credentials)
    entry = check_way(path)
    for stranger, folder in entry.strangers.items():
        if stranger != server:
            raise UntrustedSocketError(
                f"{folder}, on the way to {path}, is {_named(stranger)}'s, but process {process} of {_named(server)} "
                f"answers there: it may be an impostor of the service. {_UNSENT}"
            )
    # One that has just been removed, or is being made again, was where only its folder's owner could put it.
    is_the_owners = entry.owner == server or (entry.owner is None and not entry.in_open_folder)
    if not is_the_owners or not (entry.folder_owner == server or entry.in_open_folder):
        owner = "gone" if entry.owner is None else f"{_named(entry.owner)}'s"
        raise UntrustedSocketError(
            f"process {process} of {_named(server)} answers, but the socket is {owner} and its folder "
            f"{_named(entry.folder_owner)}'s: both have to be the service's own user's. {_UNSENT}"
        )


def find_distrust(path: Path) -> UntrustedSocketError | None:
    """Return why what lies at a path may be another user's, or None; also where one may not enter a folder."""
    try:
        check_way(path)
    except UntrustedSocketError as error:
        return error
    except OSError:  # missing, or not to be entered, which is another matter
        return None
    return None


def _check_folder(folder: Path, status: os.stat_result) -> None:
    if _is_open(status) and not status.st_mode & stat.S_ISVTX:
        raise UntrustedSocketError(
            f"the folder {folder}, on the way to the control socket, is writable by everybody, who could put another "
            f"socket there: `chmod o-w {folder}`, or use another path (--socket, service.socket)"
        )


def _check_shared_entry(entry: Path, there: os.stat_result, trusted: set[int]) -> None:
    if there.st_uid not in trusted:
        raise UntrustedSocketError(
            f"{entry} is {_named(there.st_uid)}'s, and others may make entries in {entry.parent}: what lies there may "
            "be an impostor of the service. Nothing was sent. Remove it, or use another path (--socket, service.socket)"
        )
    if stat.S_ISLNK(there.st_mode):
        raise UntrustedSocketError(
            f"{entry} is a symbolic link in a folder in which others may make entries, and is not followed: use the "
            "path that it leads to (--socket, service.socket)"
        )


def _is_open(status: os.stat_result) -> bool:
    return bool(status.st_mode & stat.S_IWOTH)


def _is_shared(status: os.stat_result) -> bool:
    """Whether others than its owner may make entries; a user's private group, of the same number, is nobody else."""
    return _is_open(status) or bool(status.st_mode & stat.S_IWGRP and status.st_gid != status.st_uid)


_OVERFLOW_UID = 65534
"""The kernel's own choice of that user, where /proc does not tell another one."""


def _unmapped() -> set[int]:
    """Return the user id that stands for all users outside of this user namespace, root among them; none without one.

    They cannot be told apart there, so a folder of theirs on the way is taken for the host's own. It is no exception
    for an entry of a folder in which others may make some.
    """
    try:
        if Path("/proc/self/uid_map").read_bytes().split() == _INITIAL_NAMESPACE:
            return set()
    except OSError:
        return set()
    try:
        return {int(Path("/proc/sys/kernel/overflowuid").read_bytes())}
    except OSError:  # the service's unit hides it (ProcSubset=pid)
        return {_OVERFLOW_UID}


def _named(user: int) -> str:
    return "root" if user == _ROOT else f"user {user}"
