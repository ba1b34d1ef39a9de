"""Opens the interface of python-can that the settings of a bus name."""

from collections.abc import Iterable
from typing import Any

import can

from twostage_servo.canbus.bus_settings import BusSettings
from twostage_servo.canbus.socketcand import SocketcandBus


def open_interface(settings: BusSettings, accepted: Iterable[int]) -> can.BusABC:
    """Open the interface, which receives frames of the accepted identifiers alone, of 11 as well as of 29 bits.

    Raises
    ------
    Exception
        Whatever the interface raises.
    """
    options: dict[str, Any] = dict(settings.options)
    if settings.bitrate is not None and settings.interface != "socketcan":  # which takes it from 'ip link'
        options["bitrate"] = settings.bitrate
    if settings.fd and settings.interface == "socketcan":
        options["fd"] = True
    if settings.interface == "udp_multicast":
        options.setdefault("hop_limit", 0)  # python-can's 1 would let the frames leave the host
    filters = [{"can_id": number, "can_mask": 0x1FFFFFFF} for number in sorted(accepted)]
    if settings.interface == "socketcand":
        return SocketcandBus(str(settings.channel), can_filters=filters, **options)
    # Without ignore_config, a can.conf somewhere on the machine would add arguments.
    return can.Bus(
        interface=settings.interface, channel=settings.channel, can_filters=filters, ignore_config=True, **options
    )
