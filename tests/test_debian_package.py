"""The Debian package without its environment: control files, maintainer's scripts, file list.

``tools.debian.build`` builds the whole package, ``tools.rig.fresh_debian`` tries it on a fresh Debian.
"""

import hashlib
import os
import platform
import shutil
import subprocess
from importlib.metadata import Distribution
from pathlib import Path

import pytest

from tests.system.package_trial import differences, inventory
from tools.debian import build as build_module
from tools.debian.build import EXAMPLES, SCRIPTS, Stage, pack
from tools.debian.control_files import control_text, copyright_text, oldest_libc
from twostage_servo.cli.install_service import service_files
from twostage_servo.cli.main import main
from twostage_servo.config.machine import load_machine
from twostage_servo.faults.frames import compile_profile

TOOLS = Path(__file__).resolve().parents[1] / "tools"
DATE = 1_700_000_000
PROGRAM = Path("/opt/twostage-servo/bin/twostage-servo")
TOOLS_OF_DEBIAN = ("systemctl", "udevadm", "systemd-sysusers", "userdel", "groupdel")
UNITS = ("twostage-servo.service", "twostage-servo@left.service")


class Machine:
    """A root for a maintainer's script, with tools that only write down how they were called."""

    def __init__(self, folder: Path) -> None:
        self.root, self._calls, self._bin = folder / "root", folder / "calls", folder / "bin"
        (self.root / "run/systemd/system").mkdir(parents=True)
        (self.root / "etc").mkdir()
        (self.root / "etc/passwd").write_text("root:x:0:0::/root:/bin/sh\ntwostage-servo:x:999:999::/:/bin/false\n")
        (self.root / "etc/group").write_text("root:x:0:\ntwostage-servo:x:999:me\n")
        self._bin.mkdir()
        self._calls.touch()
        for name in TOOLS_OF_DEBIAN:
            self.tool(name)

    def tool(self, name: str, also: str = "") -> None:
        path = self._bin / name
        path.write_text(f'#!/bin/sh\necho "{name} $*" >>{self._calls}\n{also}\n')
        path.chmod(0o755)

    def units_run(self) -> None:
        listing = "\\n".join(f"{unit} loaded active running Servo controller" for unit in UNITS)
        self.tool("systemctl", f'if [ "$1" = list-units ]; then printf "{listing}\\n"; fi')

    def run(self, script: str, *arguments: str, code: int = 0) -> str:
        environment = {"PATH": f"{self._bin}:{os.environ['PATH']}", "DPKG_ROOT": str(self.root)}
        command = ["sh", str(TOOLS / "debian" / script), *arguments]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)  # noqa: S603 - ours
        assert done.returncode == code, done.stderr
        return done.stdout + done.stderr

    @property
    def calls(self) -> list[str]:
        return self._calls.read_text().replace(str(self.root), "ROOT").splitlines()

    def put(self, *paths: str) -> None:
        for path in paths:
            (self.root / path).parent.mkdir(parents=True, exist_ok=True)
            (self.root / path).touch()


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


@pytest.fixture
def stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Stage:
    """A stage with all but the environment."""

    def run_here(_: Stage, *arguments: str) -> str:
        assert main(arguments) == 0
        return ""

    monkeypatch.setattr(Stage, "_program", run_here)
    made = Stage(tmp_path / "stage", DATE)
    made.root.mkdir()
    made.python = (3, 11)
    made._place_services()
    made._place_documents()
    return made


def wheel(folder: Path, name: str, *tags: str, metadata: str = "") -> Distribution:
    folder = folder / f"{name}-1.0.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n{metadata}")
    (folder / "WHEEL").write_text("".join(f"Tag: {tag}\n" for tag in tags))
    return Distribution.at(folder)


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_maintainers_script_is_one_that_a_shell_can_read(script: str) -> None:
    path = TOOLS / "debian" / script
    assert path.read_text().startswith("#!/bin/sh\n")
    assert "\nset -e\n" in path.read_text()
    subprocess.run(["sh", "-n", str(path)], check=True)  # noqa: S603, S607 - our own text


def test_the_control_file_has_what_dpkg_needs() -> None:
    text = control_text("1.2+3", "arm64", (3, 11), (2, 28), 1234)
    fields = dict(line.split(": ", 1) for line in text.splitlines() if not line.startswith(" "))
    assert fields["Package"] == "twostage-servo"
    assert fields["Version"] == "1.2+3"
    assert fields["Architecture"] == "arm64"
    assert fields["Installed-Size"] == "1234"
    needs = fields["Depends"].split(", ")
    assert needs[:3] == ["python3 (>= 3.11)", "python3 (<< 3.12)", "libc6 (>= 2.28)"]
    assert {"systemd", "udev"} <= set(needs)
    assert text.endswith(".\n")
    assert max(map(len, text.splitlines())) <= 120


def test_the_c_library_is_the_one_that_the_neediest_wheel_needs(tmp_path: Path) -> None:
    assert oldest_libc([wheel(tmp_path, "pure", "py3-none-any")]) == (2, 17)
    old = wheel(tmp_path, "old", "cp311-cp311-manylinux2014_x86_64", "cp311-cp311-manylinux_2_28_x86_64")
    assert oldest_libc([old]) == (2, 17)  # a wheel with two tags runs with the older
    new = wheel(tmp_path, "new", "cp311-cp311-manylinux_2_34_x86_64")
    assert oldest_libc([old, new]) == (2, 34)
    own = wheel(tmp_path, "own", "cp311-cp311-linux_x86_64")
    here = platform.libc_ver()[1].split(".")
    assert oldest_libc([own]) == max((2, 17), (int(here[0]), int(here[1])))


def test_the_copyright_names_the_licence_of_each_package(tmp_path: Path) -> None:
    packages = [
        wheel(tmp_path, "modern", metadata="License-Expression: BSD-3-Clause\n"),
        wheel(tmp_path, "classified", metadata="Classifier: License :: OSI Approved :: MIT License\n"),
        wheel(tmp_path, "told", metadata="License: LGPL v3\n"),
        wheel(tmp_path, "silent"),
    ]
    text = copyright_text(packages)
    for line in (
        "modern 1.0: BSD-3-Clause",
        "classified 1.0: MIT License",
        "told 1.0: LGPL v3",
        "silent 1.0: see there",
    ):
        assert f"\n {line}\n" in text


def test_a_later_build_is_a_newer_version() -> None:
    assert build_module.version(0).endswith("+19700101000000")
    assert build_module.version(DATE) < build_module.version(DATE + 1)


def test_the_package_has_units_link_and_documents(stage: Stage) -> None:
    documents = [f"usr/share/doc/twostage-servo/examples/{name}" for name in EXAMPLES]
    pages = [str(page.relative_to(TOOLS.parent)) for page in (TOOLS.parent / "docs").rglob("*") if page.is_file()]
    assert "docs/operations.md" in pages
    pages += ["README.md", "changelog.gz", "copyright", "packages.txt"]
    documents += [f"usr/share/doc/twostage-servo/{name}" for name in pages]
    units = service_files(PROGRAM, 500_000, vendor=True)
    assert stage.files() == sorted([*units, *documents, "usr/bin/twostage-servo"])
    for path, text in units.items():
        assert (stage.root / path).read_text() == text
    link = stage.root / "usr/bin/twostage-servo"
    assert Path(os.path.normpath(link.parent / link.readlink())) == stage.root / PROGRAM.relative_to("/")
    assert (stage.root / "etc/twostage-servo").is_dir()


def test_the_examples_are_complete(stage: Stage) -> None:
    folder = stage.root / "usr/share/doc/twostage-servo/examples"
    for path in folder.glob("*.toml"):
        for loaded in load_machine(path).axes:
            compile_profile(loaded)


def test_what_is_shipped_to_start_from_is_among_the_examples() -> None:
    shipped = {path.name for path in (TOOLS.parent / "config").iterdir() if path.suffix in {".toml", ".dbc"}}
    assert shipped - set(EXAMPLES) == {"demo.toml", "example1.toml", "example2.toml"}  # which the program itself names


@pytest.mark.skipif(shutil.which("dpkg-deb") is None, reason="dpkg-deb is not installed")
def test_what_is_packed_is_roots_and_comes_out_as_it_went_in(stage: Stage, tmp_path: Path) -> None:
    listed = stage.files()
    package = pack(stage, tmp_path, "all", DATE)
    assert package.name == f"twostage-servo_{build_module.version(DATE)}_all.deb"
    told = subprocess.run(["dpkg-deb", "--contents", package], capture_output=True, text=True, check=True).stdout  # noqa: S603, S607
    rows = [line.split(maxsplit=5) for line in told.splitlines()]
    assert {row[1] for row in rows} == {"root/root"}
    files = sorted(row[5].split(" -> ")[0].removeprefix("./") for row in rows if not row[0].startswith("d"))
    assert files == listed
    out = tmp_path / "out"
    subprocess.run(["dpkg-deb", "--raw-extract", package, out], check=True)  # noqa: S603, S607
    for line in (out / "DEBIAN/md5sums").read_text().splitlines():
        value, path = line.split("  ")
        assert hashlib.md5((out / path).read_bytes(), usedforsecurity=False).hexdigest() == value
    for script in SCRIPTS:
        assert (out / "DEBIAN" / script).read_text() == (TOOLS / "debian" / script).read_text()
        assert (out / "DEBIAN" / script).stat().st_mode & 0o777 == 0o755


def test_nothing_is_started_when_it_is_installed(machine: Machine) -> None:
    assert machine.run("postinst", "configure", "") == ""
    assert machine.calls == [
        "systemd-sysusers --root=ROOT twostage-servo.conf", "systemctl daemon-reload", "udevadm control --reload",
    ]  # fmt: skip


def test_where_no_systemd_runs_only_the_user_is_made(machine: Machine) -> None:
    (machine.root / "run/systemd/system").rmdir()
    machine.run("postinst", "configure", "")
    assert machine.calls == ["systemd-sysusers --root=ROOT twostage-servo.conf"]


@pytest.mark.parametrize("path", service_files(PROGRAM, 500_000))
def test_a_file_that_outranks_one_of_the_package_is_told(machine: Machine, path: str) -> None:
    machine.put(path)
    assert f"/{path} outranks" in machine.run("postinst", "configure", "")


def test_another_installation_in_the_same_folder_is_not_mixed_up(machine: Machine) -> None:
    machine.run("preinst", "install")
    machine.put("opt/twostage-servo/bin/pip")
    assert "/opt/twostage-servo is there already" in machine.run("preinst", "install", code=1)
    machine.run("preinst", "upgrade", "0.1.0")


def test_an_upgrade_stops_what_runs_and_says_how_to_start_it(machine: Machine) -> None:
    machine.units_run()
    told = machine.run("prerm", "upgrade", "0.2.0")
    assert f"systemctl start {' '.join(UNITS)}\n" in told
    assert machine.calls[1:] == [f"systemctl stop {' '.join(UNITS)}"]


def test_an_upgrade_with_nothing_running_says_nothing(machine: Machine) -> None:
    assert machine.run("prerm", "upgrade", "0.2.0") == ""
    assert len(machine.calls) == 1


def test_removal_stops_and_disables_every_instance(machine: Machine) -> None:
    machine.units_run()
    assert "systemctl start" not in machine.run("prerm", "remove")
    assert machine.calls[1:] == [
        f"systemctl stop {' '.join(UNITS)}",
        "systemctl --root=ROOT --quiet disable twostage-servo.service twostage-servo@.service",
    ]
    machine.run("postrm", "remove")
    assert "systemctl daemon-reload" in machine.calls


def test_purge_leaves_nothing_of_it_and_everything_of_others(machine: Machine) -> None:
    others = ("etc/other.toml", "var/lib/private/other/trips/1", "opt/other/bin/x", "var/lib/twostage/x")
    machine.put(*others)
    before = inventory(str(machine.root))
    state = ("var/lib/private/twostage-servo/trips/1", "var/lib/private/twostage-servo-left/trips/1")
    own = ("etc/twostage-servo/servo.toml", "opt/twostage-servo/lib/left")
    machine.put(*state, *own)
    for name in ("twostage-servo", "twostage-servo-left"):
        (machine.root / "var/lib" / name).symlink_to(f"private/{name}")
    machine.run("postrm", "remove")
    assert differences(before, inventory(str(machine.root)))  # what the operator has made is still there
    machine.run("postrm", "purge")
    assert not differences(before, inventory(str(machine.root)))
    assert machine.calls[-2:] == ["userdel --prefix ROOT twostage-servo", "groupdel --prefix ROOT twostage-servo"]


def test_the_trial_sees_what_was_added_removed_and_changed(tmp_path: Path) -> None:
    (tmp_path / "kept").touch()
    (tmp_path / "link").symlink_to("kept")
    (tmp_path / "gone").touch()
    before = inventory(str(tmp_path))
    (tmp_path / "gone").unlink()
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to("other")
    (tmp_path / "new").touch()
    seen = differences(before, inventory(str(tmp_path)))
    top = str(tmp_path)
    assert seen == {"added": [f"{top}/new"], "removed": [f"{top}/gone"], "changed": [f"{top}/link"]}
