"""The verb that places the units of systemd and what belongs to them: `install-service`."""

import argparse
import os
import shlex
import sys
from pathlib import Path
from typing import Final, NamedTuple

from twostage_servo.cli.output import CommandError, ExitCode, print_json, print_line
from twostage_servo.cli.typed_names import file_path
from twostage_servo.cli.typed_numbers import whole

_MARK: Final = "# Placed by `twostage-servo install-service`, which writes it anew; put changes into a drop-in.\n"
_UNIT: Final = "twostage-servo@.service"
_DESTINATIONS: Final = {
    _UNIT: "etc/systemd/system/twostage-servo@.service",
    "80-twostage-servo-can.network": "etc/systemd/network/80-twostage-servo-can.network",
    "80-twostage-servo-can.rules": "etc/udev/rules.d/80-twostage-servo-can.rules",
    "twostage-servo.sysusers": "etc/sysusers.d/twostage-servo.conf",
}
_PLAIN_UNIT: Final = "etc/systemd/system/twostage-servo.service"
_ADMINISTRATORS, _VENDORS = "etc", "usr/lib"
"""Where systemd and udev look: what lies in the first outranks what a package has put into the second."""
_HIDDEN: Final = ("/root", "/home", "/run/user", "/tmp", "/var/tmp")  # noqa: S108 - ProtectHome and PrivateTmp hide them
_AFTER: Final = ("systemd-sysusers", "systemctl daemon-reload", "udevadm control --reload")
_FIRST_START: Final = (
    "put your configuration into /etc/twostage-servo/servo.toml (mkdir first; config/socketcan.toml is an example)",
    "adduser YOUR_NAME twostage-servo, and log in again: members of the group may command the axes",
    "systemctl enable --now systemd-networkd twostage-servo",
)
_LAST: Final = "systemctl stop twostage-servo 'twostage-servo@*' (running services continue until then)"


class _Placed(NamedTuple):
    """What was done about a file: ``"written"``, ``"unchanged"``, ``"removed"`` or ``"absent"``."""

    path: Path
    outcome: str


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "install-service",
        help="install the systemd units",
        description="Install the systemd units, the network file and the udev rule of the CAN interfaces, and the "
        "operators' group. Nothing is started. A second run changes only what differs. Files that it did not write "
        "are left alone.",
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--print", action="store_true", dest="show", help="print the files, and install none")
    what.add_argument("--uninstall", action="store_true", help="remove the installed files")
    parser.add_argument("--bit-rate", type=whole, default=500_000, metavar="BIT/S", help="bit rate (default 500000)")
    parser.add_argument("--program", type=file_path, help="path of twostage-servo (default: the running one)")
    parser.add_argument("--root", type=file_path, default=Path("/"), help="folder to install below (default /)")
    parser.add_argument("--vendor", action="store_true", help="for a package: below /usr/lib, which /etc overrides")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=_run)


def service_files(program: Path, bit_rate: int, *, vendor: bool = False) -> dict[str, str]:
    """Return the files by their paths below the root.

    Parameters
    ----------
    program
        Absolute path of ``twostage-servo``.
    bit_rate
        Of the CAN interfaces, bit/s.
    vendor
        Whether they come with a package, and so lie below ``usr/lib``, or are the administrator's, below ``etc``.
    """
    from importlib.resources import files

    folder = files("twostage_servo_systemd")
    texts = {path: (folder / name).read_text("utf-8") for name, path in _DESTINATIONS.items()}
    # The unit without an instance: one machine, one configuration.
    unit = texts[_DESTINATIONS[_UNIT]]
    plain = unit.replace("/%i.toml", "/servo.toml").replace("twostage-servo-%i", "twostage-servo")
    plain = plain.replace(", configuration %i", "").replace("twostage-servo-NAME", "twostage-servo")
    texts[_PLAIN_UNIT] = plain.partition("\n")[2]
    top = _VENDORS if vendor else _ADMINISTRATORS
    return {
        path.replace(_ADMINISTRATORS, top, 1): _MARK
        + text.replace("@PROGRAM@", str(program)).replace("@BIT_RATE@", str(bit_rate))
        for path, text in texts.items()
    }


def _run(options: argparse.Namespace) -> ExitCode:
    if not 0 < options.bit_rate <= 1_000_000:
        text = f"--bit-rate {options.bit_rate}: a classic CAN bus has 1 to 1000000 bit/s"
        raise CommandError(ExitCode.USAGE, "bit_rate", text)
    texts = service_files(_program(options), options.bit_rate, vendor=options.vendor)
    if options.show:
        if options.json:
            print_json({"files": {f"/{path}": text for path, text in texts.items()}})
        else:
            print_line("\n".join(f"# /{path}\n{text}" for path, text in texts.items()))
        return ExitCode.DONE
    targets = {options.root / path: text for path, text in texts.items()}
    strangers = [path for path in targets if _is_a_strangers(path)]
    if strangers:
        listed = ", ".join(map(str, strangers))
        text = f"left alone, because this command did not write them: {listed}. Move them away, then run it again."
        raise CommandError(ExitCode.FAILED, "foreign_file", text)
    try:
        placed = [_remove(path) if options.uninstall else _write(path, text) for path, text in targets.items()]
    except OSError as error:
        text = f"{error.strerror}: {error.filename}. Run it as root, for instance with sudo."
        raise CommandError(ExitCode.FAILED, "not_placed", text) from error
    steps = [_LAST, *_AFTER[1:]] if options.uninstall else [*_AFTER, *_FIRST_START]
    if options.json:
        shown = [{"path": str(one.path), "outcome": one.outcome} for one in placed]
        print_json({"files": shown, "next": steps})
    else:
        lines = [f"{one.outcome:9}  {one.path}" for one in placed]
        print_line("\n".join([*lines, "next:", *(f"  {step}" for step in steps)]))
    return ExitCode.DONE


def _program(options: argparse.Namespace) -> Path:
    """Return the program for the units; one that the service could not see or start is refused."""
    import shutil

    found = options.program or shutil.which(sys.argv[0]) or sys.argv[0]
    program = Path(found).absolute()
    if shlex.quote(str(program)) != str(program) or "%" in str(program):
        text = f"{program}: a path with blanks, quotes or % cannot be used in a unit; install to another folder"
        raise CommandError(ExitCode.USAGE, "program", text)
    needed = [program] if options.program else [program, Path(sys.executable).resolve()]
    for path in needed:
        if not options.show and not options.uninstall and any(path.is_relative_to(hidden) for hidden in _HIDDEN):
            text = f"the service cannot see {path}: home folders and /tmp are hidden from it; install to /opt"
            raise CommandError(ExitCode.USAGE, "program", text)
    return program


def _is_a_strangers(path: Path) -> bool:
    return path.exists() and not path.read_text("utf-8", errors="replace").startswith(_MARK)


def _write(path: Path, text: str) -> _Placed:
    if path.exists() and path.read_text("utf-8") == text:
        return _Placed(path, "unchanged")
    path.parent.mkdir(parents=True, exist_ok=True)
    # Whole or not at all: the manager may read it at any time.
    import tempfile

    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".twostage-servo-")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as out:
            out.write(text)
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except OSError:
        Path(temporary).unlink(missing_ok=True)
        raise
    return _Placed(path, "written")


def _remove(path: Path) -> _Placed:
    if not path.exists():
        return _Placed(path, "absent")
    path.unlink()
    return _Placed(path, "removed")
