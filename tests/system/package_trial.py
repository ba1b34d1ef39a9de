"""What must hold of the Debian package on a fresh Debian, without a network; tools.rig.fresh_debian runs it.

``python3 -m tests.system.package_trial OLDER NEWER`` installs the older package, moves an axis under systemd as an
operator does, upgrades, trips, rolls back, runs an instance, removes and purges, and compares all files before and
after. Prints a line a step, then one JSON object. Exit code 1 if a step fails.
"""

import contextlib
import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from tools.rig.bench import CONFIGURATION, GROUP, OPT, PATIENT_UNIT, UNIT, attempt, patient, run

Figures = dict[str, Any]

_PROGRAM: Final = Path("/usr/bin/twostage-servo")
_EXAMPLE: Final = Path("/usr/share/doc/twostage-servo/examples/socketcan.toml")
_STATE: Final = Path("/var/lib/private/twostage-servo")
_OPERATOR, _STRANGER = "operator1", "stranger1"
_INSTANCE: Final = "second"
_INSTANCE_UNIT: Final = f"twostage-servo@{_INSTANCE}.service"
_IGNORED: Final = (
    "/proc", "/sys", "/dev", "/run", "/tmp", "/var/tmp", "/rig", "/host",  # noqa: S108 - they are not looked at
    "/var/log", "/var/lib/dpkg", "/var/lib/apt", "/var/cache/apt",
    "/var/lib/systemd",  # its random seed, time stamps and catalogue
    "/etc/.pwd.lock", "/etc/passwd-", "/etc/shadow-", "/etc/group-", "/etc/gshadow-",  # of whatever edits accounts
)  # fmt: skip
"""Bookkeeping of others, and what no package leaves anything in."""


def inventory(top: str = "/") -> dict[str, str]:
    """Return all files, folders and links below a folder, each with what it is; of those in /etc also what is in it."""
    found = {}
    for folder, folders, files in os.walk(top):
        folders[:] = [name for name in folders if not _is_ignored(Path(folder, name))]
        for path in (Path(folder, name) for name in [*folders, *files]):
            if str(path) in _IGNORED:
                continue
            kind = f"link to {path.readlink()}" if path.is_symlink() else oct(path.lstat().st_mode)
            if path.is_relative_to("/etc") and path.is_file():
                kind += hashlib.sha256(path.read_bytes()).hexdigest()
            found[str(path)] = kind
    return found


def _is_ignored(folder: Path) -> bool:
    return str(folder) in _IGNORED or folder.is_mount()


def differences(before: Mapping[str, str], after: Mapping[str, str]) -> dict[str, list[str]]:
    """Return what was added, removed and changed between two inventories."""
    found = {
        "added": sorted(after.keys() - before.keys()),
        "removed": sorted(before.keys() - after.keys()),
        "changed": sorted(path for path in before.keys() & after.keys() if before[path] != after[path]),
    }
    return {kind: paths for kind, paths in found.items() if paths}


def check(holds: object, what: str, **seen: Any) -> None:
    """Fail unless something holds."""
    if not holds:
        raise AssertionError(f"{what}: {seen}" if seen else what)


class Trial:
    """The steps, in their order; each builds on the one before.

    Parameters
    ----------
    older
        The file to install.
    newer
        The file to upgrade to.
    """

    def __init__(self, older: Path, newer: Path) -> None:
        self._older = older
        self._newer = newer
        self._drive: subprocess.Popen[bytes] | None = None
        self._fresh: dict[str, str] = {}
        self._unpacked: dict[str, str] = {}

    @property
    def steps(self) -> tuple[Callable[[], Figures], ...]:
        """What is done, one after another."""
        return (
            self.look_before, self.install, self.bring_the_bus_up, self.start, self.refuse_a_stranger, self.move,
            self.write_nothing_in_opt, self.upgrade, self.start_again, self.trip, self.roll_back, self.run_an_instance,
            self.remove, self.purge,
        )  # fmt: skip

    def look_before(self) -> Figures:
        """Two ordinary users, then the list of all files."""
        for name in (_OPERATOR, _STRANGER):
            run("useradd", name)
        self._fresh = inventory()
        return {"files_before": len(self._fresh)}

    def install(self) -> Figures:
        """Install without a network: nothing is started or enabled, and the operator joins the group."""
        begun = time.monotonic()
        told = run("apt-get", "install", "--yes", str(self._older))
        took = time.monotonic() - begun
        self._is_installed(self._older)
        self._unpacked = inventory(str(OPT))
        self._is_at_rest("disabled")
        check(not run("dpkg", "--verify", "twostage-servo"), "every file is as the package has it")
        run("usermod", "--append", "--groups", GROUP, _OPERATOR)
        check("error" not in told.lower(), "is installed without an error", told=told)
        return {"install_s": took, "files_in_opt": len(self._unpacked)}

    def bring_the_bus_up(self) -> Figures:
        """Bring both interfaces up by systemd-networkd, with the package's network file."""
        begun = time.monotonic()
        run("systemctl", "start", "systemd-networkd")
        for channel in ("can0", "can1"):
            _until(f"{channel} is up", lambda channel=channel: "UP" in _link(channel)["flags"])  # type: ignore[misc]
            data = _link(channel)["linkinfo"]["info_data"]
            check(data["bittiming"]["bitrate"] == 500_000, "has the bit rate", **data)
            check(not data.get("restart_ms"), "stays off after bus-off", **data)
        return {"bus_s": time.monotonic() - begun}

    def start(self) -> Figures:
        """Start the service with the example, and its simulated drive; with the patience that an emulator needs."""
        dropped_in = Path(f"/run/systemd/system/{UNIT}.d/emulated.conf")
        dropped_in.parent.mkdir(parents=True)
        dropped_in.write_text(PATIENT_UNIT)
        run("systemctl", "daemon-reload")
        configuration = CONFIGURATION / "servo.toml"
        configuration.write_text(patient(_EXAMPLE.read_text()))
        with Path("/run/drive.log").open("wb") as log:
            command = (str(_PROGRAM), "drive", "--config", str(configuration), "--set", 'bus.channel="can1"')
            self._drive = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        begun = time.monotonic()
        run("systemctl", "enable", "--quiet", "--now", UNIT)
        ready_s = time.monotonic() - begun
        self._is_disarmed()
        return {"ready_s": ready_s}

    def refuse_a_stranger(self) -> Figures:
        """Let nobody command the axis who is not in the group."""
        told = attempt("runuser", "-u", _STRANGER, "--", str(_PROGRAM), "arm")
        check(told.returncode == 4 and "you may not use it" in told.stderr, "a stranger is refused", told=told.stderr)
        return {"exit_code": told.returncode}

    def move(self) -> Figures:
        """Move 400 mm as an unprivileged member of the group."""
        begun = time.monotonic()
        self._operate("arm")
        self._operate("move", "400", "--wait")
        took = time.monotonic() - begun
        axis = self._status()["axis"]
        check(abs(axis["position"] - 400.0) < 0.1, "arrives", **axis)
        return {"move_s": took, "position_mm": axis["position"]}

    def write_nothing_in_opt(self) -> Figures:
        """Find all as it was unpacked: neither service nor commands write below /opt, and root's do not either.

        Disarmed: reading so much holds up an emulated machine for longer than an axis bears.
        """
        self._operate("disarm")
        changed = differences(self._unpacked, inventory(str(OPT)))
        check(not changed, "nothing is written below /opt", **changed)
        return {}

    def upgrade(self) -> Figures:
        """Install the newer one while the axis holds: the service stops by itself, and is not started."""
        self._operate("arm")
        begun = time.monotonic()
        told = run("apt-get", "install", "--yes", str(self._newer))
        took = time.monotonic() - begun
        self._is_installed(self._newer)
        self._is_at_rest("enabled")
        check(f"systemctl start {UNIT}" in told, "says how to start it again", told=told)
        check(run("systemctl", "show", "--property=Result", "--value", UNIT).strip() == "success", "stops as it should")
        changed = differences(self._unpacked, inventory(str(OPT)))
        check(not changed, "the same files are there", **changed)
        told = run("journalctl", "--output=json", f"--unit={UNIT}")
        (states,) = (json.loads(line)["STATES"] for line in told.splitlines() if '"STATES"' in line)
        return {"upgrade_s": took, "stopped_while": json.loads(states)["x"]}

    def start_again(self) -> Figures:
        """Start it as the upgrade says: it is disarmed."""
        begun = time.monotonic()
        run("systemctl", "start", UNIT)
        ready_s = time.monotonic() - begun
        self._is_disarmed()
        return {"ready_s": ready_s}

    def trip(self) -> Figures:
        """Kill the drive under an armed axis: the service leaves a file of its last ticks."""
        self._operate("arm")
        check(self._drive is not None, "the drive runs")
        assert self._drive is not None
        self._drive.kill()
        self._drive.wait()
        took = _until("trips", lambda: self._status()["trip"])
        _until("a file of the trip", lambda: any(path.is_file() for path in _STATE.rglob("*")))
        return {"trip_s": took, "code": self._status()["trip"]["code"]}

    def roll_back(self) -> Figures:
        """Install the older one again over the tripped service: configuration and trips stay, and it is not started."""
        kept = inventory(str(CONFIGURATION)) | inventory(str(_STATE))
        begun = time.monotonic()
        run("apt-get", "install", "--yes", "--allow-downgrades", str(self._older))
        took = time.monotonic() - begun
        self._is_installed(self._older)
        self._is_at_rest("enabled")
        changed = differences(kept, inventory(str(CONFIGURATION)) | inventory(str(_STATE)))
        check(not changed and len(kept) > 1, "configuration and trips stay", kept=len(kept), **changed)
        return {"roll_back_s": took, "kept": len(kept)}

    def run_an_instance(self) -> Figures:
        """Start a service of another name, with its own configuration and socket; it is there while `remove` comes."""
        configuration = CONFIGURATION / f"{_INSTANCE}.toml"
        configuration.write_text((CONFIGURATION / "servo.toml").read_text())
        dropped_in = Path(f"/run/systemd/system/{_INSTANCE_UNIT}.d/emulated.conf")
        dropped_in.parent.mkdir(parents=True)
        dropped_in.write_text(PATIENT_UNIT)
        run("systemctl", "daemon-reload")
        begun = time.monotonic()
        run("systemctl", "enable", "--quiet", "--now", _INSTANCE_UNIT)
        ready_s = time.monotonic() - begun
        shown = self._status("--socket", f"/run/twostage-servo-{_INSTANCE}/control.sock")
        check(shown["axis"]["state"] == "disarmed", "is disarmed", **shown["axis"])
        said = run("systemctl", "show", "--property=StatusText", "--value", _INSTANCE_UNIT).strip()
        check("disarmed" in said, "says so", said=said)
        state = _STATE.with_name(f"twostage-servo-{_INSTANCE}")
        check(state.is_dir(), "has a folder for its trips", state=str(state))
        return {"ready_s": ready_s, "status_text": said}

    def remove(self) -> Figures:
        """Remove it while the instance runs: stopped, not enabled, and only what the operator made stays."""
        begun = time.monotonic()
        run("dpkg", "--remove", "twostage-servo")
        took = time.monotonic() - begun
        for unit in (UNIT, _INSTANCE_UNIT):
            check(attempt("systemctl", "is-active", unit).stdout.strip() == "inactive", "is stopped", unit=unit)
        wanted = Path("/etc/systemd/system/multi-user.target.wants")
        gone = (OPT, _PROGRAM, wanted / UNIT, wanted / _INSTANCE_UNIT)
        left = [str(path) for path in gone if os.path.lexists(path)]
        check(not left, "program and link are gone", left=left)
        check((CONFIGURATION / "servo.toml").exists() and _STATE.exists(), "configuration and trips stay")
        return {"remove_s": took}

    def purge(self) -> Figures:
        """Purge it: every file is as before, also those of the accounts."""
        begun = time.monotonic()
        run("dpkg", "--purge", "twostage-servo")
        took = time.monotonic() - begun
        left = differences(self._fresh, inventory())
        check(not left, "no file is left, and none has changed", **left)
        check(not attempt("dpkg-query", "--show", "twostage-servo").stdout.strip(), "dpkg has forgotten it")
        return {"purge_s": took, "files_left": 0}

    def close(self) -> None:
        """End the drive, if it still runs."""
        if self._drive is not None:
            self._drive.kill()
            self._drive.wait()

    def _operate(self, *arguments: str) -> Figures:
        out = run("runuser", "-u", _OPERATOR, "--", str(_PROGRAM), *arguments, "--json")
        answer: Figures = json.loads(out.splitlines()[-1])
        return answer

    def _status(self, *options: str) -> Figures:
        """Return what the axis shows; the exit code tells of a trip, which may be what is waited for."""
        told = attempt("runuser", "-u", _OPERATOR, "--", str(_PROGRAM), "status", *options, "--json").stdout
        shown: Figures = json.loads(told.splitlines()[-1])
        return shown

    def _is_disarmed(self) -> None:
        def holds() -> bool:
            shown = self._status()["axis"]
            return shown["state"] == "disarmed" and shown["position"] is not None

        _until("is disarmed and hears its drive", holds)

    def _is_installed(self, package: Path) -> None:
        there = run("dpkg-query", "--show", "--showformat=${Version}", "twostage-servo")
        given = run("dpkg-deb", "--field", str(package), "Version").strip()
        check(there == given, "is the version that was given", there=there, given=given)

    def _is_at_rest(self, enabled: str) -> None:
        for verb, expected in (("is-active", "inactive"), ("is-enabled", enabled)):
            told = attempt("systemctl", verb, UNIT).stdout.strip()
            check(told == expected, f"`systemctl {verb}` says {expected}", told=told)


def _link(channel: str) -> Figures:
    shown: Figures = json.loads(run("ip", "-details", "-json", "link", "show", channel))[0]
    return shown


def _until(what: str, holds: Callable[[], object], longest_s: float = 60.0) -> float:
    """Wait until something holds; return how long that took, s."""
    begun = time.monotonic()
    while True:
        with contextlib.suppress(KeyError):  # of an answer that says that there is none yet
            if holds():
                return time.monotonic() - begun
        check(time.monotonic() - begun < longest_s, f"not within {longest_s:g} s: {what}")
        time.sleep(0.5)


def main() -> int:
    """Go through the steps; the first that fails ends it."""
    results: dict[str, Figures] = {}
    error = None
    with contextlib.closing(Trial(*map(Path, sys.argv[1:]))) as trial:
        for step in trial.steps:
            begun = time.monotonic()
            name = step.__name__
            try:
                figures = step()
            except Exception as caught:  # noqa: BLE001 - whatever it is, it is to be told
                error = f"{name}: {type(caught).__name__}: {caught}"
                print(f"FAILED  {error}", flush=True)
                print(attempt("journalctl", "--no-pager", "--lines=40", f"--unit={UNIT}").stdout, flush=True)
                break
            results[name] = {
                key: round(value, 3) if isinstance(value, float) else value for key, value in figures.items()
            }
            shown = ", ".join(f"{key} {value}" for key, value in results[name].items())
            print(f"ok  {name}, {time.monotonic() - begun:.1f} s  {shown}", flush=True)
    print(json.dumps({"ok": error is None, "error": error, "steps": results}), flush=True)
    return 0 if error is None else 1


if __name__ == "__main__":
    sys.exit(main())
