"""Puts a service together from a loaded configuration; what does not fit is an error with file, line and key."""

from collections.abc import Callable
from pathlib import Path

import can

from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import AxisDesign, DesignError, design_axis
from twostage_servo.canbus.link import BusSettings, Link
from twostage_servo.canbus.profile import DriveProfile, ProtocolError
from twostage_servo.config import Config, LoadedConfig
from twostage_servo.service.address import own_socket
from twostage_servo.service.loop import ServoService

_ECHOING = frozenset({"udp_multicast"})
"""Interfaces of python-can on which a sender hears its own frames, whatever it asks for."""


def design(loaded: LoadedConfig[Config]) -> AxisDesign:
    """Design the axis' law and observer.

    Raises
    ------
    ConfigError
        If no law can be designed from the settings.
    """
    config = loaded.config
    try:
        return design_axis(config.axis, config.service.tick_ms / 1e3)
    except DesignError as error:
        raise loaded.problem(error.key, str(error)) from error


def compile_profile(loaded: LoadedConfig[Config]) -> DriveProfile:
    """Compile the drive's frames from its DBC.

    Raises
    ------
    ConfigError
        If the DBC does not hold what the configuration names, or the command signal cannot carry the effort limit.
    """
    config = loaded.config
    try:
        profile = DriveProfile.compile(config.protocol, loaded.folder, config.axis.unit)
    except ProtocolError as error:
        raise loaded.problem(error.key, str(error)) from error
    _check_effort(loaded, profile)
    return profile


def _check_effort(loaded: LoadedConfig[Config], profile: DriveProfile) -> None:
    config = loaded.config
    if profile.effort_unit not in {"", "1", config.axis.effort_unit}:
        raise loaded.problem(
            ("axis", "effort_unit"),
            f"the drive's command signal is in {profile.effort_unit!r}; set axis.effort_unit to that, and give plant "
            "and limits in it",
        )
    if config.axis.limits.effort > profile.effort_limit:
        raise loaded.problem(
            ("axis", "limits", "effort"),
            f"the drive's command signal carries at most {profile.effort_limit:g} {config.axis.effort_unit}; lower the "
            "limit or use a DBC with a wider signal",
        )


def build_axis(loaded: LoadedConfig[Config], profile: DriveProfile) -> Axis:
    """Return the axis that a configuration describes, disarmed.

    Raises
    ------
    ConfigError
        If no law can be designed from the settings.
    """
    _check_encoder(loaded, profile)
    return Axis(
        design(loaded),
        profile.counter_modulus,
        profile.position_period,
        profile.position_quantum,
        heartbeat=profile.heartbeat_id is not None,
    )


def _check_encoder(loaded: LoadedConfig[Config], profile: DriveProfile) -> None:
    limits, unit = loaded.config.axis.limits, loaded.config.axis.unit
    travel = limits.position_maximum - limits.position_minimum + 2.0 * limits.position_overrun
    half = 0.5 * profile.position_period
    gone = 1e-3 * limits.overspeed * limits.stale_feedback_ms
    if 0.0 < half <= min(travel, gone):
        raise loaded.problem(
            ("axis", "limits", "stale_feedback_ms"),
            f"in {limits.stale_feedback_ms:g} ms without feedback the axis can go {gone:g} {unit} (limits.overspeed), "
            f"which is not less than half of the {profile.position_period:g} {unit} after which its encoder comes "
            f"round to the same count: allow less than {1e3 * half / limits.overspeed:.4g} ms",
        )


def build_service(
    loaded: LoadedConfig[Config],
    bus: BusSettings | None = None,
    opener: Callable[[], can.BusABC] | None = None,
) -> ServoService:
    """Return the service that a configuration describes, its bus not yet open.

    Parameters
    ----------
    loaded
        The configuration.
    bus
        A bus to use in place of the configured one.
    opener
        What makes the bus, in place of python-can: a simulated one.

    Raises
    ------
    ConfigError
        If the parts do not fit together.
    """
    profile = compile_profile(loaded)
    axis = build_axis(loaded, profile)
    bus = bus or loaded.config.bus
    heard = list(profile.controller_identifiers)
    if bus.interface not in _ECHOING:
        heard.append(profile.command_id)  # which only somebody else can have sent
    dated = loaded.config.protocol.feedback.sampling == "cyclic"
    return ServoService(loaded.config.service, axis, profile, Link(bus, heard, opener), dated=dated)


def reload_axis(service: ServoService, running: LoadedConfig[Config], fresh: LoadedConfig[Config]) -> None:
    """Give a service whose axis is disarmed the axis of a configuration that was read again.

    Raises
    ------
    ConfigError
        If the parts do not fit together, or a table has changed that only a restart can follow.
    """
    for table in ("service", "bus", "protocol"):
        if getattr(fresh.config, table) != getattr(running.config, table):
            raise fresh.problem((table,), f"[{table}] has changed: only a restart of the service can follow that")
    if fresh.config.axis.unit != running.config.axis.unit:  # the frames were compiled for it
        raise fresh.problem(("axis", "unit"), "the unit has changed: only a restart of the service can follow that")
    _check_effort(fresh, service.profile)
    axis = build_axis(fresh, service.profile)
    axis.take_over(service.axis)
    service.axis = axis


def socket_path(config: Config) -> Path:
    """Return the path of the control socket."""
    return Path(config.service.socket) if config.service.socket else own_socket()
