"""Clients that try to keep others from `stop`: ``python -m tools.bench.stop_load KIND --socket PATH``.

One process for all clients of a kind, which never waits for one of them. It prints a line when they have begun, and
goes on until it is ended.
"""

import argparse
import contextlib
import json
import select
import socket
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from typing import Final

from twostage_servo.api.request_reading import LONGEST_LINE

Load = Generator[None, None, None]
"""What a kind does: each step is a little of it, and does not wait."""

_STATUS: Final = json.dumps({"op": "status"}).encode("ascii") + b"\n"
_UNREAD: Final = 120
"""Answers to a half-closed client: more than the kernel takes, less than the service would wait for."""


def readers(path: Path, count: int = 64) -> Load:
    """Ask for the status again as soon as it has been told."""
    return _asking(path, count, _STATUS)


def heavy_lines(path: Path, count: int = 55) -> Load:
    """Ask for what takes the longest to be found wrong, and name what is urgent in it, again and again."""
    head, foot = b'{"op":"move","positions":{"stop":""', b"}}\n"
    body = b"".join(b',"%x":""' % number for number in range(LONGEST_LINE))[: LONGEST_LINE - len(head) - len(foot)]
    return _asking(path, count, head + body[: body.rindex(b",")] + foot)


def connectors(path: Path, count: int = 64) -> Load:
    """Connect and leave: the queue of those who wait to be let in is always full."""
    waiting: list[socket.socket] = []
    with _closing(lambda: waiting):
        while True:
            one = _connected(path)
            if one is None:
                yield
            else:
                waiting.append(one)
            if len(waiting) > count:
                waiting.pop(0).close()
                yield


def half_closed(path: Path, count: int = 56) -> Load:
    """Ask for much, say that no more will come, and read nothing."""
    held: list[socket.socket] = []
    with _closing(lambda: held):
        while True:
            one = _connected(path)
            if one is not None:
                with contextlib.suppress(OSError):
                    one.send(_UNREAD * _STATUS)
                    one.shutdown(socket.SHUT_WR)
                held.append(one)
            if len(held) > count:
                held.pop(0).close()
            yield
            time.sleep(0.005)


def _asking(path: Path, count: int, line: bytes) -> Load:
    asking: dict[int, socket.socket] = {}
    poll = select.poll()
    with _closing(asking.values):
        while True:
            while len(asking) < count and (one := _connected(path)) is not None:
                asking[one.fileno()] = one
                poll.register(one, select.POLLIN)
                _send(one, line)
            for number, _ in poll.poll(10):
                if not _answered(asking[number]):
                    poll.unregister(number)
                    asking.pop(number).close()
                else:
                    _send(asking[number], line)
            yield


@contextlib.contextmanager
def _closing(held: Callable[[], Iterable[socket.socket]]) -> Iterator[None]:
    """Close those that are held at the end."""
    try:
        yield
    finally:
        for one in held():
            one.close()


def _connected(path: Path) -> socket.socket | None:
    one = socket.socket(socket.AF_UNIX)
    one.setblocking(False)
    try:
        one.connect(str(path))
    except BlockingIOError:
        one.close()
        return None
    return one


def _send(one: socket.socket, line: bytes) -> None:
    with contextlib.suppress(OSError):  # its end is seen where it is read
        one.send(line)


def _answered(one: socket.socket) -> bool:
    try:
        return bool(one.recv(1 << 18))
    except BlockingIOError:
        return True
    except OSError:
        return False


KINDS: Final[dict[str, Callable[[Path], Load]]] = {
    "readers": readers,
    "connectors": connectors,
    "half_closed": half_closed,
    "heavy_lines": heavy_lines,
}


def main() -> None:
    """Make work until the process is ended."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kind", choices=sorted(KINDS))
    parser.add_argument("--socket", type=Path, required=True)
    options = parser.parse_args()
    load = KINDS[options.kind](options.socket)
    for _ in range(10):
        next(load)
    print("ready", flush=True)
    for _ in load:
        pass


if __name__ == "__main__":
    main()
