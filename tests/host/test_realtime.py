import os
import platform
import pwd
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import ValidationError

from tests.host.machine import FakeKernel
from twostage_servo.host import realtime
from twostage_servo.host.kernel import CAP_IPC_LOCK, CAP_SYS_NICE, Kernel
from twostage_servo.host.settings import RealtimeSettings

ALL = RealtimeSettings(priority=50, cpus=[2, 3], lock_memory=True)


def test_the_defaults_ask_for_nothing_that_can_be_refused() -> None:
    kernel = FakeKernel(refused=["fifo", "cpus", "memory", "slack", "slice"])
    report = realtime.apply(RealtimeSettings(), kernel)
    assert [grant.name for grant in report.grants] == ["timer slack", "time slice", "thread switching"]
    assert report.grants[1].granted == "the usual one (Operation not permitted)"
    assert report.warnings == []


def test_what_is_granted_is_read_back() -> None:
    kernel = FakeKernel()
    report = realtime.apply(ALL, kernel)
    assert report.warnings == []
    assert {grant.name: grant.granted for grant in report.grants} == {
        "timer slack": "1 ns",
        "time slice": "100 µs",
        "thread switching": "100 µs",
        "cpus": "2,3",
        "memory": "100000 KiB locked",
        "scheduling": "SCHED_FIFO 50",
    }
    assert kernel.prefaulted
    assert all(grant["warning"] == grant["remedy"] == "" for grant in report.as_json())


def test_every_refusal_is_a_warning_with_a_line_to_paste() -> None:
    kernel = FakeKernel(refused=["fifo", "cpus", "memory", "slack", "slack read"])
    report = realtime.apply(ALL, kernel)
    remedies = {grant.name: grant.remedy for grant in report.warnings}
    assert remedies.keys() == {"cpus", "memory", "scheduling"}
    assert "AllowedCPUs=2,3" in remedies["cpus"]
    assert "LimitMEMLOCK=infinity" in remedies["memory"]
    assert " - memlock unlimited' in /etc/security/limits.d/" in remedies["memory"]
    assert "LimitRTPRIO=50" in remedies["scheduling"]
    assert "AmbientCapabilities=CAP_SYS_NICE" in remedies["scheduling"]
    assert " - rtprio 50' in /etc/security/limits.d/" in remedies["scheduling"]
    assert all("Operation not permitted" in grant.warning for grant in report.warnings)
    assert not kernel.prefaulted


def test_a_part_of_the_cpus_is_a_warning() -> None:
    (grant,) = realtime.apply(RealtimeSettings(cpus=[3, 9]), FakeKernel()).warnings
    assert (grant.asked, grant.granted) == ("3,9", "3")


def test_memory_is_not_locked_under_a_limit_that_leaves_no_room_to_grow() -> None:
    """Under such a limit mlockall itself succeeds, and an allocation fails hours later."""
    kernel = FakeKernel(limit=200_000 << 10)
    (grant,) = realtime.apply(RealtimeSettings(lock_memory=True), kernel).warnings
    assert not kernel.locked
    assert "200000 KiB may be locked, but 362144 KiB are needed" in grant.warning
    for kernel in (FakeKernel(limit=400_000 << 10), FakeKernel(limit=0, capabilities=[CAP_IPC_LOCK])):
        assert realtime.apply(RealtimeSettings(lock_memory=True), kernel).warnings == []
        assert kernel.locked


def test_a_process_that_is_privileged_and_refused_all_the_same_is_told_of_its_cgroup() -> None:
    kernel = FakeKernel(refused=["fifo"], capabilities=[CAP_SYS_NICE])
    (grant,) = realtime.apply(RealtimeSettings(priority=1), kernel).warnings
    assert "rt_group_sched=0" in grant.remedy


def test_a_user_without_a_name_is_named_by_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(_: int) -> None:
        raise KeyError

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    assert realtime.user_name().startswith("#")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"busy_wait": 1000.1}, "from 0 to 1000"),
        ({"busy_wait": -1}, "from 0 to 1000"),
        ({"busy_wait": "fast"}, "'off' or 'auto'"),
        ({"busy_wait": True}, "valid number"),
        ({"priority": 100}, "less than or equal to 99"),
        ({"cpus": [-1]}, "number, 0 or greater"),
        ({"cpus": [1, 1]}, "named twice"),
    ],
)
def test_settings_that_make_no_sense_are_refused(values: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        RealtimeSettings.model_validate(values)


# The real kernel: what is changed is the state of a thread that then ends ---------------------------------------------


def in_thread(function: Callable[[], None]) -> None:
    errors: list[BaseException] = []

    def call() -> None:
        try:
            function()
        except BaseException as error:  # noqa: BLE001 - raised again below
            errors.append(error)

    thread = threading.Thread(target=call)
    thread.start()
    thread.join()
    if errors:
        raise errors[0]


def test_the_timer_slack_of_this_thread_can_be_set() -> None:
    def check() -> None:
        kernel = Kernel()
        kernel.set_timer_slack(realtime.TIMER_SLACK_NS)
        assert kernel.timer_slack() == realtime.TIMER_SLACK_NS

    in_thread(check)


def test_the_time_slice_of_this_thread_can_be_set_where_the_kernel_has_one() -> None:
    def check() -> None:
        kernel = Kernel()
        before = os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)
        usual = kernel.time_slice()
        kernel.set_time_slice(realtime.TIME_SLICE_NS)
        # Linux before 6.12 says 0 and does not take it; one that says what it is has to take it.
        assert kernel.time_slice() == (realtime.TIME_SLICE_NS if usual else 0)
        assert (os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)) == before

    in_thread(check)


def test_a_processor_whose_numbers_are_not_known_keeps_its_time_slice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "vax")
    with pytest.raises(OSError, match="not implemented"):
        Kernel().set_time_slice(realtime.TIME_SLICE_NS)


def test_the_cpus_of_this_thread_can_be_set_to_ones_that_are_there() -> None:
    def check() -> None:
        kernel = Kernel()
        one = {min(kernel.cpus())}
        kernel.set_cpus(one)
        assert kernel.cpus() == one
        with pytest.raises(OSError, match="Invalid argument"):
            kernel.set_cpus({8191})

    in_thread(check)


def test_the_priority_is_granted_or_refused_and_never_inherited() -> None:
    def check() -> None:
        kernel = Kernel()
        assert not kernel.scheduling()[0]
        try:
            kernel.set_fifo(1)
        except OSError:
            assert not kernel.scheduling()[0]
        else:
            assert kernel.scheduling() == (True, 1)
            in_thread(lambda: None if not Kernel().scheduling()[0] else pytest.fail("inherited"))

    in_thread(check)


def test_the_interval_of_thread_switching_can_be_set() -> None:
    kernel = Kernel()
    before_s = kernel.switch_interval()
    try:
        kernel.set_switch_interval(realtime.SWITCH_INTERVAL_S)
        assert kernel.switch_interval() == pytest.approx(realtime.SWITCH_INTERVAL_S)
    finally:
        kernel.set_switch_interval(before_s)


def test_faulting_memory_in_leaves_everything_as_it_was() -> None:
    Kernel().prefault()


def test_the_status_of_the_process_is_read(tmp_path: Path) -> None:
    (tmp_path / "self").mkdir()
    (tmp_path / "self" / "status").write_text("VmLck:\t   12 kB\nCapEff:\t0000000000004000\n")
    kernel = Kernel(tmp_path)
    assert kernel.status_kib("VmLck") == 12
    assert kernel.status_kib("VmSize") == 0
    assert kernel.has_capability(CAP_IPC_LOCK)
    assert not kernel.has_capability(CAP_SYS_NICE)
    assert Kernel(tmp_path / "absent").status("VmLck") == ""
    assert Kernel(tmp_path / "absent").has_capability(CAP_SYS_NICE) is False
    assert isinstance(Kernel().limit(7), int | None)
