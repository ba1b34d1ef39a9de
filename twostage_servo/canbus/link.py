"""One opened bus: a python-can interface that never waits, never keeps an old command and fails in one way only."""

import asyncio
import difflib
import errno
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import can
from pydantic import Field, field_validator, model_validator

from twostage_servo.canbus.frame import Identifier
from twostage_servo.canbus.socketcand import SocketcandBus
from twostage_servo.settings import Settings, quantity

_log = logging.getLogger(__name__)

_OWN_ARGUMENTS: Final = frozenset(
    {"interface", "channel", "bitrate", "can_filters", "ignore_config", "config_context", "receive_own_messages"}
)
_NO_BITRATE: Final = frozenset({"socketcan", "socketcand", "udp_multicast", "virtual"})
_ERROR_CLASSES: Final = frozenset({"socketcan", "socketcand"})
_FULL_ERRNOS: Final = frozenset({errno.ENOBUFS, errno.EAGAIN})
# What socketcan and virtual say when a queue is full; they give no error code with it.
_FULL_TEXTS: Final = frozenset({"Transmit buffer full", "Could not send message to one or more recipients"})
_BUS_OFF: Final = 0x40  # CAN_ERR_BUSOFF of linux/can/error.h
_NEXT_STEPS: Final = {
    "socketcan": "Look at the interface with 'ip -details link show {channel}'; set it up with "
    "'ip link set {channel} up type can bitrate ...'.",
    "socketcand": "Start what serves {channel} on {options[host]} port {options[port]}: "
    "`twostage-servo drive`, or socketcand.",
    "udp_multicast": "Check that the group is a multicast address and that a route leads to it ('ip route').",
}


class LinkError(Exception):
    """The bus could not be opened, or is gone. The text is for the operator, the cause is chained."""


class BusSettings(Settings):
    """The bus and how it is opened."""

    interface: str = Field(
        description="Interface of python-can: socketcan, socketcand, udp_multicast, virtual, pcan, ..."
    )
    channel: str | int = Field(description="Channel of the interface, such as can0")
    bitrate: int | None = quantity(
        None,
        unit="bit/s",
        description="Bit rate, for interfaces that set it; for socketcan 'ip link' does",
        gt=0,
        le=1_000_000,
    )
    options: dict[str, bool | int | float | str] = Field(
        default_factory=dict, description="Further arguments of the python-can interface, passed as they are"
    )
    max_frames_per_tick: int = quantity(
        256,
        unit="frames",
        description="Most frames read in one tick; a classic bus at 1 Mbit/s carries 212 in 10 ms",
        ge=1,
        le=10_000,
    )
    reopen_interval_ms: float = quantity(
        1000.0, unit="ms", description="Time between two attempts to open the bus", ge=10.0, le=60_000.0
    )

    @field_validator("interface")
    @classmethod
    def _is_known(cls, interface: str) -> str:
        if interface not in can.VALID_INTERFACES:
            near = difflib.get_close_matches(interface, can.VALID_INTERFACES, n=1)
            guess = f"did you mean {near[0]}? " if near else ""
            raise ValueError(
                f"python-can has no such interface; {guess}It knows: {', '.join(sorted(can.VALID_INTERFACES))}"
            )
        return interface

    @field_validator("options")
    @classmethod
    def _has_no_argument_of_ours(cls, options: dict[str, Any]) -> dict[str, Any]:
        if clash := sorted(_OWN_ARGUMENTS & options.keys()):
            raise ValueError(
                f"{', '.join(clash)} cannot be set here; interface, channel and bitrate have keys of their own"
            )
        return options

    @model_validator(mode="after")
    def _bitrate_has_an_effect(self) -> "BusSettings":
        if self.bitrate is not None and self.interface in _NO_BITRATE:
            raise ValueError(f"bitrate has no effect on interface {self.interface!r}; remove it")
        return self


@dataclass(slots=True)
class LinkCounters:
    """What went over a link since it was made, over all its openings.

    Attributes
    ----------
    received : int
        Frames with an accepted identifier.
    sent : int
        Frames handed over to the interface.
    rejected : int
        Received frames that could not be used; counted by whoever decodes them.
    dropped : int
        Frames not sent because the queue was full just then.
    errors : int
        Error frames: the controller reports trouble on the bus.
    overruns : int
        Drains that ended at their bound. One after another, they mean that frames pile up and are read late.
    """

    received: int = 0
    sent: int = 0
    rejected: int = 0
    dropped: int = 0
    errors: int = 0
    overruns: int = 0


class Link:
    """A bus that one party opens for itself.

    Not for concurrent calls; :meth:`open` may run in another thread while nothing else is called.

    Parameters
    ----------
    settings
        The bus.
    accepted
        Identifiers to receive. Frames with the same number of the other kind (11 or 29 bits) come through as well, so
        that they can be rejected and counted.

    Attributes
    ----------
    settings : BusSettings
        As given.
    counters : LinkCounters
        What went over the link.
    """

    def __init__(self, settings: BusSettings, accepted: Iterable[Identifier]) -> None:
        self.settings = settings
        self.counters = LinkCounters()
        self._accepted = frozenset(identifier.identifier for identifier in accepted)
        self._bus: can.BusABC | None = None

    @property
    def is_open(self) -> bool:
        """Whether the bus is open."""
        return self._bus is not None

    def open(self) -> None:
        """Open the bus. May block for a second or more; does nothing when it is open already.

        Raises
        ------
        LinkError
            When it cannot be opened.
        """
        if self._bus is not None:
            return
        settings = self.settings
        options: dict[str, Any] = dict(settings.options)
        if settings.bitrate is not None:
            options["bitrate"] = settings.bitrate
        if settings.interface == "udp_multicast":
            options.setdefault("hop_limit", 0)  # python-can's 1 would let the frames leave the host
        filters = [{"can_id": number, "can_mask": 0x1FFFFFFF} for number in sorted(self._accepted)]
        try:
            if settings.interface == "socketcand":
                bus: can.BusABC = SocketcandBus(str(settings.channel), can_filters=filters, **options)
            else:
                # Without ignore_config, a can.conf somewhere on the machine would add arguments.
                bus = can.Bus(
                    interface=settings.interface,
                    channel=settings.channel,
                    can_filters=filters,
                    ignore_config=True,
                    **options,
                )
            if type(bus)._apply_filters is can.BusABC._apply_filters:  # noqa: SLF001
                # Filters in software: recv(0) would return None for each foreign frame and look empty. drain() filters.
                bus.set_filters(None)
        except Exception as error:  # an interface may raise anything
            raise self._error("cannot be opened", error) from error
        self._bus = bus

    async def open_in_thread(self) -> None:
        """Open the bus without holding up the running loop; one that is cancelled waits until the attempt has ended.

        Otherwise the thread would open the bus after its user has closed it.

        Raises
        ------
        LinkError
            When it cannot be opened.
        """
        opening = asyncio.get_running_loop().run_in_executor(None, self.open)
        try:
            await asyncio.shield(opening)
        except asyncio.CancelledError:
            await asyncio.gather(opening, return_exceptions=True)
            raise

    def close(self) -> None:
        """Close the bus. Never raises, and does nothing when it is closed already."""
        bus, self._bus = self._bus, None
        if bus is not None:
            try:
                bus.shutdown()
            except Exception as error:  # noqa: BLE001 - an interface may raise anything; the bus is given up in any case
                _log.warning("%s did not close properly: %r", self._name, error)

    def drain(self) -> list[can.Message]:
        """Take the frames that have arrived, oldest first, without waiting.

        At most ``max_frames_per_tick`` frames are read, foreign ones included; the rest stays for the next call.

        Raises
        ------
        LinkError
            When the bus is not open, failed, or went bus-off.
        """
        bus = self._opened()
        messages = []
        counters = self.counters
        try:
            for _ in range(self.settings.max_frames_per_tick):
                message = bus.recv(0)
                if message is None:
                    break
                if message.is_error_frame:
                    counters.errors += 1
                    self._refuse_bus_off(message)
                elif message.arbitration_id in self._accepted:
                    messages.append(message)
            else:
                counters.overruns += 1
        except LinkError:
            raise
        except Exception as error:  # an interface may raise anything
            raise self._error("failed while receiving", error) from error
        counters.received += len(messages)
        return messages

    def send(self, identifier: Identifier, data: bytes) -> bool:
        """Hand a frame over, without waiting.

        Returns
        -------
        bool
            False when the queue was full just now: the frame is dropped and counted, not kept. Send a newer one in the
            next tick.

        Raises
        ------
        LinkError
            When the bus is not open, or failed.
        """
        bus = self._opened()
        try:
            message = can.Message(
                arbitration_id=identifier.identifier, is_extended_id=identifier.extended, data=data, check=True
            )
            # The default time-out, None, would wait for ever with some interfaces.
            bus.send(message, timeout=0)
        except Exception as error:  # an interface may raise anything
            if _is_full(error):
                self.counters.dropped += 1
                return False
            raise self._error("failed while sending", error) from error
        self.counters.sent += 1
        return True

    def _opened(self) -> can.BusABC:
        if self._bus is None:
            raise LinkError(f"{self._name} is not open. Open it first.")
        return self._bus

    def _refuse_bus_off(self, message: can.Message) -> None:
        if self.settings.interface in _ERROR_CLASSES and message.arbitration_id & _BUS_OFF:
            raise LinkError(
                f"{self._name} went bus-off: too many transmit errors. Check cable, termination and bit rate, "
                "then reset the axis."
            )

    @property
    def _name(self) -> str:
        return f"bus {self.settings.interface} {self.settings.channel}"

    def _error(self, what: str, error: Exception) -> LinkError:
        settings = self.settings
        options = {"host": "127.0.0.1", "port": 29536} | settings.options
        step = _NEXT_STEPS.get(settings.interface, "Check cable, driver, and the table [bus] of the configuration.")
        if isinstance(error, OSError) and error.errno == errno.EAFNOSUPPORT:
            step = "This machine's kernel has no CAN: load it with 'modprobe can' and 'modprobe can_raw'."
        text = step.format(channel=settings.channel, options=options)
        return LinkError(f"{self._name} {what}: {(str(error) or type(error).__name__).rstrip('.')}. {text}")


def _is_full(error: BaseException) -> bool:
    """Whether an interface says that a queue was full just now, as against that the bus is gone."""
    if isinstance(error, can.CanTimeoutError) or str(error) in _FULL_TEXTS:
        return True
    cause = error.__cause__
    code = getattr(error, "error_code", None) or (cause.errno if isinstance(cause, OSError) else None)
    return code in _FULL_ERRNOS
