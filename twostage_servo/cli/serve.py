"""The long-running verbs: `run`, the service, and `drive`, a simulated drive as a process of its own."""

import argparse
import contextlib
from typing import TYPE_CHECKING, Any

from twostage_servo.cli.configuration import add_options, configuration_problems, load_machine
from twostage_servo.cli.extras import require
from twostage_servo.cli.output import CommandError, ExitCode, print_json
from twostage_servo.config.files import find_configuration

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Iterator

    from twostage_servo.config.loader import Config
    from twostage_servo.config.machine import Machine
    from twostage_servo.drives.drive import DriveSide
    from twostage_servo.service.ending_signals import EndingSignals
    from twostage_servo.service.notify import Notifier
    from twostage_servo.service.servo_service import ServoService
    from twostage_servo.timing.ticks import Tick


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verbs."""
    run = verbs.add_parser(
        "run",
        help="run the service",
        description="Run the service until SIGTERM or Ctrl-C; a moving axis is then brought to rest and disabled. So "
        "it is on any other signal that can be caught, with 128 and its number as the exit code.",
    )
    add_options(run, required=True)
    run.set_defaults(run=_run)
    drive = verbs.add_parser(
        "drive",
        help="run a simulated drive",
        description="Run a simulated drive on the configured bus until SIGTERM or Ctrl-C.",
    )
    add_options(drive, required=True)
    drive.set_defaults(run=_drive)


def _run(options: argparse.Namespace) -> int:
    from twostage_servo.service.ending_signals import EndingSignals

    with EndingSignals() as signals:
        code = _run_service(options, signals)
        # A signal that is a failure says so; else it is told what became of the drives.
        return signals.exit_code or code


def _run_service(options: argparse.Namespace, signals: "EndingSignals") -> ExitCode:
    import asyncio

    from twostage_servo.app.assembly import build_service
    from twostage_servo.app.punctual import punctual
    from twostage_servo.service.log import open_log
    from twostage_servo.timing.ticks import real_time_loop

    machine = _load_for_processes(options)
    with _threads():
        writer = open_log(machine.service.log_level)
    try:
        with configuration_problems():
            service = build_service(machine)
        with asyncio.Runner(loop_factory=real_time_loop) as runner, punctual(service, machine.realtime):
            runner.run(_serve(service, machine, options, signals))
    finally:
        writer.close()
    if options.json:
        print_json(service.snapshot())
    return ExitCode.FAILED if service.not_disabled else ExitCode.DONE


def _load_for_processes(options: argparse.Namespace) -> "Machine":
    machine = load_machine(options)
    for loaded in machine.axes:
        if loaded.config.bus.interface == "udp_multicast":
            require("multicast", 'a bus with interface = "udp_multicast"')
        if loaded.config.bus.interface == "virtual":
            message = (
                "the virtual bus exists inside one process only, so service and drive would never meet on it; `demo` "
                "uses it, and two_processes.toml has a bus between processes"
            )
            with configuration_problems():
                raise loaded.problem(("bus", "interface"), message)
    return machine


async def _serve(
    service: "ServoService", machine: "Machine", options: argparse.Namespace, signals: "EndingSignals"
) -> None:
    import asyncio
    from pathlib import Path

    import structlog

    from twostage_servo.app.assembly import socket_path
    from twostage_servo.app.reloading import Reloading
    from twostage_servo.service.control_socket import ControlSocket
    from twostage_servo.service.notify import Notifier
    from twostage_servo.service.request_age import time_asleep_s
    from twostage_servo.service.status_line import StatusLine
    from twostage_servo.telemetry.trip_files import TripFiles, default_folder

    path = socket_path(machine.service)
    notifier, loop = Notifier(), asyncio.get_running_loop()
    signals.call(service.shut_down, loop)
    trip_files = TripFiles(Path(machine.service.trip_folder or default_folder()))
    with _threads():
        trip_files.start()
    for axis_loop in service.axis_loops:
        axis_loop.event_log.trip_files = trip_files
    overrides = tuple(options.overrides)
    service.desk.prepare = Reloading(service, machine, find_configuration(options.config), overrides).prepare
    control = ControlSocket(path, service, time_asleep_s)
    try:
        await control.start()
    except OSError as error:
        raise CommandError(ExitCode.USAGE, "socket", f"the control socket cannot be made at {path}: {error}") from error
    service.publishers.append(lambda tick: control.publish(tick.index))
    service.publishers.append(StatusLine(service, notifier.status).publish)
    service.publishers.append(_feeder(service, notifier, loop))
    notifier.ready()
    names = [axis_loop.name for axis_loop in service.axis_loops]
    structlog.get_logger().info("listening", socket=str(path), config=machine.source, axes=names)
    try:
        await service.run()
    finally:
        notifier.stopping(_longest_end_s(service))
        await control.stop()
        trip_files.close()
        notifier.close()


@contextlib.contextmanager
def _threads() -> "Iterator[None]":
    """Let the verb end with what to do where the system has no thread left for the service."""
    try:
        yield
    except RuntimeError as error:
        text = f"the service cannot start: {error}. Look who has all threads and memory (`ulimit -u`, TasksMax=)"
        raise CommandError(ExitCode.FAILED, "no_thread", text) from error


def _feeder(
    service: "ServoService", notifier: "Notifier", loop: "asyncio.AbstractEventLoop"
) -> "Callable[[Tick], None]":
    """Return the publisher that gives a sign of life for a tick, and tells of the end; it has to be the last one."""

    def feed(tick: "Tick") -> None:
        if service.is_ending:
            notifier.stopping(_longest_end_s(service))
        if tick.index != service.failed_tick:
            notifier.tick_completed(loop.time())

    return feed


def _longest_end_s(service: "ServoService") -> float:
    from twostage_servo.service.settings import longest_end_s

    return longest_end_s(service.settings, (one.axis.settings.arming_timeout_ms for one in service.axis_loops))


def _drive(options: argparse.Namespace) -> int:
    from twostage_servo.service.ending_signals import EndingSignals

    with EndingSignals() as signals:
        _run_drives(options, signals)
        return signals.exit_code


def _run_drives(options: argparse.Namespace, signals: "EndingSignals") -> None:
    import asyncio

    from twostage_servo.app.assembly import build_drive, drive_side
    from twostage_servo.service.log import open_log
    from twostage_servo.timing.ticks import real_time_loop

    machine = _load_for_processes(options)
    writer = open_log(machine.service.log_level)
    try:
        with configuration_problems():
            sides = [drive_side(loaded, build_drive(loaded)) for loaded in machine.axes]
        with asyncio.Runner(loop_factory=real_time_loop) as runner:
            summaries = runner.run(_simulate([loaded.config for loaded in machine.axes], sides, signals))
    finally:
        writer.close()
    if options.json:
        print_json(summaries[0] if len(summaries) == 1 else {"drives": summaries})


async def _simulate(
    configs: "list[Config]", sides: "list[DriveSide]", signals: "EndingSignals"
) -> list[dict[str, Any]]:
    import asyncio
    import dataclasses

    from twostage_servo.canbus.link import Link
    from twostage_servo.simulation.drive import SimulatedDrive, boots_by_the_clock
    from twostage_servo.simulation.node import DriveNode

    now_s, boot_counter = asyncio.get_running_loop().time(), boots_by_the_clock()
    drives = [
        SimulatedDrive(config.simulation, side, now_s, boot_counter)
        for config, side in zip(configs, sides, strict=True)
    ]
    nodes = [
        DriveNode(drive, Link(config.bus, side.identifiers), config.simulation.cycle_ms / 1e3)
        for drive, config, side in zip(drives, configs, sides, strict=True)
    ]

    def stop() -> None:
        for node in nodes:
            node.stop()

    signals.call(stop, asyncio.get_running_loop())
    async with contextlib.AsyncExitStack() as stack:
        for config in {(config.bus.interface, config.bus.channel): config for config in configs}.values():
            await _serve_bus(config, stack)
        await asyncio.gather(*(node.run() for node in nodes))
    return [
        {
            "axis": config.axis.name,
            "position": drive.position,
            "velocity": drive.velocity,
            "counters": dataclasses.asdict(drive.counters),
        }
        for drive, config in zip(drives, configs, strict=True)
    ]


async def _serve_bus(config: "Config", stack: contextlib.AsyncExitStack) -> None:
    """Serve the loopback bus between processes, if the configuration says so."""
    import structlog

    from twostage_servo.canbus.hub import Hub

    if config.bus.interface != "socketcand" or not config.simulation.hub:
        return
    options = config.bus.options
    hub = Hub(str(options.get("host", "127.0.0.1")), int(options.get("port", 29536)))
    try:
        await hub.start()
    except (OSError, ValueError) as error:
        raise CommandError(ExitCode.USAGE, "hub", f"the loopback bus cannot be served: {error}") from error
    stack.push_async_callback(hub.stop)
    structlog.get_logger().info("serving the loopback bus", host=hub.host, port=hub.port)
