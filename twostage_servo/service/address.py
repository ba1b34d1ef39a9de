"""Where the control socket lies. Imported by the command line, so it imports next to nothing."""

import os
import stat
from pathlib import Path

SYSTEM_SOCKET = Path("/run/twostage-servo/control.sock")
ENVIRONMENT_VARIABLE = "TWOSTAGE_SERVO_SOCKET"


def own_socket() -> Path:
    """Return the path at which a service listens whose config names none.

    The service manager's runtime folder if it gave one, else the user's own runtime folder, else a private folder in
    the temporary directory.
    """
    if named := os.environ.get(ENVIRONMENT_VARIABLE):
        return Path(named)
    if given := os.environ.get("RUNTIME_DIRECTORY"):
        return Path(given.split(":", maxsplit=1)[0]) / "control.sock"
    if given := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(given) / "twostage-servo" / "control.sock"
    return Path("/tmp") / f"twostage-servo-{os.getuid()}" / "control.sock"  # noqa: S108 - prepare_folder checks the owner


def find_socket() -> Path:
    """Return the path that a client tries: the user's own service, else the system's."""
    own = own_socket()
    return own if _is_there(own) or not _is_there(SYSTEM_SOCKET) else SYSTEM_SOCKET


def _is_there(path: Path) -> bool:
    """Whether there is something at a path, or a folder in between that one may not enter: connecting tells which."""
    try:
        path.stat()
    except PermissionError:
        return True
    except OSError:
        return False
    return True


def prepare_folder(socket: Path) -> None:
    """Make the socket's folder, for its owner alone unless it is there already.

    Raises
    ------
    PermissionError
        If the folder belongs to somebody else who could exchange the socket in it.
    """
    folder = socket.parent
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.stat()
    owned = status.st_uid in {os.getuid(), 0}
    writable_by_all = status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX
    if not owned or writable_by_all:
        reason = "is writable by everybody" if owned else f"is user {status.st_uid}'s"
        raise PermissionError(f"the folder {folder} of the control socket {reason}; set service.socket to another path")
