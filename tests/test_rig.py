"""The rig's own parts; the machine itself is booted by hand or in CI, not by a test."""

import json
import lzma
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import TYPE_CHECKING, cast

import pytest

from tests.system import scenarios as scenarios_module
from tools.rig import bench as bench_module
from tools.rig import fresh_debian as fresh_module
from tools.rig import guest as guest_module
from tools.rig import run as run_module
from tools.rig.guest import Guest, RigError
from twostage_servo.cli.main import main

if TYPE_CHECKING:
    from tools.rig.bench import Bench

TREE = Path(__file__).resolve().parents[1]


@pytest.fixture
def guest(tmp_path: Path) -> Guest:
    """A guest whose layer has the programs that start the machine."""
    made = Guest(tmp_path)
    (made.layer / "usr/bin").mkdir(parents=True)
    for name in ("qemu-system-x86_64", "setpriv"):
        program = made.layer / "usr/bin" / name
        program.write_text("#!/bin/sh\nexit 3\n")
        program.chmod(0o755)
    return made


def test_an_entry_of_the_initramfs_is_as_the_kernel_reads_it() -> None:
    entry = guest_module._cpio("init", 0o100755, b"12345")
    assert entry[:6] == b"070701"
    fields = [int(entry[6 + 8 * index : 14 + 8 * index], 16) for index in range(13)]
    assert (fields[1], fields[6], fields[11]) == (0o100755, 5, 5)
    assert entry[110:116] == b"init\0\0"  # header and name fill whole words
    assert entry[116:] == b"12345\0\0\0"
    assert len(entry) % 4 == 0


def test_a_module_stands_behind_what_it_needs(tmp_path: Path) -> None:
    dependencies = tmp_path / "modules.dep"
    dependencies.write_text(
        "fs/9p/9p.ko: net/9p/9pnet.ko fs/netfs.ko\nnet/9p/9pnet.ko:\nfs/netfs.ko:\n"
        "net/9p/9pnet_virtio.ko: net/9p/9pnet.ko\n"
    )
    order = list(guest_module._in_order(dependencies))
    assert sorted(order) == ["fs/9p/9p.ko", "fs/netfs.ko", "net/9p/9pnet.ko", "net/9p/9pnet_virtio.ko"]
    for needed, by in (("net/9p/9pnet", "fs/9p/9p"), ("fs/netfs", "fs/9p/9p"), ("net/9p/9pnet", "net/9p/9pnet_virtio")):
        assert order.index(f"{needed}.ko") < order.index(f"{by}.ko")


def test_a_wrapped_kernel_is_unwrapped_and_another_left_as_it_is() -> None:
    kernel = b"\x7fELF" + bytes(100)
    assert guest_module._uncompressed(b"boot code" + lzma.compress(kernel) + b"trailer") == kernel
    for other in (b"no archive in it", b"x\xfd7zXZ\x00 broken", b"boot" + lzma.compress(b"no kernel")):
        assert guest_module._uncompressed(other) == other


@pytest.mark.parametrize(("boards", "count"), [(0, 0), (3, 3)])
def test_the_machine_has_the_boards_that_were_asked_for(guest: Guest, tmp_path: Path, boards: int, count: int) -> None:
    arguments = run_module.machine(guest, tmp_path, "tcg", boards, 1024)
    assert arguments.count("kvaser_pci,canbus=bus") == count
    assert [one for one in arguments if "path=/," in one] == [
        "local,security_model=none,multidevs=remap,id=host,path=/,readonly=on"  # nothing of the host can be changed
    ]


def test_another_root_is_booted_read_only_beside_the_hosts(guest: Guest, tmp_path: Path) -> None:
    arguments = run_module.machine(guest, tmp_path, "tcg", 0, 1024, tmp_path / "a,b")
    disks = [one for one in arguments if one.startswith("local,") and "id=exchange" not in one]
    assert len(disks) == 3
    assert all(one.endswith(",readonly=on") for one in disks)
    assert f"local,security_model=none,multidevs=remap,id=root,path={tmp_path}/a,,b,readonly=on" in disks
    assert arguments[arguments.index("-append") + 1].endswith(" rig.root=other")


def test_a_folder_that_is_to_be_in_memory_is_packed_at_its_path(tmp_path: Path) -> None:
    for name in ("package/module.py", "package/tests/test_module.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    run_module._pack([tmp_path / "package"], tmp_path / "packed")
    with tarfile.open(tmp_path / "packed") as packed:
        assert [one for one in packed.getnames() if one.endswith(".py")] == [f"{tmp_path}/package/module.py"[1:]]
    with pytest.raises(RigError, match="cannot be packed"):
        run_module._pack([tmp_path / "absent"], tmp_path / "packed")


def test_check_accepts_the_configuration_of_the_rigs_axes(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text(bench_module.patient((TREE / "config/socketcan.toml").read_text()))
    assert main(["check", "--config", str(path)]) == 0


def test_a_root_without_systemd_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        run_module.parse(["--root", str(tmp_path), "--", "true"])
    assert caught.value.code == 2
    assert "lib/systemd/systemd" in capsys.readouterr().err


def test_a_machine_that_ends_without_a_status_is_the_rigs_failure(
    guest: Guest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    options = run_module.parse(["--accelerator", "tcg", "--", "true"])
    with pytest.raises(RigError, match="ended without having run the command"):
        run_module.run(guest, ["true"], options, sys.stderr)
    assert not list(tmp_path.glob("rig-*"))  # and nothing is left behind


def test_without_a_command_it_only_fetches(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = []
    monkeypatch.setattr(Guest, "make", lambda self: made.append(self.layer))
    monkeypatch.setattr(sys, "argv", ["run.py", "--cache", str(tmp_path), "--json"])
    monkeypatch.setattr(run_module, "run", None)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    assert run_module.main() == 0
    assert made == [tmp_path / "layer"]
    assert json.loads(capsys.readouterr().out)["status"] == 0


@pytest.mark.parametrize("wrong", [["--timeout", "0"], ["--boards", "9"], ["--memory", "16"]])
def test_options_that_cannot_be_meant_are_refused(wrong: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        run_module.parse([*wrong, "--", "true"])
    assert caught.value.code == 2


def test_a_fresh_debian_is_made_from_where_apt_gets_its_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = "bookworm-security http://one.invalid/security\nbookworm http://one.invalid/debian\n"
    monkeypatch.setattr(fresh_module, "_run", lambda *_: listed)
    assert fresh_module.apts_mirror("bookworm") == "http://one.invalid/debian"
    with pytest.raises(fresh_module.FreshError, match="--mirror"):
        fresh_module.apts_mirror("trixie")


def test_candumps_log_is_decoded_without_the_package(tmp_path: Path) -> None:
    """The frames were packed by hand from config/servo_drive.dbc: position in um, counter in bits 20 to 23."""
    log = tmp_path / "log"
    log.write_text(
        "(1.0) can0 201#18FC1000\n(1.1) can0 181#E8030000010000FF\n(1.2) can0 201#D0073100\n(1.3) can1 201#00004000\n"
        "(1.4) can0 181##118FCFFFF01000000\n(1.5) can0 20000004#0008000000000000\n"
    )
    command = [sys.executable, "-m", "tools.rig.decode", str(log), "can0"]
    done = subprocess.run(command, cwd=TREE, capture_output=True, text=True, check=True)  # noqa: S603 - our own program
    assert json.loads(done.stdout)["can0"] == {
        "commands": 2, "gaps": 1, "feedbacks": 2, "can_fd": 1, "first": 1.0, "last": -1.0, "highest": 1.0,
        "last_command": {"effort": 2.0, "enable": 1}, "braking_commands": 1,
    }  # fmt: skip


class StallingBench:
    """Its journal grows by a trip for lost commands, or by another one, whenever a scenario fails."""

    def __init__(self, *codes: str) -> None:
        self.codes = list(codes)
        self.entries: list[dict[str, str]] = []

    def journal(self) -> list[dict[str, str]]:
        return self.entries

    def scenario(self, _: object) -> dict[str, object]:
        if self.codes:
            self.entries.append({"CODE": self.codes.pop(0)})
            raise AssertionError(f"failed {len(self.entries)}")
        return {"trip_s": 0.1}


@pytest.mark.parametrize(
    ("codes", "told"),
    [
        ([], {"trip_s": 0.1}),
        (["commands_dropped"], {"stalled": "AssertionError: failed 1", "trip_s": 0.1}),
        (["commands_dropped"] * 2, {"stalled": "AssertionError: failed 1", "failed": "AssertionError: failed 2"}),
        (["stale_feedback"], {"failed": "AssertionError: failed 1"}),
    ],
)
def test_a_scenario_is_begun_anew_only_after_a_stall_and_only_once(
    codes: list[str], told: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    restored: list[object] = []
    monkeypatch.setattr(scenarios_module, "restore", restored.append)
    bench = StallingBench(*codes)
    assert scenarios_module.go_through(bench.scenario, cast("Bench", bench)) == told
    assert len(restored) == len(codes)


def test_a_scenario_that_fills_the_bus_itself_has_one_attempt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenarios_module, "restore", lambda _: None)
    bench = StallingBench("commands_dropped")
    scenario = bench.scenario
    monkeypatch.setattr(scenarios_module, "_FILL_THE_BUS", {scenario})
    told = scenarios_module.go_through(scenario, cast("Bench", bench))
    assert told == {"failed": "AssertionError: failed 1"}
