"""Asks the kernel for what ``[realtime]`` says, and reports what was granted; a refusal is a warning, no error."""

import os
import pwd
import resource
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Final

from twostage_servo.host.kernel import CAP_IPC_LOCK, CAP_SYS_NICE, Kernel
from twostage_servo.host.settings import RealtimeSettings

TIMER_SLACK_NS: Final = 1
"""The default of 50 µs saves energy on a laptop by bundling wake-ups; a servo loop gains nothing from that."""

TIME_SLICE_NS: Final = 100_000
"""The shortest that Linux gives: who asks for less at a time is let in sooner. The usual one has some ms."""

SWITCH_INTERVAL_S: Final = 1e-4
"""Python's default of 5 ms is half a tick, which the loop may have to wait for a thread that writes a trip file."""

MEMORY_TO_GROW_KIB: Final = 256 << 10
"""Room that the limit of locked memory must leave: beyond it, an allocation of the running service would fail."""

_LIMITS_FILE: Final = "/etc/security/limits.d/twostage-servo.conf"


@dataclass(frozen=True, slots=True)
class Grant:
    """One thing that was asked of the kernel.

    Attributes
    ----------
    name
        What it is about: ``scheduling``, ``cpus``, ``memory``, ``timer slack``, ``time slice`` or
        ``thread switching``.
    asked, granted
        What was asked for; what the kernel says that is now the case.
    warning
        Why the one is not the other; empty if it is.
    remedy
        What to do about it, to be pasted; empty without a warning.
    """

    name: str
    asked: str
    granted: str
    warning: str = ""
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class RealtimeReport:
    """What was asked of the kernel, and what it granted. What was not asked for is not in it."""

    grants: tuple[Grant, ...]

    @property
    def warnings(self) -> list[Grant]:
        """What was refused."""
        return [grant for grant in self.grants if grant.warning]

    def as_json(self) -> list[dict[str, Any]]:
        """Return the grants, ready for JSON."""
        return [asdict(grant) for grant in self.grants]


def apply(settings: RealtimeSettings, kernel: Kernel | None = None) -> RealtimeReport:
    """Apply the settings to the calling thread and its process; call it in the thread of the loop.

    Threads that exist already, such as the log's writer, keep their CPUs, and none inherits the priority.

    Parameters
    ----------
    settings
        The table ``[realtime]``.
    kernel
        The kernel; a test gives one that refuses.
    """
    kernel = kernel or Kernel()
    grants = [_timer_slack(kernel), _time_slice(kernel), _thread_switching(kernel)]
    if settings.cpus:
        grants.append(_cpus(settings.cpus, kernel))
    if settings.lock_memory:
        grants.append(_memory(kernel))
    if settings.priority:
        grants.append(_scheduling(settings.priority, kernel))
    return RealtimeReport(tuple(grants))


def priority_remedy(priority: int) -> str:
    """Return what lets a process have a SCHED_FIFO priority."""
    return (
        f"in the service's unit: LimitRTPRIO={priority} (or AmbientCapabilities=CAP_SYS_NICE); for a user who logs in: "
        f"the line '{user_name()} - rtprio {priority}' in {_LIMITS_FILE}, then log in again"
    )


def memory_remedy() -> str:
    """Return what lets a process lock its memory."""
    return (
        "in the service's unit: LimitMEMLOCK=infinity; for a user who logs in: the line "
        f"'{user_name()} - memlock unlimited' in {_LIMITS_FILE}, then log in again"
    )


def user_name() -> str:
    """Return the name of this process' user, its number where it has none."""
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return f"#{os.getuid()}"


def _try(call: Callable[[], None]) -> str:
    """Return why the kernel refused a call; empty if it did not."""
    try:
        call()
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _timer_slack(kernel: Kernel) -> Grant:
    refusal = _try(lambda: kernel.set_timer_slack(TIMER_SLACK_NS))
    try:
        granted = f"{kernel.timer_slack()} ns"
    except OSError:
        granted = "unknown"
    # Nobody asked for it by a setting, so a kernel that does not have it is no reason for a warning.
    return Grant("timer slack", f"{TIMER_SLACK_NS} ns", granted if not refusal else f"{granted} ({refusal})")


def _time_slice(kernel: Kernel) -> Grant:
    """Ask for a short time slice: measured beside four busy loops on two processors, see docs/real-time.md."""
    refusal = _try(lambda: kernel.set_time_slice(TIME_SLICE_NS))
    try:
        granted = kernel.time_slice()
    except OSError:
        granted = 0
    usual = "the usual one" + (f" ({refusal})" if refusal else "")
    # Nobody asked for it by a setting either: Linux has it from 6.12 on.
    return Grant("time slice", f"{TIME_SLICE_NS / 1e3:g} µs", f"{granted / 1e3:g} µs" if granted else usual)


def _thread_switching(kernel: Kernel) -> Grant:
    kernel.set_switch_interval(SWITCH_INTERVAL_S)
    asked, granted = (f"{1e6 * seconds:g} µs" for seconds in (SWITCH_INTERVAL_S, kernel.switch_interval()))
    return Grant("thread switching", asked, granted)


def _cpus(cpus: list[int], kernel: Kernel) -> Grant:
    asked = _listed(set(cpus))
    refusal = _try(lambda: kernel.set_cpus(set(cpus)))
    granted = kernel.cpus()
    if granted == set(cpus):
        return Grant("cpus", asked, asked)
    return Grant(
        "cpus",
        asked,
        _listed(granted),
        f"the service may run only on CPU {_listed(granted)}, not on {asked} as asked" + (refusal and f" ({refusal})"),
        "set realtime.cpus to CPUs that are online (/sys/devices/system/cpu/online) and that the service's cgroup "
        f"allows (in its unit: AllowedCPUs={asked})",
    )


def _memory(kernel: Kernel) -> Grant:
    needed = kernel.status_kib("VmSize") + MEMORY_TO_GROW_KIB
    limit = None if kernel.has_capability(CAP_IPC_LOCK) else kernel.limit(resource.RLIMIT_MEMLOCK)
    if limit is not None and limit < needed << 10:
        refusal = f"{limit >> 10} KiB may be locked, but {needed} KiB are needed, with room to grow"
    else:
        refusal = _try(kernel.lock_memory)
    if not refusal:
        _try(kernel.prefault)
    locked = kernel.status_kib("VmLck")
    granted = f"{locked} KiB locked"
    if locked and not refusal:
        return Grant("memory", "all of it locked", granted)
    return Grant(
        "memory",
        "all of it locked",
        granted,
        "the memory is not locked" + (refusal and f": {refusal}"),
        memory_remedy(),
    )


def _scheduling(priority: int, kernel: Kernel) -> Grant:
    asked = f"SCHED_FIFO {priority}"
    refusal = _try(lambda: kernel.set_fifo(priority))
    fifo, granted_priority = kernel.scheduling()
    granted = f"SCHED_FIFO {granted_priority}" if fifo else "time-sharing"
    if granted == asked:
        return Grant("scheduling", asked, granted)
    remedy = priority_remedy(priority)
    if kernel.has_capability(CAP_SYS_NICE):  # then it is not a privilege that is missing
        remedy = (
            "the process has CAP_SYS_NICE, so its cgroup has no real-time budget (CONFIG_RT_GROUP_SCHED); boot with "
            "rt_group_sched=0, or give the cgroup one in cpu.rt_runtime_us"
        )
    warning = f"the loop is not scheduled as {asked}" + (refusal and f": {refusal}")
    return Grant("scheduling", asked, granted, warning, remedy)


def _listed(cpus: set[int]) -> str:
    return ",".join(map(str, sorted(cpus)))
