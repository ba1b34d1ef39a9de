"""What the error frames of SocketCAN say; their layout is that of linux/can/error.h."""

from typing import Final, Literal, NamedTuple

import can

INTERFACES: Final = frozenset({"socketcan", "socketcand"})
"""Interfaces of python-can whose error frames are those of SocketCAN."""

# Classes, which are bits of the identifier, and bits of byte 1 in the class of the controller.
_CONTROLLER: Final = 0x04  # CAN_ERR_CRTL
_BUS_OFF: Final = 0x40  # CAN_ERR_BUSOFF
_RESTARTED: Final = 0x100  # CAN_ERR_RESTARTED
_COUNTERS: Final = 0x200  # CAN_ERR_CNT: bytes 6 and 7 are the controller's error counters
_PASSIVE: Final = 0x30  # CAN_ERR_CRTL_RX_PASSIVE, CAN_ERR_CRTL_TX_PASSIVE
_WARNING: Final = 0x0C  # CAN_ERR_CRTL_RX_WARNING, CAN_ERR_CRTL_TX_WARNING
_ACTIVE: Final = 0x40  # CAN_ERR_CRTL_ACTIVE

ControllerState = Literal["active", "warning", "passive"]
"""Fault confinement state of the CAN controller, ISO 11898-1; ``"warning"`` is an active one near its limit."""


class ErrorFrame(NamedTuple):
    """What an error frame says.

    Attributes
    ----------
    kind
        By which it is counted.
    is_bus_off
        Whether the controller has left the bus.
    state
        State of the controller from now on; None if the frame does not tell.
    counters
        The controller's error counters, of transmitting and receiving; None if the frame does not tell.
    """

    kind: str
    is_bus_off: bool = False
    state: ControllerState | None = None
    counters: tuple[int, int] | None = None


def read_error_frame(message: can.Message) -> ErrorFrame:
    """Return what an error frame of SocketCAN says."""
    classes, data = message.arbitration_id, message.data
    counters = (data[6], data[7]) if classes & _COUNTERS and len(data) > 7 else None
    if classes & _BUS_OFF:
        return ErrorFrame("bus_off", is_bus_off=True, counters=counters)
    state: ControllerState | None = "active" if classes & _RESTARTED else None
    if classes & _CONTROLLER and len(data) > 1:
        status = data[1]
        if status & _PASSIVE:
            state = "passive"
        elif status & _WARNING:
            state = "warning"
        elif status & _ACTIVE:
            state = "active"
    return ErrorFrame("restarted" if classes & _RESTARTED else state or "other", state=state, counters=counters)
