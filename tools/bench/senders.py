"""Other ways to send a frame every 10 ms, one a process: ``python -m tools.bench.senders NAME --port N --seconds S``.

All of them join the bus with python-can's own socketcand interface and with TCP_NODELAY, and send a frame that is ready
made: the service reads feedback, estimates and controls before each of its frames, so they have the easier task.
"""

import argparse
import asyncio
import contextlib
import importlib
import socket
import time
from collections.abc import Callable
from typing import Any, Final, TypeVar

import can

from tools.bench.bus_side import CHANNEL
from tools.bench.plan import HOST, PERIOD_S

FLOOR: Final = "floor"
_Joined = TypeVar("_Joined")
_ATTEMPTS: Final = 20

COMMAND: Final = 0x201
SYNC: Final = 0x80
"""COB-ID of the SYNC object, CiA 301."""


def asyncio_sleep(port: int, seconds: float) -> None:
    """Send, then sleep for a period."""

    async def main() -> None:
        with _bus(port) as bus:
            frame, end_s = _frame(), time.monotonic() + seconds
            while time.monotonic() < end_s:
                bus.send(frame)
                await asyncio.sleep(PERIOD_S)

    asyncio.run(main())


def soft_realtime_loop(port: int, seconds: float) -> None:
    """Send at the beginning of each pass of NeuroLocoMiddleware's SoftRealtimeLoop."""
    loop_type: Any = importlib.import_module("NeuroLocoMiddleware.SoftRealtimeLoop").SoftRealtimeLoop
    with _bus(port) as bus:
        frame, end_s = _frame(), time.monotonic() + seconds
        loop = loop_type(dt=PERIOD_S, report=False, fade=0.0)
        for _ in loop:
            bus.send(frame)
            if time.monotonic() >= end_s:
                loop.stop()


def python_can_periodic(port: int, seconds: float) -> None:
    """Let python-can's thread send."""
    with _bus(port) as bus:
        task = bus.send_periodic(_frame(), PERIOD_S)
        time.sleep(seconds)
        task.stop()


def canopen_sync(port: int, seconds: float) -> None:
    """Let canopen's SYNC producer send."""
    network: Any = importlib.import_module("canopen").Network()
    _insist(
        lambda: network.connect(
            interface="socketcand", channel=CHANNEL, host=HOST, port=port, tcp_tune=True, ignore_config=True
        )
    )
    network.sync.start(PERIOD_S)
    time.sleep(seconds)
    network.sync.stop()
    network.disconnect()


def nothing_but_deadlines(port: int, seconds: float) -> None:
    """Wait for absolute deadlines, the last of it actively, and write bytes: what jitter remains is bus and listener.

    This is no contender but the floor, below which nobody can be seen to come.
    """
    with socket.create_connection((HOST, port)) as bus:
        bus.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for question in (b"", f"< open {CHANNEL} >".encode("ascii"), b"< rawmode >"):
            bus.sendall(question)
            bus.recv(64)
        bus.setblocking(False)
        text, clock = f"< send {COMMAND:03X} 4 0 0 0 0 >".encode("ascii"), time.monotonic
        begun_s = clock()
        for number in range(round(seconds / PERIOD_S)):
            deadline_s = begun_s + number * PERIOD_S
            time.sleep(max(0.0, deadline_s - clock() - 0.001))
            while clock() < deadline_s:
                pass
            bus.send(text)
            with contextlib.suppress(BlockingIOError):
                bus.recv(65536)


SENDERS: Final[dict[str, Callable[[int, float], None]]] = {
    "asyncio_sleep": asyncio_sleep,
    "soft_realtime_loop": soft_realtime_loop,
    "python_can_periodic": python_can_periodic,
    "canopen_sync": canopen_sync,
    FLOOR: nothing_but_deadlines,
}


def _bus(port: int) -> can.BusABC:
    return _insist(
        lambda: can.Bus(
            interface="socketcand", channel=CHANNEL, host=HOST, port=port, tcp_tune=True, ignore_config=True
        )
    )


def _insist(join: Callable[[], _Joined]) -> _Joined:
    """Join the bus; python-can's interface fails when a frame of the drive follows closely upon the greeting."""
    for _ in range(_ATTEMPTS):
        with contextlib.suppress(can.CanError):
            return join()
    return join()


def _frame() -> can.Message:
    return can.Message(arbitration_id=COMMAND, is_extended_id=False, data=bytes(4))


def main() -> None:
    """Send until the time is over."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sender", choices=sorted(SENDERS))
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    SENDERS[options.sender](options.port, options.seconds)


if __name__ == "__main__":
    main()
