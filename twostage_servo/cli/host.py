"""The verbs about the host: `latency` measures how punctual it is, `doctor` looks for what stands in the way."""

import argparse
import contextlib
import math
from typing import TYPE_CHECKING, Any

from twostage_servo.cli.configuration import add_options, configuration_problems, load_machine
from twostage_servo.cli.output import CommandError, ExitCode, Progress, bar, note, print_json, print_line
from twostage_servo.cli.typed_numbers import decimal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from twostage_servo.axis.design import AxisDesign
    from twostage_servo.config.loader import Config, LoadedConfig
    from twostage_servo.config.machine import Machine
    from twostage_servo.host.findings import Finding, Host
    from twostage_servo.host.latency import Measurement, Verdict
    from twostage_servo.host.realtime import Grant, RealtimeReport
    from twostage_servo.timing.ticks import Tick

_LONGEST_S = 86_400.0
_NEARLY_FULL = 0.7
"""Share of the bus' time from which a frame of low priority may have to wait for several others."""


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verbs."""
    latency = verbs.add_parser(
        "latency",
        help="measure how late ticks are on this host",
        description="Run the service's ticks with the configured tick and [realtime] settings, without motion and "
        "without touching the bus, and judge their lateness. Exit code 3 if the verdict is poor.",
    )
    add_options(latency, required=False)
    latency.add_argument(
        "--seconds",
        type=decimal,
        default=10.0,
        help=f"how long (default 10, at most {_LONGEST_S:g}); a longer run finds rarer delays",
    )
    latency.add_argument("--load", action="store_true", help="keep every processor busy during the measurement")
    latency.set_defaults(run=_latency)
    doctor = verbs.add_parser(
        "doctor",
        help="check this host, its bus and its folders",
        description="Check whether kernel, processors, limits, memory, folders and bus provide what the configuration "
        "needs, and print what to do. Nothing is changed, and the bus is not touched. Exit code 3 if a check fails.",
    )
    add_options(doctor, required=False)
    doctor.set_defaults(run=_doctor)


# latency -------------------------------------------------------------------------------------------------------------


def _latency(options: argparse.Namespace) -> ExitCode:
    import contextlib

    from twostage_servo.host.findings import Host, Status
    from twostage_servo.host.kernel import Kernel
    from twostage_servo.host.latency import judge
    from twostage_servo.host.load import processor_load
    from twostage_servo.host.machine_checks import check_machine, scheduling_advice

    if not (math.isfinite(options.seconds) and 0.0 < options.seconds <= _LONGEST_S):
        text = f"--seconds {options.seconds:g}: it must be greater than 0 and at most {_LONGEST_S:g}"
        raise CommandError(ExitCode.USAGE, "seconds", text)
    machine = load_machine(options)
    with processor_load() if options.load else contextlib.nullcontext(0) as hogs:
        measurement, report = _measure(machine, options.seconds, quiet=options.json)
    verdict = judge(measurement, min(loaded.config.axis.limits.missed_ticks for loaded in machine.axes))
    kernel = Kernel()
    obstacles = [
        finding
        for finding in (
            scheduling_advice(kernel, machine.realtime.priority),
            *check_machine(Host(), machine.realtime, kernel),
        )
        if verdict.level != "good" and finding.status in {Status.WARN, Status.FAIL}
    ]
    if options.json:
        print_json(
            {
                "verdict": verdict.level,
                "reason": verdict.reason,
                "busy_processes": hogs,
                "busy_wait": machine.realtime.busy_wait,
                **measurement.as_json(),
                "realtime": report.as_json(),
                "obstacles": [finding.as_json() for finding in obstacles],
            }
        )
    else:
        print_line(_latency_text(machine, measurement, verdict, hogs))
        if remedies := _remedies_text(report.warnings, obstacles):
            print_line(remedies)
    return ExitCode.FAILED if verdict.level == "poor" else ExitCode.DONE


def _measure(machine: "Machine", seconds: float, *, quiet: bool) -> "tuple[Measurement, RealtimeReport]":
    import asyncio

    from twostage_servo.host import realtime
    from twostage_servo.host.garbage import GarbageCollection
    from twostage_servo.host.latency import MeasuredMargin, measure
    from twostage_servo.timing.ticks import Ticks, real_time_loop
    from twostage_servo.timing.wake_margin import wake_margin

    period_s = machine.service.tick_ms / 1e3
    ticks = Ticks(period_s, margin=MeasuredMargin(wake_margin(machine.realtime.busy_wait, period_s)))
    report = realtime.apply(machine.realtime)
    for grant in report.warnings:
        note(f"{grant.name}: {grant.warning}")
    garbage = GarbageCollection() if machine.realtime.collect_garbage == "between_ticks" else None
    progress = Progress(quiet=quiet)
    try:
        with asyncio.Runner(loop_factory=real_time_loop) as runner:
            loop = runner.get_loop()
            after_tick = _after_tick(seconds, period_s, progress, garbage, loop.time)
            if garbage is not None:
                garbage.begin()
            return runner.run(measure(ticks, seconds, after_tick)), report
    finally:
        if garbage is not None:
            garbage.end()
        progress.end()


def _after_tick(
    seconds: float, period_s: float, progress: Progress, garbage: Any, now: "Callable[[], float]"
) -> "Callable[[Tick], None]":
    """Return what the measurement does in each tick beside measuring: what the service does there as well."""
    each = max(1, round(1.0 / period_s))
    worst_s = missed = 0.0

    def after_tick(tick: "Tick") -> None:
        nonlocal worst_s, missed
        worst_s, missed = max(worst_s, tick.lateness_s), missed + tick.missed
        if garbage is not None:
            garbage.after_tick(tick.deadline_s + period_s - now(), driven=True)
        if tick.index % each == 0:
            progress.show(
                f"{tick.index * period_s:.0f} of {seconds:g} s, worst {1e6 * worst_s:.0f} µs late, {missed:.0f} missed"
            )

    return after_tick


def _latency_text(machine: "Machine", measurement: "Measurement", verdict: "Verdict", hogs: int) -> str:
    from twostage_servo.host.latency import histogram_us, summary_us

    count, elapsed_s = len(measurement.lateness_s), measurement.elapsed_s
    load = f"{hogs} busy processes" if hogs else "no added load"
    lines = [
        f"{verdict.level}: {verdict.reason}",
        "",
        f"{count} ticks of {machine.service.tick_ms:g} ms in {elapsed_s:.4g} s, {load}",
        f"busy-wait       {machine.realtime.busy_wait}, margin {1e6 * measurement.margin_s:.0f} µs at the end",
        f"CPU             {100 * measurement.cpu_share:.2f} % of a core",
        f"lateness        {_summary_text(summary_us(measurement.lateness_s))}",
        f"wake-up latency {_summary_text(summary_us(measurement.wake_latency_s))}",
        "",
        "lateness, up to",
    ]
    bins = histogram_us(measurement.lateness_s)
    largest = max((count for _, count in bins), default=1)
    lines += [f"{edge_us:>10g} µs {bar(count / largest)} {count}" for edge_us, count in bins]
    return "\n".join(lines)


def _summary_text(summary: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in summary.items()) + " µs"


def _remedies_text(warnings: "Sequence[Grant]", obstacles: "Sequence[Finding]") -> str:
    # A refusal and the check that foresaw it have the same remedy: told once, in the words of the refusal.
    by_remedy = {one.remedy: one.found for one in obstacles} | {one.remedy: one.warning for one in warnings}
    if not by_remedy:
        return ""
    return "\npossible improvements\n" + "\n".join(f"  {found}\n    {remedy}" for remedy, found in by_remedy.items())


# doctor --------------------------------------------------------------------------------------------------------------


def _doctor(options: argparse.Namespace) -> ExitCode:
    from twostage_servo.host.findings import Host, Status

    machine = load_machine(options)
    findings = examine(machine, Host())
    failed = any(finding.status is Status.FAIL for finding in findings)
    if options.json:
        counts = {status: sum(finding.status is status for finding in findings) for status in Status}
        print_json(
            {
                "config": machine.source,
                "passed": not failed,
                "counts": counts,
                "checks": [one.as_json() for one in findings],
            }
        )
    else:
        for finding in findings:
            print_line(f"{finding.status:4}  {finding.name}: {finding.found}")
            if finding.remedy:
                print_line(f"      → {finding.remedy}")
    return ExitCode.FAILED if failed else ExitCode.DONE


def _designs(machine: "Machine") -> "Iterator[AxisDesign]":
    """Yield the design of each axis that can be designed; what is wrong with another is for `check` to say."""
    from twostage_servo.app.assembly import design
    from twostage_servo.config.errors import ConfigError

    for loaded in machine.axes:
        with contextlib.suppress(ConfigError):
            yield design(loaded, machine.service.tick_ms / 1e3)


def examine(machine: "Machine", host: "Host") -> "list[Finding]":
    """Carry out every check for a configuration.

    Parameters
    ----------
    machine
        The configuration.
    host
        Where to look.
    """
    from pathlib import Path

    from twostage_servo.app.assembly import socket_path
    from twostage_servo.host.can_interface import check_can_interface
    from twostage_servo.host.findings import Finding, Status
    from twostage_servo.host.folder_checks import folder_finding
    from twostage_servo.host.kernel import Kernel
    from twostage_servo.host.machine_checks import check_machine
    from twostage_servo.host.service_manager import service_manager_finding
    from twostage_servo.service.settings import longest_end_s, with_time_to_stop
    from twostage_servo.telemetry.trip_files import default_folder

    trips = Path(machine.service.trip_folder or default_folder()).absolute()
    service = with_time_to_stop(machine.service, _designs(machine))
    arming_times = (loaded.config.axis.arming_timeout_ms for loaded in machine.axes)
    findings = [
        *check_machine(host, machine.realtime, Kernel(host.proc)),
        _socket_finding(socket_path(machine.service)),
        folder_finding("trip files", trips, "service.trip_folder"),
        service_manager_finding(host, longest_end_s(service, arming_times)),
    ]
    buses: dict[tuple[str, str | int], list[LoadedConfig[Config]]] = {}
    for loaded in machine.axes:
        buses.setdefault((loaded.config.bus.interface, loaded.config.bus.channel), []).append(loaded)
    for axes in buses.values():
        bus = axes[0].config.bus
        bit_rate = bus.bitrate
        if bus.interface == "socketcan":
            interface = check_can_interface(host, str(bus.channel), fd=bus.fd)
            findings += interface.findings
            bit_rate = interface.bit_rate or bit_rate
        else:
            found = f"bus.interface is {bus.interface}: no network interface of this host to check"
            findings.append(Finding("bus interface", Status.SKIP, found))
        findings.append(_load_finding(axes, machine.service.tick_ms / 1e3, bit_rate))
    return findings


def _socket_finding(path: "Path") -> "Finding":
    from twostage_servo.api.socket_trust import find_distrust
    from twostage_servo.host.findings import Finding, Status
    from twostage_servo.host.folder_checks import folder_finding

    if distrust := find_distrust(path):
        return Finding("control socket", Status.FAIL, str(distrust), "set service.socket to another path")
    return folder_finding("control socket", path.parent, "service.socket")


def _load_finding(axes: "list[LoadedConfig[Config]]", tick_s: float, bit_rate: int | None) -> "Finding":
    from twostage_servo.app.assembly import build_drive, cyclic_frames
    from twostage_servo.canbus.bus_load import bus_load
    from twostage_servo.host.findings import Finding, Status

    name = "bus load"
    if axes[0].config.bus.fd:
        return Finding(name, Status.SKIP, "not computed for CAN FD frames")
    if bit_rate is None:
        return Finding(name, Status.SKIP, "the bit rate is unknown")
    with configuration_problems():
        frames = [frame for loaded in axes for frame in cyclic_frames(loaded, build_drive(loaded), tick_s)]
    load = bus_load(frames, bit_rate)
    each = ", ".join(f"{one.name} each {1e3 * one.period_s:g} ms" for one in frames[:3])
    found = f"at most {100 * load:.3g} % of {bit_rate / 1e3:g} kbit/s, from {len(axes)} axes alone ({each})"
    if len(axes) == 1:
        found = found.replace("1 axes", "this axis")
    remedy = "raise the bit rate or service.tick_ms, or move other nodes to another bus"
    if load > 1.0:
        return Finding(name, Status.FAIL, found, remedy)
    return Finding(name, Status.WARN, found, remedy) if load > _NEARLY_FULL else Finding(name, Status.OK, found)
