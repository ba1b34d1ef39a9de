"""The service as a process of its own: on its host, in real time, until a signal ends it."""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import structlog

from twostage_servo.api.fields import JsonObject
from twostage_servo.app.assembly import socket_path
from twostage_servo.app.build import Parts, build_parts, build_requests, build_service
from twostage_servo.app.punctual import punctual
from twostage_servo.app.reloading import Reloading
from twostage_servo.app.start_error import StartError, threads
from twostage_servo.config.machine import Machine
from twostage_servo.service.control_socket import ControlSocket
from twostage_servo.service.ending_signals import EndingSignals
from twostage_servo.service.law_memory import LawMemory
from twostage_servo.service.log import open_log
from twostage_servo.service.notify import Notifier
from twostage_servo.service.request_age import time_asleep_s
from twostage_servo.service.runtime import Runtime
from twostage_servo.service.settings import longest_end_s
from twostage_servo.service.status_line import StatusLine
from twostage_servo.telemetry.learned_files import LearnedFiles
from twostage_servo.telemetry.trip_files import TripFiles, default_folder
from twostage_servo.timing.ticks import real_time_loop

if TYPE_CHECKING:
    from twostage_servo.service.request_handler import RequestHandler
    from twostage_servo.timing.ticks import Tick


@dataclass(frozen=True, slots=True)
class Served:
    """What became of a service.

    Attributes
    ----------
    snapshot
        Its last state, ready for JSON.
    not_disabled
        Names of the axes whose drives may be enabled still: see `AxisLoop.report_if_not_disabled`.
    """

    snapshot: JsonObject
    not_disabled: list[str]


def check_between_processes(machine: Machine) -> None:
    """Tell whether a service and its drives can meet as processes of their own.

    Raises
    ------
    ConfigError
        If a bus exists inside one process only.
    """
    for loaded in machine.axes:
        if loaded.config.bus.interface == "virtual":
            raise loaded.problem(
                ("bus", "interface"),
                "the virtual bus exists inside one process only, so service and drive would never meet on it; `demo` "
                "uses it, and two_processes.toml has a bus between processes",
            )


def serve(machine: Machine, signals: EndingSignals, path: Path | None, overrides: Sequence[str]) -> Served:
    """Run the service of a configuration until a signal ends it.

    Parameters
    ----------
    machine
        The configuration.
    signals
        Catch what ends the process.
    path, overrides
        Where the configuration is read again.

    Raises
    ------
    ConfigError
        If the parts do not fit together.
    StartError
        If something else keeps the service from starting.
    """
    with threads():
        writer = open_log(machine.service.log_level)
    try:
        check_between_processes(machine)
        parts, notifier = build_parts(machine), Notifier()
        with (
            asyncio.Runner(loop_factory=real_time_loop) as runner,
            punctual(machine.realtime, parts.axis_loops, parts.period_s, notifier.tick_completed) as runtime,
        ):
            reloading = Reloading(parts, path, overrides)
            learned_files = LearnedFiles(_folder(parts))
            memory = LawMemory(parts.axis_loops, learned_files)
            requests = build_requests(parts, runtime, reloading.prepare, time_asleep_s, memory.erase)
            runner.run(_serve(parts, runtime, requests, notifier, signals, memory, learned_files))
    finally:
        writer.close()
    return Served(requests.status.report.snapshot(), parts.shutdown.not_disabled)


async def _serve(
    parts: Parts,
    runtime: Runtime,
    requests: "RequestHandler",
    notifier: Notifier,
    signals: EndingSignals,
    memory: LawMemory,
    learned_files: LearnedFiles,
) -> None:
    settings, shutdown = parts.machine.service, parts.shutdown
    signals.call(shutdown.begin, asyncio.get_running_loop())
    trip_files = TripFiles(_folder(parts))
    with threads():
        trip_files.start()
        if memory.is_used:
            learned_files.start()
    path = socket_path(settings)
    control = ControlSocket(path, requests, parts.background, parts.names, shutdown.fail)
    status_line = StatusLine(parts.axis_loops, parts.statistics, shutdown, parts.period_s, notifier.status)
    publishers = (control.publish, status_line.publish, memory.publish, announces_end(parts, notifier))
    service = build_service(parts, runtime, requests.status.report.snapshot_of, trip_files, publishers)
    try:
        await control.start()
    except OSError as error:
        raise StartError("socket", f"the control socket cannot be created at {path}: {error}", is_usage=True) from error
    memory.restore()
    notifier.ready()
    structlog.get_logger().info("listening", socket=str(path), config=parts.machine.source, axes=parts.names)
    try:
        await service.run()
    finally:
        notifier.stopping(_longest_end_s(parts))
        await control.stop()
        memory.finish()
        await learned_files.close()
        trip_files.close()
        notifier.close()


def announces_end(parts: Parts, notifier: Notifier) -> "Callable[[Tick], None]":
    """Return the publisher that tells the service manager of the end, and how long that may take."""

    def announce(_: "Tick") -> None:
        if parts.shutdown.is_ending:
            notifier.stopping(_longest_end_s(parts))

    return announce


def _folder(parts: Parts) -> Path:
    return Path(parts.machine.service.trip_folder or default_folder())


def _longest_end_s(parts: Parts) -> float:
    arming_timeouts_ms = (one.axis.settings.arming_timeout_ms for one in parts.axis_loops)
    return longest_end_s(parts.shutdown.settings, arming_timeouts_ms)
