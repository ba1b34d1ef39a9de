"""What the guest boots from, made once and kept: Debian's kernel, an initramfs, and a layer over the host's root.

The layer holds the packages that the host has not installed, unpacked, so that nothing is installed on the host.
"""

import contextlib
import lzma
import os
import re
import shutil
import stat
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).parent
PACKAGES: Final = (
    "qemu-system-x86", "busybox-static", "kmod", "systemd", "systemd-sysv", "udev", "dbus", "libnss-systemd",
    "can-utils", "iproute2",
)  # fmt: skip
KERNELS: Final = ("linux-image-amd64", "linux-image-generic")
"""Debian's and Ubuntu's name for the newest kernel."""
_SOURCES: Final = ("guest.py", "first_process.sh", "run_command.sh")
"""Of what is made; the rest of this folder only uses it."""
_BOOT_MODULES: Final = ("virtio_pci", "virtio_console", "9pnet_virtio", "9p", "overlay")
_KEPT: Final = (
    "./boot/vmlinuz-*", "./lib/modules/*/modules.*",
    *(f"./lib/modules/*/kernel/{kept}" for kept in (
        "arch/*", "crypto/*", "fs/*", "lib/*", "net/*", "drivers/net/can/*", "drivers/virtio/*", "drivers/char/*",
        "drivers/net/dummy*",
    )),
)  # fmt: skip
"""Of 400 MB of modules: what a virtual machine with CAN can use."""
_INTO_USR: Final = r"--transform=flags=r;s,^\./\(s\?bin\|lib\(64\)\?\)/,./usr/\1/,"
"""The host's /bin and /lib are links into /usr; a folder of that name in the layer would hide them."""
_TARGET: Final = """\
[Unit]
Description=Rig
Requires=sysinit.target
Wants=sockets.target dbus.socket rig.service
After=sysinit.target
AllowIsolate=yes
"""
_SERVICE: Final = """\
[Unit]
Description=Command of the rig
After=sockets.target dbus.socket systemd-udevd.service
[Service]
Type=exec
ExecStart=/bin/bash /usr/lib/rig/run_command.sh
StandardInput=null
OOMScoreAdjust=-900
"""


class RigError(Exception):
    """The rig itself failed; the text says at what."""


class Guest:
    """The files of the guest in a cache folder.

    Parameters
    ----------
    cache
        The folder; made if it is missing. Remove it to have everything fetched again.

    Attributes
    ----------
    layer, kernel, initramfs : Path
        What lies over the host's root; what is booted.
    """

    def __init__(self, cache: Path) -> None:
        self._cache = cache.resolve()
        self.layer = self._cache / "layer"
        self.kernel = self._cache / "kernel"
        self.initramfs = self._cache / "initramfs"
        self._done = self._cache / "done"

    def make(self) -> None:
        """Fetch and unpack what is missing; does nothing when all is there and no newer than these sources.

        Raises
        ------
        RigError
            When apt cannot give a package, or a package is not what was expected.
        """
        newest = max((HERE / name).stat().st_mtime for name in _SOURCES)
        if self._done.exists() and self._done.stat().st_mtime > newest:
            return
        self._done.unlink(missing_ok=True)
        shutil.rmtree(self.layer, ignore_errors=True)
        archives = self._cache / "archives"
        (archives / "partial").mkdir(parents=True, exist_ok=True)
        self._fetch(archives)
        kernels = [deb for deb in archives.glob("linux-*.deb") if re.match(r"linux-(image|modules)", deb.name)]
        for deb in archives.glob("*.deb"):
            self._unpack(deb, _KEPT if deb in kernels else ("./*",))
        for name in ("bin", "sbin", "lib", "lib64"):  # now empty, they would hide the host's links of that name
            with contextlib.suppress(FileNotFoundError):
                (self.layer / name).rmdir()
        self._write_layer()
        self._write_kernel()
        shutil.rmtree(archives)
        self._done.touch()

    def tool(self, name: str) -> str:
        """Return the path of a program of the layer, or else of the host."""
        folders = [str(self.layer / folder) for folder in ("usr/bin", "usr/sbin")]
        found = shutil.which(name, path=os.pathsep.join([*folders, os.environ.get("PATH", ""), "/usr/sbin", "/sbin"]))
        if found is None:
            raise RigError(f"{name} is neither installed nor in {self.layer}: remove {self._cache} and run again")
        return found

    def environment(self) -> Mapping[str, str]:
        """Return the environment in which programs of the layer find their libraries."""
        return os.environ | {"LD_LIBRARY_PATH": str(self.layer / "usr/lib/x86_64-linux-gnu")}

    def _fetch(self, archives: Path) -> None:
        listed = [name for name in KERNELS if _succeeds("apt-cache", "show", name)]
        if not listed:
            _run("apt-get", "update", "--quiet=2")
            listed = [name for name in KERNELS if _succeeds("apt-cache", "show", name)]
        if not listed:
            raise RigError(f"apt knows none of {', '.join(KERNELS)}: the rig needs Debian or Ubuntu on amd64")
        # Without the lock nobody needs to be root; without a sandbox the folder may be anybody's.
        options = ("--quiet=2", "-o", "Debug::NoLocking=true", "-o", "APT::Sandbox::User=root")
        fetch = ("install", "--yes", "--no-install-recommends", "--download-only", *PACKAGES)
        arguments = ("apt-get", *options, "-o", f"Dir::Cache::archives={archives}", *fetch)
        if not _succeeds(*arguments):
            _run("apt-get", "update", "--quiet=2")  # a list that is older than the archive names files that are gone
            _run(*arguments)
        wanted = _run("apt-cache", "depends", "--recurse", "--important", listed[0])
        parts = sorted(set(re.findall(r"^linux-(?:image|modules|modules-extra)-\d\S*$", wanted, re.MULTILINE)))
        _run("apt-get", *options, "download", *parts, folder=archives)

    def _unpack(self, deb: Path, kept: Iterable[str]) -> None:
        self.layer.mkdir(parents=True, exist_ok=True)
        with subprocess.Popen(("dpkg-deb", "--fsys-tarfile", str(deb)), stdout=subprocess.PIPE) as packed:
            tar = ("tar", "-x", "-C", str(self.layer), "--no-same-owner", _INTO_USR, "--wildcards", *kept)
            done = subprocess.run(tar, stdin=packed.stdout, capture_output=True, text=True, check=False)
        if done.returncode and "Not found in archive" not in done.stderr:
            raise RigError(f"{deb.name} cannot be unpacked: {done.stderr.strip()}")

    def _write_layer(self) -> None:
        units = self.layer / "etc/systemd/system"
        units.mkdir(parents=True, exist_ok=True)
        (units / "rig.target").write_text(_TARGET)
        (units / "rig.service").write_text(_SERVICE)
        files = self.layer / "etc/tmpfiles.d"
        files.mkdir(parents=True, exist_ok=True)
        (files / "tmp.conf").write_text("d /tmp 1777 root root -\n")  # Debian's own empties it: checkouts lie there
        own = self.layer / "usr/lib/rig"
        own.mkdir(parents=True, exist_ok=True)
        shutil.copy(HERE / "run_command.sh", own)

    def _write_kernel(self) -> None:
        images = sorted((self.layer / "boot").glob("vmlinuz-*"))
        if not images:
            raise RigError("no kernel came with the packages that apt gave")
        release = images[-1].name.removeprefix("vmlinuz-")
        self.kernel.write_bytes(_uncompressed(images[-1].read_bytes()))
        base = self._cache / "modules"
        base.mkdir(exist_ok=True)
        (base / "lib").unlink(missing_ok=True)
        (base / "lib").symlink_to(self.layer / "usr/lib")
        # The layer's own depmod is a link to /bin/kmod, which is not there on a host without kmod.
        (base / "depmod").unlink(missing_ok=True)
        (base / "depmod").symlink_to(self.tool("kmod"))
        _run(str(base / "depmod"), "-b", str(base), release, environment=self.environment())
        folder = self.layer / "usr/lib/modules" / release
        with self.initramfs.open("wb") as out:
            for name in ("bin", "dev", "proc", "modules", "host", "layer", "memory", "new"):
                out.write(_cpio(name, stat.S_IFDIR | 0o755))
            out.write(_cpio("bin/busybox", stat.S_IFREG | 0o755, Path(self.tool("busybox")).read_bytes()))
            out.write(_cpio("init", stat.S_IFREG | 0o755, (HERE / "first_process.sh").read_bytes()))
            for number, module in enumerate(_in_order(folder / "modules.dep")):
                out.write(_cpio(f"modules/{number:02d}.ko", stat.S_IFREG | 0o644, _module(folder / module)))
            out.write(_cpio("TRAILER!!!", 0))


def _in_order(dependencies: Path) -> Iterator[str]:
    """Yield the files of the modules that mount the root, each behind what it needs."""
    needs = dict(line.split(":", 1) for line in dependencies.read_text().splitlines())
    names = {re.sub(r"\.ko.*", "", Path(module).name).replace("-", "_"): module for module in needs}
    seen = set()
    for name in _BOOT_MODULES:
        if (wanted := names.get(name)) is None:  # built into the kernel, or the mount will say so
            continue
        for module in (*reversed(needs[wanted].split()), wanted):
            if module not in seen:
                seen.add(module)
                yield module


def _module(path: Path) -> bytes:
    """Return a module as busybox can load it: Ubuntu's are compressed."""
    if path.suffix == ".zst":
        return subprocess.run(("zstd", "-dc", str(path)), capture_output=True, check=True).stdout
    return lzma.decompress(path.read_bytes()) if path.suffix == ".xz" else path.read_bytes()


def _uncompressed(image: bytes) -> bytes:
    """Return the kernel without its wrapping, which an emulated processor takes seconds to undo."""
    at = image.find(b"\xfd7zXZ\x00")
    try:
        kernel = lzma.LZMADecompressor().decompress(image[at:]) if at >= 0 else b""
    except lzma.LZMAError:
        kernel = b""
    return kernel if kernel.startswith(b"\x7fELF") else image


def _cpio(name: str, mode: int, data: bytes = b"") -> bytes:
    """Return one entry of an initramfs: the kernel's Documentation/driver-api/early-userspace/buffer-format.rst."""
    path = name.encode() + b"\0"
    fields = (0, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(path), 0)
    head = b"070701" + b"".join(b"%08X" % field for field in fields) + path
    return head + b"\0" * (-len(head) % 4) + data + b"\0" * (-len(data) % 4)


def _succeeds(*arguments: str) -> bool:
    return subprocess.run(arguments, capture_output=True, check=False, stdin=subprocess.DEVNULL).returncode == 0


def _run(*arguments: str, folder: Path | None = None, environment: Mapping[str, str] | None = None) -> str:
    done = subprocess.run(
        arguments, cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RigError(f"`{' '.join(arguments)}` ended with {done.returncode}: {done.stderr.strip()[-2000:]}")
    return done.stdout
