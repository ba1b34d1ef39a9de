"""Every check in its good, its bad and its absent form."""

from pathlib import Path

import pytest

from tests.host.machine import FakeKernel, fake_host
from twostage_servo.host import machine_checks as checks
from twostage_servo.host.findings import Finding, Host, Status
from twostage_servo.host.folder_checks import folder_finding
from twostage_servo.host.kernel import CAP_IPC_LOCK, CAP_SYS_NICE
from twostage_servo.host.settings import RealtimeSettings

CPU = "sys/devices/system/cpu/"
CLOCK = "sys/devices/system/clocksource/clocksource0/"
VERSION = "Linux version 6.1.0-28-amd64 (debian) (gcc-12) #1 SMP "


@pytest.mark.parametrize(
    ("files", "status", "words"),
    [
        (
            {"sys/kernel/realtime": "1\n", "proc/version": VERSION},
            Status.OK,
            "Linux version 6.1.0-28-amd64, PREEMPT_RT",
        ),
        ({"proc/version": VERSION + "PREEMPT_RT Debian 6.1"}, Status.OK, "PREEMPT_RT"),
        ({"proc/version": VERSION + "PREEMPT_DYNAMIC Debian"}, Status.WARN, "PREEMPT_DYNAMIC: "),
        ({"proc/version": VERSION}, Status.WARN, "no preemption"),
        ({}, Status.SKIP, "cannot be read"),
    ],
)
def test_kernel(tmp_path: Path, files: dict[str, str], status: Status, words: str) -> None:
    expect(checks.kernel_finding(fake_host(tmp_path, files)), status, words)


@pytest.mark.parametrize(
    ("files", "status", "words"),
    [
        ({CLOCK + "current_clocksource": "tsc\n"}, Status.OK, "tsc"),
        ({CLOCK + "current_clocksource": "hpet\n"}, Status.WARN, "hpet, which is slow"),
        ({}, Status.SKIP, "cannot be read"),
    ],
)
def test_clock_source(tmp_path: Path, files: dict[str, str], status: Status, words: str) -> None:
    expect(checks.clock_finding(fake_host(tmp_path, files)), status, words)


@pytest.mark.parametrize(
    ("governors", "status", "words"),
    [
        (["performance", "performance"], Status.OK, "performance"),
        (["performance", "schedutil"], Status.WARN, "performance, schedutil: "),
        ([], Status.SKIP, "does not scale"),
    ],
)
def test_governor(tmp_path: Path, governors: list[str], status: Status, words: str) -> None:
    files = {f"{CPU}cpu{n}/cpufreq/scaling_governor": f"{governor}\n" for n, governor in enumerate(governors)}
    expect(checks.governor_finding(fake_host(tmp_path, files)), status, words)


@pytest.mark.parametrize(
    ("asked", "isolated", "quiet", "status", "words"),
    [
        ([], "\n", "(null)\n", Status.OK, "CPU 0,1,2,3 online, none isolated"),
        ([2, 3], "2-3\n", "2-3\n", Status.OK, "CPU 2,3 isolated, without"),
        ([3], "2-3\n", None, Status.OK, "CPU 3 isolated, but with"),
        ([3], "\n", None, Status.WARN, "CPU 3 requested, but other processes"),
        ([], "3\n", None, Status.WARN, "CPU 3 isolated, but not used"),
        ([3, 7], "3\n", None, Status.FAIL, "names CPU 7; online: CPU 0,1,2,3"),
    ],
)
def test_cpus(tmp_path: Path, asked: list[int], isolated: str, quiet: str | None, status: Status, words: str) -> None:
    files = {CPU + "online": "0-1,2-3\n", CPU + "isolated": isolated}
    if quiet is not None:
        files[CPU + "nohz_full"] = quiet
    expect(checks.cpus_finding(fake_host(tmp_path, files), asked), status, words)


def test_cpus_that_are_not_told(tmp_path: Path) -> None:
    expect(checks.cpus_finding(fake_host(tmp_path, {}), [1]), Status.SKIP, "cannot be read")


@pytest.mark.parametrize(
    ("priority", "limit", "capabilities", "status", "words"),
    [
        (0, 0, [], Status.SKIP, "not requested"),
        (50, None, [], Status.OK, "up to 99"),
        (50, 50, [], Status.OK, "up to 50"),
        (50, 0, [CAP_SYS_NICE], Status.OK, "CAP_SYS_NICE"),
        (50, 49, [], Status.FAIL, "up to 49 allowed"),
    ],
)
def test_priority(priority: int, limit: int | None, capabilities: list[int], status: Status, words: str) -> None:
    finding = checks.priority_finding(FakeKernel(limit=limit, capabilities=capabilities), priority)
    expect(finding, status, words)
    assert status is not Status.FAIL or "LimitRTPRIO=50" in finding.remedy


@pytest.mark.parametrize(
    ("text", "priority", "status", "words"),
    [
        ("950000\n", 50, Status.OK, "950000 of 1000000"),
        ("-1\n", 50, Status.WARN, "off"),
        ("0\n", 50, Status.FAIL, "no time"),
        ("-1\n", 0, Status.SKIP, "not requested"),
        (None, 50, Status.SKIP, "cannot be read"),
    ],
)
def test_throttling(tmp_path: Path, text: str | None, priority: int, status: Status, words: str) -> None:
    files = {} if text is None else {"proc/sys/kernel/sched_rt_runtime_us": text}
    expect(checks.throttling_finding(fake_host(tmp_path, files), priority), status, words)


@pytest.mark.parametrize(
    ("asked", "limit", "capabilities", "status", "words"),
    [
        (False, 0, [], Status.SKIP, "not requested"),
        (True, None, [], Status.OK, "unlimited"),
        (True, 1 << 30, [], Status.OK, "1048576 KiB allowed"),
        (True, 8 << 20, [CAP_IPC_LOCK], Status.OK, "CAP_IPC_LOCK"),
        (True, 8 << 20, [], Status.FAIL, "8192 KiB allowed"),
    ],
)
def test_locked_memory(asked: bool, limit: int | None, capabilities: list[int], status: Status, words: str) -> None:
    expect(checks.memory_finding(FakeKernel(limit=limit, capabilities=capabilities), asked=asked), status, words)


SWAPS = "Filename\t\t\t\tType\t\tSize\n"


@pytest.mark.parametrize(
    ("text", "locked", "status", "words"),
    [
        (SWAPS, False, Status.OK, "none"),
        (SWAPS + "/dev/sda2 partition 999\n", True, Status.OK, "/dev/sda2; the service's memory is locked"),
        (SWAPS + "/dev/sda2 partition 999\n", False, Status.WARN, "/dev/sda2: a tick may"),
        (None, False, Status.SKIP, "cannot be read"),
    ],
)
def test_swap(tmp_path: Path, text: str | None, locked: bool, status: Status, words: str) -> None:
    files = {} if text is None else {"proc/swaps": text}
    expect(checks.swap_finding(fake_host(tmp_path, files), locked=locked), status, words)


def test_timer_slack(tmp_path: Path) -> None:
    expect(checks.timer_slack_finding(fake_host(tmp_path, {})), Status.SKIP, "cannot be read")
    host = fake_host(tmp_path, {"proc/self/timerslack_ns": "50000\n"})
    expect(checks.timer_slack_finding(host), Status.OK, "50000 ns; the service sets 1 ns")


@pytest.mark.parametrize(
    ("files", "status", "words"),
    [
        ({"proc/cpuinfo": "flags\t\t: fpu tsc\n"}, Status.OK, "no sign"),
        ({"proc/cpuinfo": "flags\t\t: fpu hypervisor\n"}, Status.WARN, "a virtual machine: "),
        (
            {"proc/cpuinfo": "flags : hypervisor\n", "sys/class/dmi/id/sys_vendor": "QEMU\n"},
            Status.WARN,
            "a virtual machine (QEMU)",
        ),
        (
            {"proc/cpuinfo": "Features\t: fp asimd\n", "proc/device-tree/hypervisor/compatible": "xen,xen"},
            Status.WARN,
            "a virtual machine",
        ),
        ({}, Status.SKIP, "cannot be read"),
    ],
)
def test_virtualisation(tmp_path: Path, files: dict[str, str], status: Status, words: str) -> None:
    expect(checks.virtualisation_finding(fake_host(tmp_path, files)), status, words)


@pytest.mark.parametrize(
    ("version", "free_threaded", "status"),
    [((3, 11), False, Status.OK), ((3, 13), True, Status.WARN), ((3, 10), False, Status.WARN)],
)
def test_python(version: tuple[int, int], free_threaded: bool, status: Status) -> None:
    expect(checks.python_finding(version, free_threaded=free_threaded), status, f"{version[0]}.{version[1]}")


@pytest.mark.parametrize(
    ("priority", "limit", "status", "words"),
    [(50, 0, Status.OK, ""), (0, 0, Status.WARN, "LimitRTPRIO"), (0, 99, Status.WARN, "realtime.priority = 40")],
)
def test_advice_on_scheduling(priority: int, limit: int, status: Status, words: str) -> None:
    finding = checks.scheduling_advice(FakeKernel(limit=limit), priority)
    assert finding.status is status
    assert words in finding.remedy
    assert ("LimitRTPRIO" in finding.remedy) is (limit == 0 and priority == 0)


def test_all_of_them_on_this_machine_and_on_one_that_tells_nothing(tmp_path: Path) -> None:
    for host in (Host(), fake_host(tmp_path, {})):
        findings = checks.check_machine(host, RealtimeSettings(priority=50, lock_memory=True), FakeKernel())
        assert len({finding.name for finding in findings}) == len(findings) == 11
        for finding in findings:
            assert (finding.remedy != "") is (finding.status in {Status.WARN, Status.FAIL}), finding


# Folders --------------------------------------------------------------------------------------------------------------


def test_a_folder_that_is_there_or_can_be_made(tmp_path: Path) -> None:
    def free(_: Path) -> int:
        return 1 << 30

    expect(folder_finding("f", tmp_path, "k", free_bytes=free), Status.OK, f"{tmp_path}, 1024 MiB free")
    absent = tmp_path / "a" / "b"
    expect(folder_finding("f", absent, "k", free_bytes=free), Status.OK, f"{absent} (will be created), 1024")
    assert not absent.exists()


def test_a_folder_that_cannot_be_used(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    expect(folder_finding("f", file, "k"), Status.FAIL, "is not a folder")
    expect(folder_finding("f", tmp_path / "x", "k", may_write=lambda _: False), Status.FAIL, "cannot be created in")
    expect(folder_finding("f", tmp_path, "k", may_write=lambda _: False), Status.FAIL, "cannot be written")
    expect(folder_finding("f", Path("/" + 300 * "x"), "k"), Status.FAIL, "cannot be examined")
    tmp_path.chmod(0o777)
    expect(folder_finding("f", tmp_path, "k"), Status.FAIL, "everybody can write to")
    tmp_path.chmod(0o1777)
    assert folder_finding("f", tmp_path, "k", free_bytes=lambda _: 1 << 30).status is Status.OK


@pytest.mark.parametrize(("free_mib", "status"), [(101, Status.OK), (99, Status.WARN), (9, Status.FAIL)])
def test_a_disk_that_is_nearly_full(tmp_path: Path, free_mib: int, status: Status) -> None:
    assert folder_finding("f", tmp_path, "k", free_bytes=lambda _: free_mib << 20).status is status


def expect(finding: Finding, status: Status, words: str) -> None:
    assert finding.status is status
    assert words in finding.found
    assert (finding.remedy != "") is (status in {Status.WARN, Status.FAIL})
    assert finding.as_json()["status"] == str(status)
