"""Checks of the machine: what of kernel, processors, limits and memory stands in the way of punctual ticks."""

import platform
import resource
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from twostage_servo.host.findings import Finding, Host, Status
from twostage_servo.host.kernel import CAP_IPC_LOCK, CAP_SYS_NICE, Kernel
from twostage_servo.host.realtime import MEMORY_TO_GROW_KIB, TIMER_SLACK_NS, memory_remedy, priority_remedy
from twostage_servo.host.settings import RealtimeSettings

_SLOW_CLOCKS: Final = frozenset({"hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit"})
"""Clock sources that are read over a bus, which takes a microsecond or more, or that move on with the timer only."""

ADVISED_PRIORITY: Final = 40
"""Above everything ordinary, below the interrupt threads (50) of which one brings the frames of the bus."""

TESTED_PYTHONS: Final = ((3, 11), (3, 13))
"""First and last version that this program is tested with."""


def check_machine(host: Host, settings: RealtimeSettings, kernel: Kernel) -> list[Finding]:
    """Check the machine for what the real-time settings ask of it."""
    return [
        kernel_finding(host),
        clock_finding(host),
        governor_finding(host),
        cpus_finding(host, settings.cpus),
        priority_finding(kernel, settings.priority),
        throttling_finding(host, settings.priority),
        memory_finding(kernel, asked=settings.lock_memory),
        swap_finding(host, locked=settings.lock_memory),
        timer_slack_finding(host),
        virtualisation_finding(host),
        python_finding(sys.version_info[:2], free_threaded=not getattr(sys, "_is_gil_enabled", lambda: True)()),
    ]


def kernel_finding(host: Host) -> Finding:
    """Whether the kernel is one with PREEMPT_RT; ``/sys/kernel/realtime`` is there only if it is."""
    version = host.read(host.proc / "version")
    if version is None:
        return Finding("kernel", Status.SKIP, f"{host.proc / 'version'} cannot be read")
    release = " ".join(version.split()[:3])
    if host.read(host.sys / "kernel" / "realtime") == "1" or "PREEMPT_RT" in version:
        return Finding("kernel", Status.OK, f"{release}, PREEMPT_RT")
    kind = next((word for word in ("PREEMPT_DYNAMIC", "PREEMPT") if word in version.split()), "no preemption")
    return Finding(
        "kernel",
        Status.WARN,
        f"{release}, {kind}: drivers and interrupts may delay a tick without limit",
        "install a kernel with PREEMPT_RT and boot it; on Debian: sudo apt install linux-image-rt-$(dpkg "
        "--print-architecture)",
    )


def clock_finding(host: Host) -> Finding:
    """Whether the monotonic clock is quick to read."""
    folder = host.sys / "devices" / "system" / "clocksource" / "clocksource0"
    clock = host.read(folder / "current_clocksource")
    if clock is None:
        return Finding("clock source", Status.SKIP, f"{folder / 'current_clocksource'} cannot be read")
    if clock not in _SLOW_CLOCKS:
        return Finding("clock source", Status.OK, clock)
    return Finding(
        "clock source",
        Status.WARN,
        f"{clock}, which is slow to read or coarse",
        "find out why the kernel rejected a better one (sudo dmesg | grep -i clocksource); if the processor's counter "
        f"is reliable, boot with tsc=reliable. Available: {host.read(folder / 'available_clocksource') or 'unknown'}",
    )


def governor_finding(host: Host) -> Finding:
    """Whether the processors keep their frequency."""
    folders = sorted((host.sys / "devices" / "system" / "cpu").glob("cpu[0-9]*"))
    governors = {text for folder in folders if (text := host.read(folder / "cpufreq" / "scaling_governor"))}
    if not governors:
        return Finding("CPU governor", Status.SKIP, "this kernel does not scale the frequency (a virtual machine?)")
    found = ", ".join(sorted(governors))
    if governors == {"performance"}:
        return Finding("CPU governor", Status.OK, found)
    return Finding(
        "CPU governor",
        Status.WARN,
        f"{found}: a processor at a lower frequency wakes up and computes more slowly",
        "sudo cpupower frequency-set --governor performance (package linux-cpupower), at each boot",
    )


def cpus_finding(host: Host, asked: list[int]) -> Finding:
    """Whether the CPUs asked for are there, and kept free of others."""
    folder = host.sys / "devices" / "system" / "cpu"
    online, isolated = _cpus(host, folder / "online"), _cpus(host, folder / "isolated") or set()
    quiet = _cpus(host, folder / "nohz_full") or set()
    if online is None:
        return Finding("CPUs", Status.SKIP, f"{folder / 'online'} cannot be read")
    numbers = ",".join(map(str, asked))
    if absent := set(asked) - online:
        found = f"realtime.cpus names {_listed(absent)}; online: {_listed(online)}"
        return Finding("CPUs", Status.FAIL, found, "name only CPUs that are online in realtime.cpus")
    if not asked and isolated:
        return Finding(
            "CPUs",
            Status.WARN,
            f"{_listed(isolated)} isolated, but not used",
            f"realtime.cpus = [{min(isolated)}]",
        )
    if not asked:
        return Finding("CPUs", Status.OK, f"{_listed(online)} online, none isolated, none requested")
    if not set(asked) <= isolated:
        return Finding(
            "CPUs",
            Status.WARN,
            f"CPU {numbers} requested, but other processes run there too",
            f"add to the kernel command line: isolcpus={numbers} nohz_full={numbers} (GRUB_CMDLINE_LINUX in "
            "/etc/default/grub, then sudo update-grub), and reboot",
        )
    tickless = "without" if set(asked) <= quiet else "but with"
    return Finding("CPUs", Status.OK, f"CPU {numbers} isolated, {tickless} the timer interrupt of a busy CPU")


def priority_finding(kernel: Kernel, priority: int) -> Finding:
    """Whether the process may have the priority asked for."""
    if not priority:
        return Finding("priority", Status.SKIP, "realtime.priority is 0: not requested")
    limit = kernel.limit(resource.RLIMIT_RTPRIO)
    if kernel.has_capability(CAP_SYS_NICE):
        return Finding("priority", Status.OK, f"{priority} requested; CAP_SYS_NICE allows any")
    if limit is None or limit >= priority:
        return Finding("priority", Status.OK, f"{priority} requested; up to {'99' if limit is None else limit} allowed")
    found = f"{priority} requested; up to {limit} allowed (RLIMIT_RTPRIO)"
    return Finding("priority", Status.FAIL, found, priority_remedy(priority))


def scheduling_advice(kernel: Kernel, priority: int) -> Finding:
    """Whether the loop has to wait for other processes."""
    if priority:
        return Finding("scheduling", Status.OK, f"realtime.priority is {priority}")
    allowed = kernel.has_capability(CAP_SYS_NICE) or kernel.limit(resource.RLIMIT_RTPRIO) != 0
    remedy = f"realtime.priority = {ADVISED_PRIORITY}" + ("" if allowed else f"; {priority_remedy(ADVISED_PRIORITY)}")
    return Finding("scheduling", Status.WARN, "the loop shares the processor with all other processes", remedy)


def throttling_finding(host: Host, priority: int) -> Finding:
    """Whether the kernel keeps a share of the time for other threads than real-time ones."""
    path = host.proc / "sys" / "kernel" / "sched_rt_runtime_us"
    text = host.read(path)
    if not priority:
        return Finding("real-time throttling", Status.SKIP, "realtime.priority is 0: not requested")
    if text is None:
        return Finding("real-time throttling", Status.SKIP, f"{path} cannot be read")
    if text == "0":
        remedy = "sudo sysctl kernel.sched_rt_runtime_us=950000"
        return Finding("real-time throttling", Status.FAIL, "real-time threads get no time at all", remedy)
    if text == "-1":
        return Finding(
            "real-time throttling",
            Status.WARN,
            "off: a real-time thread in an endless loop keeps its CPU from everything else",
            "sudo sysctl kernel.sched_rt_runtime_us=950000; the service needs only a few per cent",
        )
    period = host.read(path.with_name("sched_rt_period_us")) or "1000000"
    return Finding("real-time throttling", Status.OK, f"{text} of {period} µs for real-time threads")


def memory_finding(kernel: Kernel, *, asked: bool) -> Finding:
    """Whether the process may lock its memory."""
    if not asked:
        return Finding("locked memory", Status.SKIP, "realtime.lock_memory is false: not requested")
    if kernel.has_capability(CAP_IPC_LOCK):
        return Finding("locked memory", Status.OK, "CAP_IPC_LOCK allows all of it")
    limit = kernel.limit(resource.RLIMIT_MEMLOCK)
    needed = kernel.status_kib("VmSize") + MEMORY_TO_GROW_KIB
    if limit is None or limit >= needed << 10:
        return Finding("locked memory", Status.OK, "unlimited" if limit is None else f"{limit >> 10} KiB allowed")
    found = f"{limit >> 10} KiB allowed (RLIMIT_MEMLOCK), about {needed} KiB needed"
    return Finding("locked memory", Status.FAIL, found, memory_remedy())


def swap_finding(host: Host, *, locked: bool) -> Finding:
    """Whether memory of the service can be swapped out."""
    text = host.read(host.proc / "swaps")
    if text is None:
        return Finding("swap", Status.SKIP, f"{host.proc / 'swaps'} cannot be read")
    spaces = [line.split()[0] for line in text.splitlines()[1:] if line.split()]
    if not spaces:
        return Finding("swap", Status.OK, "none")
    if locked:
        return Finding("swap", Status.OK, f"{', '.join(spaces)}; the service's memory is locked")
    return Finding(
        "swap",
        Status.WARN,
        f"{', '.join(spaces)}: a tick may have to wait for a page from the disk",
        "realtime.lock_memory = true, or sudo swapoff --all",
    )


def timer_slack_finding(host: Host) -> Finding:
    """By how much the kernel may put wake-ups off; the service changes it for itself."""
    text = host.read(host.proc / "self" / "timerslack_ns")
    if text is None:
        return Finding("timer slack", Status.SKIP, f"{host.proc / 'self' / 'timerslack_ns'} cannot be read")
    return Finding("timer slack", Status.OK, f"{text} ns; the service sets {TIMER_SLACK_NS} ns for itself")


def virtualisation_finding(host: Host) -> Finding:
    """Whether this is a virtual machine, whose processors are themselves scheduled."""
    information = host.read(host.proc / "cpuinfo")
    if information is None:
        return Finding("virtualisation", Status.SKIP, f"{host.proc / 'cpuinfo'} cannot be read")
    flags = {
        flag
        for line in information.splitlines()
        if line.partition(":")[0].strip() in {"flags", "Features"}
        for flag in line.partition(":")[2].split()
    }
    by_firmware = (host.proc / "device-tree" / "hypervisor").exists() or (host.sys / "hypervisor" / "type").exists()
    if "hypervisor" not in flags and not by_firmware:
        return Finding("virtualisation", Status.OK, "no sign of a hypervisor")
    product = host.read(host.sys / "class" / "dmi" / "id" / "sys_vendor")
    return Finding(
        "virtualisation",
        Status.WARN,
        f"a virtual machine{f' ({product})' if product else ''}: its host decides when its processors run",
        "control a machine from real hardware; if it must be a virtual machine, give it pinned processors of its own",
    )


def python_finding(version: tuple[int, int], *, free_threaded: bool) -> Finding:
    """Whether this Python is one that the program is tested with."""
    found = f"{platform.python_implementation()} {version[0]}.{version[1]}" + (
        ", free-threaded" if free_threaded else ""
    )
    first, last = TESTED_PYTHONS
    if free_threaded or not first <= version <= last:
        tested = f"{first[0]}.{first[1]} to {last[0]}.{last[1]}"
        return Finding("Python", Status.WARN, found, f"use the default build of CPython {tested}, which is tested")
    return Finding("Python", Status.OK, found)


def _cpus(host: Host, path: Path) -> set[int] | None:
    """Read a list of CPUs as sysfs writes it, such as ``0-2,5``; None where there is none, empty for ``(null)``."""
    text = host.read(path)
    return None if text is None else set(_numbers(text))


def _numbers(text: str) -> Iterator[int]:
    for part in text.split(","):
        first, _, last = part.partition("-")
        if first.strip().isdecimal():
            yield from range(int(first), int(last or first) + 1)


def _listed(cpus: set[int]) -> str:
    return f"CPU {','.join(map(str, sorted(cpus)))}"
