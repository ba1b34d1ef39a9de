"""How a bus is opened and shut down, here or in a thread of its own: an interface of python-can may block in both."""

import asyncio
import logging
import threading
import traceback
from collections.abc import Callable
from typing import NamedTuple

import can
from can.interfaces.socketcan import SocketcanBus

from twostage_servo.canbus.bus_settings import BusSettings
from twostage_servo.canbus.link_error import link_error
from twostage_servo.canbus.network_interface import NetworkInterface
from twostage_servo.canbus.socketcand import SocketcandBus
from twostage_servo.worker_thread import WorkerThread

_log = logging.getLogger(__name__)


class OpenedBus(NamedTuple):
    """A bus that has been opened, and its network interface where it is one of SocketCAN."""

    bus: can.BusABC
    interface: NetworkInterface | None


class BusOpening:
    """Opens and shuts down the buses of one link, one after the other. It does not keep them.

    Parameters
    ----------
    settings
        The bus.
    opener
        Makes the bus.

    Attributes
    ----------
    name : str
        What texts call the bus.
    """

    def __init__(self, settings: BusSettings, opener: Callable[[], can.BusABC]) -> None:
        self.name = f"bus {settings.interface} {settings.channel}"
        self._settings = settings
        self._opener = opener
        self._thread = WorkerThread("open_bus")

    def open(self) -> OpenedBus:
        """Open a bus. May block for a second or more.

        Raises
        ------
        LinkError
            When it cannot be opened.
        """
        bus = interface = None
        try:
            bus = self._opener()
            if isinstance(bus, SocketcanBus):
                interface = NetworkInterface(bus.socket, str(self._settings.channel), fd=self._settings.fd)
                interface.check()
            if type(bus)._apply_filters is can.BusABC._apply_filters:  # noqa: SLF001
                # Filters in software: recv(0) would return None for each foreign frame and look empty. drain() filters.
                bus.set_filters(None)
        except Exception as error:  # an interface may raise anything
            if bus is not None:
                self.shut_down(bus)
            # A half-made bus of python-can hangs on the frames of its error, and its socket would stay open until the
            # next collection of garbage, attempt after attempt.
            traceback.clear_frames(error.__traceback__)
            raise link_error(self.name, self._settings, "cannot be opened", error) from error
        return OpenedBus(bus, interface)

    async def open_in_thread(self, attempt: "OpeningAttempt") -> None:
        """Run an attempt without holding up the running loop; it is abandoned at once when this is cancelled.

        Raises
        ------
        LinkError
            When the bus cannot be opened.
        """
        # A thread of its own, from the first opening on: a bus that is lost later on has to be opened again on a host
        # that has no thread left, and neither another bus nor a disk that hangs may stand in the way.
        try:
            opening = asyncio.get_running_loop().run_in_executor(self._thread, attempt.run)
        except (RuntimeError, MemoryError) as error:
            raise link_error(self.name, self._settings, "cannot be opened", error) from error
        try:
            await opening
        except asyncio.CancelledError:
            attempt.abandon()
            raise
        finally:
            del opening  # it holds the error, whose traceback holds this frame

    def shut_down(self, bus: can.BusABC) -> None:
        """Shut a bus down. Never raises."""
        try:
            bus.shutdown()
        except Exception as error:  # noqa: BLE001 - an interface may raise anything; the bus is given up in any case
            _log.warning("%s did not close properly: %r", self.name, error)

    def shut_down_in_thread(self, bus: can.BusABC) -> "asyncio.Future[None] | None":
        """Shut a bus down in the thread, where that may block, or if need be here.

        Returns
        -------
        asyncio.Future or None
            Done when the thread has shut the bus down; None when that is done already. An opening comes after it.
        """
        if not isinstance(bus, SocketcanBus | SocketcandBus):  # which close a socket, and never wait
            try:
                return asyncio.get_running_loop().run_in_executor(self._thread, self.shut_down, bus)
            except (RuntimeError, MemoryError) as error:
                _log.warning("%s is closed without a thread: %r", self.name, error)
        self.shut_down(bus)
        return None


class OpeningAttempt:
    """An opening in another thread, which whoever waits for it may give up.

    Parameters
    ----------
    open_bus
        Opens the bus.
    close_bus
        Closes it again.
    """

    def __init__(self, open_bus: Callable[[], None], close_bus: Callable[[], None]) -> None:
        self._open_bus = open_bus
        self._close_bus = close_bus
        self._lock = threading.Lock()
        self._is_done = False
        self._is_abandoned = False

    def run(self) -> None:
        """Open the bus, in the thread; close it again if nobody waits for it any more."""
        self._open_bus()
        with self._lock:
            self._is_done = True
            if self._is_abandoned:
                self._close_bus()

    def abandon(self) -> None:
        """Let the thread close what comes of it; what has come already is closed here."""
        with self._lock:
            self._is_abandoned = True
            if self._is_done:
                self._close_bus()
