"""Makes the axes that a configuration describes; what does not fit is an error with file, line and key."""

import functools
from collections.abc import Sequence
from pathlib import Path

from twostage_servo.api.address import own_socket
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import AxisDesign, DesignError, design_axis
from twostage_servo.axis.detection import check_detection
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.canbus.bus_load import CyclicFrame
from twostage_servo.config.loader import Config, LoadedConfig
from twostage_servo.config.machine import Machine
from twostage_servo.drives.drive import Drive, DriveSide
from twostage_servo.drives.protocol_error import ProtocolError
from twostage_servo.drives.registry import DRIVES
from twostage_servo.service.settings import ServiceSettings

_RESTART = "has changed: restart the service to apply that"

_designed = functools.lru_cache(maxsize=8)(design_axis)
"""The same settings give the same design, which nothing changes: a campaign builds hundreds of services from them."""


def design(loaded: LoadedConfig[Config], tick_s: float | None = None, traits: DriveTraits | None = None) -> AxisDesign:
    """Design the axis' law and observer.

    Parameters
    ----------
    loaded
        The configuration.
    tick_s
        The tick in s; None for the configuration's own.
    traits
        What is known of the drive; None to ask the drive that the configuration names.

    Raises
    ------
    ConfigError
        If no law can be designed from the settings, or there is no such drive.
    """
    config = loaded.config
    make = _designed if _is_hashable(config.axis) else design_axis
    tick_s = config.service.tick_ms / 1e3 if tick_s is None else tick_s
    traits = build_drive(loaded).traits if traits is None else traits
    try:
        return make(config.axis, tick_s, traits.position_quantum)
    except DesignError as error:
        raise loaded.problem(error.key, str(error)) from error


def _is_hashable(settings: AxisSettings) -> bool:
    """Whether settings can be kept to be found again: those of another package's law may have a list."""
    try:
        hash(settings)
    except TypeError:
        return False
    return True


def build_drive(loaded: LoadedConfig[Config]) -> Drive:
    """Make the drive that a configuration names, from the controller's end.

    Raises
    ------
    ConfigError
        If the drive does not fit its settings, or its command cannot carry the effort limit.
    """
    config = loaded.config
    make = DRIVES.get(config.protocol.type).build
    try:
        drive: Drive = make(config.protocol, loaded.folder, config.axis.unit, config.bus.fd)
    except ProtocolError as error:
        raise loaded.problem(error.key, str(error)) from error
    _check_effort(loaded, drive.traits)
    return drive


def drive_side(loaded: LoadedConfig[Config], drive: Drive) -> DriveSide:
    """Return the drive's own end of a drive of this configuration, for a simulated one."""
    side: DriveSide = DRIVES.get(loaded.config.protocol.type).side(drive)
    return side


def _check_effort(loaded: LoadedConfig[Config], traits: DriveTraits) -> None:
    config = loaded.config
    if traits.effort_unit not in {"", "1", config.axis.effort_unit}:
        raise loaded.problem(
            ("axis", "effort_unit"),
            f"the drive's command signal is in {traits.effort_unit!r}; set axis.effort_unit to that, and give plant "
            "and limits in that unit",
        )
    if config.axis.limits.effort > traits.effort_limit:
        raise loaded.problem(
            ("axis", "limits", "effort"),
            f"the drive's command signal carries at most {traits.effort_limit:g} {config.axis.effort_unit}; lower the "
            "limit or use a DBC with a wider signal",
        )


def build_axis(loaded: LoadedConfig[Config], traits: DriveTraits, tick_s: float) -> Axis:
    """Return the axis that a configuration describes, disarmed, on a tick of so many seconds.

    Raises
    ------
    ConfigError
        If no law can be designed from the settings.
    """
    _check_encoder(loaded, traits, tick_s)
    designed = design(loaded, tick_s, traits)
    try:
        check_detection(designed)
        return Axis(designed, traits)
    except DesignError as error:
        raise loaded.problem(error.key, str(error)) from error


def _check_encoder(loaded: LoadedConfig[Config], traits: DriveTraits, tick_s: float) -> None:
    limits, unit = loaded.config.axis.limits, loaded.config.axis.unit
    travel = limits.position_maximum - limits.position_minimum + 2.0 * limits.position_overrun
    half = 0.5 * traits.position_period
    # Ticks may be missed while a frame is due, and neither limit is reached.
    missed_ms = 1e3 * tick_s * limits.missed_ticks
    gone = 1e-3 * limits.overspeed * (limits.stale_feedback_ms + missed_ms)
    if 0.0 < half <= min(travel, gone):
        raise loaded.problem(
            ("axis", "limits", "stale_feedback_ms"),
            f"in {limits.stale_feedback_ms:g} ms without feedback plus {missed_ms:g} ms of limits.missed_ticks the "
            f"axis can move {gone:g} {unit} (limits.overspeed), which is not less than half of the "
            f"{traits.position_period:g} {unit} after which its encoder wraps: allow less "
            f"than {1e3 * half / limits.overspeed:.4g} ms for both together",
        )


def cyclic_frames(loaded: LoadedConfig[Config], drive: Drive, tick_s: float) -> Sequence[CyclicFrame]:
    """Return the frames that service and drive exchange for ever, on a tick of so many seconds.

    A drive answers each command, or sends at a rhythm of its own that is taken for the tick's. Its heartbeat is taken
    to come three times in its time-out. The index message is left out: it comes in homing alone.
    """
    return drive.cyclic_frames(tick_s, loaded.config.axis.limits.heartbeat_ms / 3e3)


def prepare_axes(traits: dict[str, DriveTraits], running: Machine, fresh: Machine, tick_s: float) -> list[Axis]:
    """Design the axes of a configuration that was read again, in the order of the service's.

    Parameters
    ----------
    traits
        What they have to know of their drives, by their names and in the order of the service's axes.
    running, fresh
        The configuration that the service runs on, and the other one.
    tick_s
        Length of a tick in s.

    Raises
    ------
    ConfigError
        If the parts do not fit together, or something has changed that only a restart can follow.
    """
    before, now = ([loaded.config.axis.name for loaded in machine.axes] for machine in (running, fresh))
    for table in ("service", "realtime"):
        if getattr(fresh, table) != getattr(running, table):
            raise fresh.problem((table,), f"[{table}] {_RESTART}")
    if (fresh.fault_reaction, now) != (running.fault_reaction, before):
        raise fresh.problem(("machine",), f"[machine], or the name of an axis, {_RESTART}")
    axes = {
        name: _reread_axis(traits[name], old, new, tick_s)
        for name, old, new in zip(now, running.axes, fresh.axes, strict=True)
    }
    return [axes[name] for name in traits]


def _reread_axis(
    traits: DriveTraits, running: LoadedConfig[Config], fresh: LoadedConfig[Config], tick_s: float
) -> Axis:
    for table in ("bus", "protocol"):
        if getattr(fresh.config, table) != getattr(running.config, table):
            raise fresh.problem((table,), f"[{table}] {_RESTART}")
    if fresh.config.axis.unit != running.config.axis.unit:  # the frames were compiled for it
        raise fresh.problem(("axis", "unit"), f"the unit {_RESTART}")
    try:
        DRIVES.get(fresh.config.protocol.type).check_unchanged(fresh.config.protocol, fresh.folder, traits)
    except ProtocolError as error:
        raise fresh.problem(error.key, str(error)) from error
    _check_effort(fresh, traits)
    return build_axis(fresh, traits, tick_s)


def socket_path(settings: ServiceSettings) -> Path:
    """Return the path of the control socket."""
    return Path(settings.socket) if settings.socket else own_socket()
