"""Boot a throw-away virtual machine with CAN and systemd, and run a command in it.

`python -m tools.rig.run -- COMMAND...` is for Debian and Ubuntu on amd64. KVM is used where it works. The machine has
two emulated Kvaser boards, can0 and can1, on one bus, and sees the host's files at their paths, without changing any.
With `--root FOLDER` it boots from the system in that folder instead, and sees the host's files below /host.
Without COMMAND it only fetches what it needs.
Exit code: the command's; 124 the time limit; 125 the rig itself failed.
"""

import argparse
import contextlib
import fcntl
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import IO, Final, NamedTuple

from tools.rig.guest import Guest, RigError

TIME_LIMIT: Final = 124
RIG_FAILED: Final = 125
_SIGN_OF_LIFE_S: Final = 15.0
"""KVM that was promised by its device and runs no code is given up after that; the sign comes within 2 s otherwise."""
_KERNEL: Final = (
    "console=ttyS0 loglevel=4 panic=-1 mitigations=off random.trust_cpu=on systemd.unit=rig.target fstab=no "
    "systemd.show_status=no systemd.getty_auto=no systemd.condition-needs-update=no systemd.journald.storage=volatile "
    "systemd.mask=systemd-timesyncd.service systemd.unified_cgroup_hierarchy=1"
)
_ACCELERATED: Final = {
    # An emulator translates code by its address, so that it is spared work if that is the same in every process; and
    # what the wide vector instructions would save costs it more. Both together: a fifth less of its processor time.
    "tcg": (("-accel", "tcg,thread=multi", "-cpu", "max,avx=off,avx2=off"), ("norandmaps",)),
    "kvm": (("-accel", "kvm", "-cpu", "max"), ()),
}
"""What each accelerator wants of QEMU and of the kernel's command line."""
_OTHER_ROOT: Final = "rig.root=other"
"""What tells first_process.sh that the host's root is not to be booted."""
_NEEDED: Final = ("lib/systemd/systemd", "lib/systemd/systemd-udevd", "sbin/modprobe", "sbin/ip", "bin/bash")
"""What a system has to have to be booted by the rig."""
_PASSED_ON: Final = ("PATH", "HOME", "LANG", "PYTHONPATH", "VIRTUAL_ENV")


class Ended(NamedTuple):
    """How a run ended.

    Attributes
    ----------
    status
        Exit code.
    accelerator
        "kvm" or "tcg".
    boot_s
        From the kernel's start to the command's, s; None if it did not come to that.
    console
        What kernel and systemd printed.
    """

    status: int
    accelerator: str
    boot_s: float | None
    console: str


def machine(
    guest: Guest, folder: Path, accelerator: str, boards: int, memory_mib: int, root: Path | None = None
) -> list[str]:
    """Return QEMU's command line."""
    shared = ["host,path=/,readonly=on", f"layer,path={guest.layer},readonly=on", f"exchange,path={folder}"]
    if root is not None:
        shared.append(f"root,path={str(root).replace(',', ',,')},readonly=on")
    disks = [
        argument
        for one in shared
        for tag in [one.partition(",")[0]]
        for argument in (
            "-fsdev", f"local,security_model=none,multidevs=remap,id={one}",
            "-device", f"virtio-9p-pci,fsdev={tag},mount_tag={tag}",
        )
    ]  # fmt: skip
    arguments, for_kernel = _ACCELERATED[accelerator]
    data = [part for name in ("qemu", "seabios") for part in ("-L", str(guest.layer / "usr/share" / name))]
    bus = ["-object", "can-bus,id=bus", *(["-device", "kvaser_pci,canbus=bus"] * boards)] if boards else []
    return [
        guest.tool("setpriv"), "--pdeathsig", "KILL",  # a rig that is killed takes its machine with it
        guest.tool("qemu-system-x86_64"), *data, "-L", "/usr/share/qemu", "-L", "/usr/share/seabios",
        *arguments, "-M", "pc,vmport=off", "-smp", "2", "-m", str(memory_mib),
        "-nodefaults", "-no-reboot", "-display", "none",
        "-kernel", str(guest.kernel), "-initrd", str(guest.initramfs),
        "-append", " ".join([_KERNEL, *for_kernel, *([] if root is None else [_OTHER_ROOT])]),
        "-serial", f"file:{folder / 'console'}", "-device", "virtio-rng-pci",
        "-device", "virtio-serial-pci", "-chardev", "stdio,id=output,signal=off",
        "-device", "virtconsole,chardev=output",
        *disks, *bus,
    ]  # fmt: skip


def run(guest: Guest, command: Sequence[str], options: argparse.Namespace, output: IO[str]) -> Ended:
    """Boot the guest, run the command, and wait for the end of both.

    Raises
    ------
    RigError
        When the guest ended without having run the command.
    """
    chosen = "tcg" if options.accelerator == "auto" else options.accelerator
    accelerators = ["kvm", "tcg"] if options.accelerator == "auto" and os.access("/dev/kvm", os.W_OK) else [chosen]
    for accelerator in accelerators:
        with tempfile.TemporaryDirectory(prefix="rig-") as name:
            ended = _boot(guest, Path(name), command, options, output, accelerator)
        if ended is not None:
            return ended
    raise RigError(f"the guest gave no sign of life within {_SIGN_OF_LIFE_S:g} s with {accelerators[-1]}")


def _boot(
    guest: Guest, folder: Path, command: Sequence[str], options: argparse.Namespace, output: IO[str], accelerator: str
) -> Ended | None:
    here = Path.cwd() if options.root is None else Path("/host", *Path.cwd().parts[1:])
    passed_on = _PASSED_ON if options.root is None else ()  # another system has its own paths
    kept = [f"{name}={os.environ[name]}" for name in passed_on if name in os.environ]
    line = shlex.join(["exec", "env", *kept, *options.env, *command])
    (folder / "command").write_text(f"cd {shlex.quote(str(here))} && {line}\n")
    if options.in_memory:
        _pack(options.in_memory, folder / "in_memory.tar")
        (folder / "in_memory").write_text("".join(f"{path}\n" for path in options.in_memory))
    console, errors = folder / "console", folder / "errors"
    console.touch()
    begun = time.monotonic()
    timed_out = False
    arguments = machine(guest, folder, accelerator, options.boards, options.memory, options.root)
    with errors.open("w") as out, subprocess.Popen(
        arguments, stdin=subprocess.DEVNULL, stdout=output, stderr=out, env=guest.environment()
    ) as virtual:  # fmt: skip
        try:
            while virtual.poll() is None:
                elapsed = time.monotonic() - begun
                if accelerator == "kvm" and elapsed > _SIGN_OF_LIFE_S and b"rig: " not in console.read_bytes():
                    break
                if timed_out := elapsed > options.timeout:
                    break
                with contextlib.suppress(subprocess.TimeoutExpired):
                    virtual.wait(0.2)
        finally:
            virtual.kill()
    shown = console.read_text(errors="replace")
    if accelerator == "kvm" and "rig: " not in shown:
        return None
    status, boot = folder / "status", folder / "boot_s"
    boot_s = float(boot.read_text()) if boot.exists() and boot.read_text() else None
    if timed_out:
        return Ended(TIME_LIMIT, accelerator, boot_s, shown)
    if not status.exists():
        last = "\n".join([*errors.read_text().splitlines()[-10:], *shown.splitlines()[-30:]])
        raise RigError(f"the guest ended without having run the command; the last it said:\n{last}")
    return Ended(int(status.read_text()), accelerator, boot_s, shown)


def _pack(folders: Sequence[Path], archive: Path) -> None:
    """Pack what the guest unpacks: opening a file of the host takes it milliseconds, and a Python opens a thousand."""
    names = [str(folder.relative_to("/")) for folder in folders]
    done = subprocess.run(
        ("tar", "-cf", str(archive), "-C", "/", "--exclude=tests", "--exclude=test", *names),
        capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    if done.returncode:
        raise RigError(f"{', '.join(map(str, folders))} cannot be packed: {done.stderr.strip()}")


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    parser.add_argument("--timeout", type=float, default=300.0, help="most seconds, boot included (default 300)")
    parser.add_argument("--boards", type=int, default=2, help="Kvaser boards, that is can0, can1, ... (default 2)")
    parser.add_argument("--memory", type=int, default=2048, help="of the machine, MiB (default 2048)")
    parser.add_argument("--accelerator", choices=("auto", "kvm", "tcg"), default="auto", help="tcg is emulation")
    parser.add_argument("--root", type=Path, metavar="FOLDER", help="boot the system in there, not the host's")
    parser.add_argument("--in-memory", action="append", default=[], type=lambda name: Path(name).resolve(),
                        metavar="FOLDER", help="one of the host's to be quick to read, but for its tests")  # fmt: skip
    parser.add_argument("--env", action="append", default=[], metavar="NAME=VALUE", help="set for the command")
    parser.add_argument("--cache", type=Path, default=home / "twostage-servo-rig", help="folder of what was fetched")
    parser.add_argument("--console", type=Path, help="keep there what kernel and systemd print")
    parser.add_argument("--json", action="store_true", help="the result as JSON; the command's output goes to stderr")
    parser.add_argument("command", nargs="*", help="what to run, as root, in this folder")
    options = parser.parse_args(arguments)
    if options.timeout <= 0.0 or options.boards not in range(9) or options.memory < 512:
        parser.error("--timeout must be above 0, --boards 0 to 8, --memory at least 512")
    if options.in_memory and options.root is not None:
        parser.error("--in-memory is for the host's own system, --root for another one")
    if options.root is not None:
        options.root = options.root.resolve()
        if missing := [name for name in _NEEDED if not os.path.lexists(options.root / name)]:
            parser.error(f"--root {options.root}: {', '.join(missing)} missing; make it with debootstrap --include="
                         "systemd,systemd-sysv,udev,dbus,kmod,iproute2")  # fmt: skip
    return options


def _end(number: int, _: FrameType | None) -> None:
    raise SystemExit(128 + number)


def main() -> int:
    """Run, and return the exit code."""
    options = parse()
    signal.signal(signal.SIGTERM, _end)
    begun = time.monotonic()
    result: dict[str, object] = {"status": RIG_FAILED}
    try:
        options.cache.mkdir(parents=True, exist_ok=True)
        guest = Guest(options.cache)
        with (options.cache / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            guest.make()
        made = time.monotonic()
        result["setup_s"] = round(made - begun, 1)
        if not options.command:
            result["status"] = 0
            return _tell(result, options)
        ended = run(guest, options.command, options, sys.stderr if options.json else sys.stdout)
        if options.console is not None:
            options.console.write_text(ended.console)
        result |= {"status": ended.status, "accelerator": ended.accelerator, "boot_s": ended.boot_s}
        result["machine_s"] = round(time.monotonic() - made, 1)
        if ended.status == TIME_LIMIT:
            result["error"] = f"time limit of {options.timeout:g} s; the last it said: {ended.console[-1000:]}"
    except (RigError, OSError, subprocess.CalledProcessError) as error:
        result["error"] = str(error)
    return _tell(result, options)


def _tell(result: dict[str, object], options: argparse.Namespace) -> int:
    if "error" in result:
        print(f"rig: {result['error']}", file=sys.stderr)
    if options.json:
        print(json.dumps(result))
    status = result["status"]
    assert isinstance(status, int)  # noqa: S101 - for the type checker
    return status


if __name__ == "__main__":
    sys.exit(main())
