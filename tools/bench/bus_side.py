"""The bus and the listener of the frame measurements: ``python -m tools.bench.bus_side hub``, and ``... listen``.

The hub lets the kernel stamp the frames, on the loopback address. The listener is a socketcand client that goes by
those stamps. Both get a real-time priority if that is permitted, so that what is measured is the sender.
"""

import argparse
import itertools
import json
import socket
import sys
import time
from typing import Final

from tools.bench.plan import HOST, PERIOD_S
from tools.bench.scheduling import run_at
from tools.bench.stamping_hub import StampingHub

PRIORITY: Final = 60
CHANNEL: Final = "can0"
_SETTLING_S: Final = 0.2
_LONGEST_SILENCE_S: Final = 15.0


def serve() -> None:
    """Serve the bus until the process is ended; the first line that is printed tells the port."""
    hub = StampingHub()
    print(json.dumps({"port": hub.port, "real_time": run_at(PRIORITY)}), flush=True)
    hub.serve()


def listen(port: int, identifier: int, seconds: float) -> None:
    """Print by how much each interval between two frames differs from the period, in µs."""
    wanted = f"< frame {identifier:03X} ".encode("ascii")
    with socket.create_connection((HOST, port), timeout=_LONGEST_SILENCE_S) as bus:
        bus.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for question, answer in (("", "< hi >"), (f"< open {CHANNEL} >", "< ok >"), ("< rawmode >", "< ok >")):
            bus.sendall(question.encode("ascii"))
            if bus.recv(len(answer)).decode("ascii") != answer:
                sys.exit("the hub does not answer as socketcand does")
        print("ready", flush=True)
        arrivals = _arrivals(bus, wanted, seconds)
    period_ns = round(1e9 * PERIOD_S)
    differences = [abs(after - before - period_ns) for before, after in itertools.pairwise(arrivals)]
    print(json.dumps([round(1e-3 * difference, 3) for difference in differences]))


def _arrivals(bus: socket.socket, wanted: bytes, seconds: float) -> list[int]:
    """Return the stamps of the wanted frames, in ns, from a moment after the first one on."""
    arrivals: list[int] = []
    rest = b""
    begin_ns = end_ns = 0
    last_ns = time.monotonic_ns() + round(1e9 * (seconds + _LONGEST_SILENCE_S))
    while not end_ns or not arrivals or arrivals[-1] < end_ns:
        data = bus.recv(4096)
        if not data or time.monotonic_ns() > last_ns:
            sys.exit("the listener did not hear enough of the frames that it was to listen to")
        *tokens, rest = (rest + data).split(b">")
        for token in tokens:
            if not token.lstrip().startswith(wanted):
                continue
            seconds_text, decimals = token.split()[3].split(b".")
            now_ns = int(seconds_text) * 10**9 + int(decimals)
            if not end_ns:
                begin_ns = now_ns + round(1e9 * _SETTLING_S)
                end_ns = begin_ns + round(1e9 * seconds)
            elif now_ns >= begin_ns:
                arrivals.append(now_ns)
    return arrivals


def main() -> None:
    """Serve or listen, as the arguments say."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("role", choices=["hub", "listen"])
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--identifier", type=int, default=0x201)
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    if options.role == "hub":
        serve()
    else:
        listen(options.port, options.identifier, options.seconds)


if __name__ == "__main__":
    main()
