"""What went wrong with a bus, in words for the operator."""

import errno
from typing import Final

import can

from twostage_servo.canbus.bus_settings import BusSettings

_FULL_ERRNOS: Final = frozenset({errno.ENOBUFS, errno.EAGAIN})
# What socketcan and virtual say when a queue is full; they give no error code with it.
_FULL_TEXTS: Final = frozenset({"Transmit buffer full", "Could not send message to one or more recipients"})
_NEXT_STEPS: Final = {
    "socketcan": "Look at the interface with 'ip -details link show {channel}'; set it up with "
    "'ip link set {channel} up type can bitrate ...'.",
    "socketcand": "Start what serves {channel} on {options[host]} port {options[port]}: "
    "`twostage-servo drive`, or socketcand.",
    "udp_multicast": "Check that the group is a multicast address and that a route leads to it ('ip route').",
}
_NEXT_STEPS_BY_ERRNO: Final = {
    errno.EAFNOSUPPORT: "This machine's kernel has no CAN: load it with 'modprobe can' and 'modprobe can_raw'.",
    errno.ENODEV: "Plug the adapter in; 'ip -brief link' shows the interfaces that are there. Once {channel} is there "
    "and up ('ip link set {channel} up type can bitrate ...'), the bus opens by itself.",
    errno.ENETDOWN: "Bring it up with 'ip link set {channel} up type can bitrate ...'; the bus then opens by itself.",
    errno.ENOLINK: "Check cable, termination and bit rate, then 'ip link set {channel} type can restart'.",
    errno.EPROTONOSUPPORT: "Set it up for CAN FD: 'ip link set {channel} down', then 'ip link set {channel} up type "
    "can bitrate ... dbitrate ... fd on'; of a vcan interface, 'ip link set {channel} mtu 72'.",
}


class LinkError(Exception):
    """The bus could not be opened, or is gone. The text is for the operator, the cause is chained."""


def link_error(name: str, settings: BusSettings, what: str, error: Exception) -> LinkError:
    """Return the error that says what happened to a bus, and what to do next.

    Parameters
    ----------
    name, settings
        The bus.
    what
        What could not be done, or when it failed.
    error
        What the interface has raised.
    """
    options = {"host": "127.0.0.1", "port": 29536} | settings.options
    step = _NEXT_STEPS.get(settings.interface, "Check cable, driver, and the table [bus] of the configuration.")
    if settings.interface == "socketcan":
        step = _NEXT_STEPS_BY_ERRNO.get(_errno(error) or 0, step)
    text = step.format(channel=settings.channel, options=options)
    return LinkError(f"{name} {what}: {(str(error) or type(error).__name__).rstrip('.')}. {text}")


def is_full(error: BaseException) -> bool:
    """Whether an interface says that a queue was full just now, as against that the bus is gone."""
    if isinstance(error, can.CanTimeoutError) or str(error) in _FULL_TEXTS:
        return True
    return _errno(error) in _FULL_ERRNOS


def _errno(error: BaseException) -> int | None:
    """Return the system's error number that an interface's error carries, or None."""
    if isinstance(error, OSError):
        return error.errno
    code = getattr(error, "error_code", None)
    if isinstance(code, int):
        return code
    return error.__cause__.errno if isinstance(error.__cause__, OSError) else None
