"""Where the control socket lies. Imported by the command line, so it imports next to nothing."""

import os
from pathlib import Path

from twostage_servo.api.socket_trust import check_folder, find_distrust

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
    """Return the path that a client tries: the user's own service, else the system's.

    What another user has put in the place of the own socket is nobody's service, and does not hide the system's.
    """
    own = own_socket()
    is_own = _is_there(own) and (ENVIRONMENT_VARIABLE in os.environ or find_distrust(own) is None)
    return own if is_own or not _is_there(SYSTEM_SOCKET) else SYSTEM_SOCKET


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
    UntrustedSocketError
        If the folder, or one above it, belongs to somebody else who could exchange the socket in it.
    OSError
        If it cannot be made.
    """
    socket.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_folder(socket)
