"""The long-running verbs: `run`, the service, and `drive`, a simulated drive as a process of its own."""

import argparse
import contextlib
import signal
from typing import TYPE_CHECKING, Any

from twostage_servo.cli.configuration import add_options, configuration_problems, load_configuration
from twostage_servo.cli.output import CommandError, ExitCode, print_json

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from twostage_servo.config import Config, LoadedConfig
    from twostage_servo.service.loop import ServoService
    from twostage_servo.service.notify import Notifier
    from twostage_servo.ticks import Tick


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verbs."""
    run = verbs.add_parser(
        "run",
        help="run the service",
        description="Run the service until SIGTERM or Ctrl-C; a moving axis is then brought to rest and disabled.",
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


def _run(options: argparse.Namespace) -> ExitCode:
    import asyncio

    from twostage_servo.service.assembly import build_service
    from twostage_servo.service.log import open_log
    from twostage_servo.ticks import real_time_loop

    loaded = _load_for_processes(options)
    writer = open_log(loaded.config.service.log_level)
    try:
        with configuration_problems():
            service = build_service(loaded)
        with asyncio.Runner(loop_factory=real_time_loop) as runner:
            runner.run(_serve(service, loaded, options))
    finally:
        writer.close()
    if options.json:
        print_json(service.snapshot())
    return ExitCode.DONE


def _load_for_processes(options: argparse.Namespace) -> "LoadedConfig[Config]":
    loaded = load_configuration(options)
    if loaded.config.bus.interface == "virtual":
        message = (
            "the virtual bus exists inside one process only, so service and drive would never meet on it; `demo` uses "
            "it, and two_processes.toml has a bus between processes"
        )
        with configuration_problems():
            raise loaded.problem(("bus", "interface"), message)
    return loaded


async def _serve(service: "ServoService", loaded: "LoadedConfig[Config]", options: argparse.Namespace) -> None:
    import asyncio
    from pathlib import Path

    import structlog

    from twostage_servo.service.assembly import socket_path
    from twostage_servo.service.control_socket import ControlSocket
    from twostage_servo.service.notify import Notifier
    from twostage_servo.service.trip_files import TripFiles, default_folder

    path = socket_path(loaded.config)
    notifier, loop = Notifier(), asyncio.get_running_loop()
    service.reporter.trip_files = TripFiles(Path(loaded.config.service.trip_folder or default_folder()))
    service.desk.reload = lambda: _reload(service, loaded, options)
    control = ControlSocket(path, service.handle, service.desk.leave)
    try:
        await control.start()
    except OSError as error:
        raise CommandError(ExitCode.USAGE, "socket", f"the control socket cannot be made at {path}: {error}") from error
    service.publishers.append(lambda tick: control.publish(tick.index, service.snapshot))
    service.publishers.append(_feeder(service, notifier, loop))
    _on_signals(service.shut_down)
    notifier.ready()
    structlog.get_logger().info("listening", socket=str(path), config=loaded.source, axis=loaded.config.axis.name)
    try:
        await service.run()
    finally:
        notifier.stopping()
        await control.stop()
        notifier.close()


def _feeder(
    service: "ServoService", notifier: "Notifier", loop: "asyncio.AbstractEventLoop"
) -> "Callable[[Tick], None]":
    """Return the publisher that gives a sign of life for a tick; it has to be the last one."""

    def feed(tick: "Tick") -> None:
        if tick.index != service.failed_tick:
            notifier.tick_completed(loop.time())

    return feed


def _reload(service: "ServoService", running: "LoadedConfig[Config]", options: argparse.Namespace) -> None:
    """Read the configuration again; what is wrong with it is refused, and the service goes on as it was."""
    import structlog

    from twostage_servo.axis.messages import Refused
    from twostage_servo.config import ConfigError
    from twostage_servo.service.assembly import reload_axis

    try:
        fresh = load_configuration(options)
        reload_axis(service, running, fresh)
    except (CommandError, ConfigError) as error:
        raise Refused("config", str(error)) from error
    structlog.get_logger().info("configuration read again", config=fresh.source)


def _drive(options: argparse.Namespace) -> ExitCode:
    import asyncio

    from twostage_servo.service.assembly import compile_profile
    from twostage_servo.service.log import open_log
    from twostage_servo.ticks import real_time_loop

    loaded = _load_for_processes(options)
    writer = open_log(loaded.config.service.log_level)
    try:
        with configuration_problems():
            profile = compile_profile(loaded)
        with asyncio.Runner(loop_factory=real_time_loop) as runner:
            summary = runner.run(_simulate(loaded.config, profile))
    finally:
        writer.close()
    if options.json:
        print_json(summary)
    return ExitCode.DONE


async def _simulate(config: "Config", profile: Any) -> dict[str, Any]:
    import asyncio
    import dataclasses

    import structlog

    from twostage_servo.canbus.hub import Hub
    from twostage_servo.canbus.link import Link
    from twostage_servo.simulation.drive import SimulatedDrive
    from twostage_servo.simulation.node import DriveNode

    drive = SimulatedDrive(config.simulation, profile, asyncio.get_running_loop().time())
    node = DriveNode(drive, Link(config.bus, profile.drive_identifiers), config.simulation.cycle_ms / 1e3)
    async with contextlib.AsyncExitStack() as stack:
        if config.bus.interface == "socketcand" and config.simulation.hub:
            options = config.bus.options
            hub = Hub(str(options.get("host", "127.0.0.1")), int(options.get("port", 29536)))
            try:
                await hub.start()
            except (OSError, ValueError) as error:
                raise CommandError(ExitCode.USAGE, "hub", f"the loopback bus cannot be served: {error}") from error
            stack.push_async_callback(hub.stop)
            structlog.get_logger().info("serving the loopback bus", host=hub.host, port=hub.port)
        _on_signals(node.stop)
        await node.run()
    return {"position": drive.position, "velocity": drive.velocity, "counters": dataclasses.asdict(drive.counters)}


def _on_signals(stop: "Callable[[], None]") -> None:
    import asyncio

    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop)
