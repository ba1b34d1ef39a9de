"""Simulated drives as a process of their own, on the configured bus, until a signal ends them."""

import asyncio
import contextlib
import dataclasses
from collections.abc import Sequence

import structlog

from twostage_servo.api.fields import JsonObject
from twostage_servo.app.assembly import build_drive, drive_side
from twostage_servo.app.serve import check_between_processes
from twostage_servo.app.start_error import StartError
from twostage_servo.canbus.hub import Hub
from twostage_servo.canbus.link import Link
from twostage_servo.config.loader import Config
from twostage_servo.config.machine import Machine
from twostage_servo.drives.drive import DriveSide
from twostage_servo.service.ending_signals import EndingSignals
from twostage_servo.service.log import open_log
from twostage_servo.simulation.drive import SimulatedDrive, boots_by_the_clock
from twostage_servo.simulation.node import DriveNode
from twostage_servo.timing.ticks import real_time_loop


def simulate(machine: Machine, signals: EndingSignals) -> list[JsonObject]:
    """Run the drives of a configuration until a signal ends them; return what each has come to, ready for JSON.

    Raises
    ------
    ConfigError
        If the frames of a drive do not fit its DBC.
    StartError
        If the loopback bus cannot be served.
    """
    writer = open_log(machine.service.log_level)
    try:
        check_between_processes(machine)
        sides = [drive_side(loaded, build_drive(loaded)) for loaded in machine.axes]
        with asyncio.Runner(loop_factory=real_time_loop) as runner:
            return runner.run(_simulate([loaded.config for loaded in machine.axes], sides, signals))
    finally:
        writer.close()


async def _simulate(configs: Sequence[Config], sides: Sequence[DriveSide], signals: EndingSignals) -> list[JsonObject]:
    now_s, boot_counter = asyncio.get_running_loop().time(), boots_by_the_clock()
    drives = [
        SimulatedDrive(config.simulation, side, now_s, boot_counter)
        for config, side in zip(configs, sides, strict=True)
    ]
    nodes = [
        DriveNode(drive, Link(config.bus, side.identifiers), config.simulation.cycle_ms / 1e3, axis=config.axis.name)
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


async def _serve_bus(config: Config, stack: contextlib.AsyncExitStack) -> None:
    """Serve the loopback bus between processes, if the configuration says so."""
    if config.bus.interface != "socketcand" or not config.simulation.hub:
        return
    options = config.bus.options
    hub = Hub(str(options.get("host", "127.0.0.1")), int(options.get("port", 29536)))
    try:
        await hub.start()
    except (OSError, ValueError) as error:
        raise StartError("hub", f"the loopback bus cannot be served: {error}", is_usage=True) from error
    stack.push_async_callback(hub.stop)
    structlog.get_logger().info("serving the loopback bus", host=hub.host, port=hub.port)
