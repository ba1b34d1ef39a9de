"""Try the Debian package on a fresh Debian: `sudo python3 -m tools.rig.fresh_debian [OLDER NEWER]`.

Makes a Debian of nothing but its base, systemd, Python and CAN tools with debootstrap, once, in the cache; boots it in
the rig's virtual machine, which has no network; and goes through tests/system/package_trial.py there: install, move,
upgrade, trip, roll back, an instance, remove, purge, and no file left. Without packages it builds two of
this tree. Exit code: 0 all holds, 1 something does not, 124 the time limit, 125 the rig itself failed.
"""

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

TREE: Final = Path(__file__).resolve().parents[2]
_INCLUDED: Final = ("systemd", "systemd-sysv", "udev", "dbus", "kmod", "iproute2", "can-utils", "python3")
_RIG_FAILED: Final = 125


class FreshError(Exception):
    """The fresh Debian or the package cannot be made; the text says at what, and what to do."""


def apts_mirror(suite: str) -> str:
    """Return where apt gets a suite from: debootstrap would take another one, which may not be reachable."""
    sites = _run("apt-get", "indextargets", "--format", "$(CODENAME) $(SITE)", "Created-By: Packages").splitlines()
    for codename, _, site in (line.partition(" ") for line in sites):
        if codename == suite:
            return site
    raise FreshError(f"apt has no source of {suite}: name one with --mirror")


def make_root(cache: Path, suite: str, mirror: str) -> Path:
    """Return the folder of the fresh Debian; made if it is missing, or was made of other packages."""
    root, note = cache / f"fresh-{suite}", cache / f"fresh-{suite}.made"
    made_of = f"{suite} {mirror} {' '.join(_INCLUDED)}\n"
    if root.is_dir() and note.is_file() and note.read_text() == made_of:
        return root
    if os.geteuid() != 0:
        raise FreshError("debootstrap has to run as root: run this with sudo")
    program, environment = _debootstrap(cache)
    note.unlink(missing_ok=True)
    shutil.rmtree(root, ignore_errors=True)
    arguments = ("--variant=minbase", f"--include={','.join(_INCLUDED)}", suite, str(root), mirror)
    _run("sh", str(program), *arguments, environment=environment)
    note.write_text(made_of)
    return root


def _debootstrap(cache: Path) -> tuple[Path, Mapping[str, str]]:
    """Return the script and what it needs in its environment; it is fetched, not installed, where it is missing."""
    if (found := shutil.which("debootstrap", path=f"{os.environ.get('PATH', '')}:/usr/sbin")) is not None:
        return Path(found), {}
    folder = cache / "debootstrap"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    _run("apt-get", "--quiet=2", "-o", "APT::Sandbox::User=root", "download", "debootstrap", folder=folder)
    (archive,) = folder.glob("*.deb")
    _run("dpkg-deb", "--extract", str(archive), str(folder))
    return folder / "usr/sbin/debootstrap", {"DEBOOTSTRAP_DIR": str(folder / "usr/share/debootstrap")}


def make_packages(folder: Path) -> tuple[Path, Path]:
    """Build the package of this tree, and once more as if it were a day older; return the older one first."""

    def build(environment: Mapping[str, str]) -> Mapping[str, Any]:
        command = (sys.executable, "-m", "tools.debian.build", "--output", str(folder), "--json")
        told = _run(*command, folder=TREE, environment=environment)
        built: Mapping[str, Any] = json.loads(told)
        return built

    newer = build({})
    older = build({"SOURCE_DATE_EPOCH": str(newer["date"] - 86_400)})
    return Path(older["package"]), Path(newer["package"])


def try_out(root: Path, packages: Sequence[Path], cache: Path, timeout_s: float) -> tuple[int, dict[str, Any]]:
    """Boot, and go through the trial; return the rig's exit code and what the trial has told."""
    inside = [str(Path("/host", *path.resolve().parts[1:])) for path in packages]
    rig = (sys.executable, "-m", "tools.rig.run", "--cache", str(cache), "--root", str(root), "--memory", "3072")
    command = (*rig, "--timeout", str(timeout_s), "--", "/usr/bin/python3", "-m", "tests.system.package_trial", *inside)
    told: dict[str, Any] = {}
    with subprocess.Popen(command, cwd=TREE, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None  # noqa: S101 - for the type checker
        for line in running.stdout:
            if line.startswith('{"ok":'):
                told = json.loads(line)
            else:
                print(line.rstrip(), file=sys.stderr, flush=True)
    return running.returncode, told


def _run(*arguments: str, folder: Path | None = None, environment: Mapping[str, str] | None = None) -> str:
    done = subprocess.run(
        arguments, cwd=folder, env=os.environ | dict(environment or {}), stdin=subprocess.DEVNULL, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        told = f"{done.stdout}{done.stderr}".strip()[-2000:]
        raise FreshError(f"`{' '.join(arguments)}` ended with {done.returncode}: {told}")
    return done.stdout


def main() -> int:
    """Try it, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    parser.add_argument(
        "packages", type=Path, nargs="*", help="two .deb, the older one first (default: they are built)"
    )
    codename = platform.freedesktop_os_release().get("VERSION_CODENAME", "bookworm")
    parser.add_argument("--suite", default=codename, help="which Debian; its Python has to be the package's")
    parser.add_argument("--mirror", help="to make it from (default: apt's own)")
    parser.add_argument("--cache", type=Path, default=home / "twostage-servo-rig", help="folder of what was fetched")
    parser.add_argument("--timeout", type=float, default=1500.0, help="most seconds in the machine (default 1500)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    if len(options.packages) not in (0, 2):
        parser.error(f"two packages are wanted, the older one first, or none; these are {len(options.packages)}")
    if missing := [str(path) for path in options.packages if not path.is_file()]:
        parser.error(f"no file: {', '.join(missing)}")
    begun = time.monotonic()
    result: dict[str, Any] = {"ok": False}
    status = _RIG_FAILED
    with tempfile.TemporaryDirectory(prefix="rig-fresh-") as name:
        try:
            options.cache.mkdir(parents=True, exist_ok=True)
            packages = options.packages or make_packages(Path(name))
            root = make_root(options.cache.resolve(), options.suite, options.mirror or apts_mirror(options.suite))
            made_s = time.monotonic() - begun
            status, told = try_out(root, packages, options.cache.resolve(), options.timeout)
            result |= told | {"made_s": round(made_s, 1), "bytes": packages[-1].stat().st_size}
        except (FreshError, OSError) as error:
            result["error"] = str(error)
            print(f"fresh Debian: {error}", file=sys.stderr)
    result |= {"status": status, "total_s": round(time.monotonic() - begun, 1)}
    if options.json:
        print(json.dumps(result))
    else:
        print(f"{'all holds' if status == 0 else 'FAILED'}, {result['total_s']} s in all")
    return status


if __name__ == "__main__":
    sys.exit(main())
