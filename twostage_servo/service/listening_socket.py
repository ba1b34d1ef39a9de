"""The listening end of the control socket, with what is known of when those who wait there came."""

import asyncio
import socket
from collections import deque
from typing import Final

from twostage_servo.service.connection import wake
from twostage_servo.service.request_age import RequestAge

BACKLOG: Final = 32
"""Clients that may wait to be let in: the next one waits for those before it, and all of them are let in in a tick."""


class ListeningSocket:
    """The listening socket, with what is known of when those who wait there came.

    Parameters
    ----------
    listener
        The socket.
    age
        Tells the time.
    """

    def __init__(self, listener: socket.socket, age: RequestAge) -> None:
        self._listener = listener
        self._age = age
        self._empty_s = age.now_s()  # nobody waited
        self._let_in: deque[float] = deque(maxlen=BACKLOG + 2)  # who comes after so many came after the first of them

    async def somebody(self) -> None:
        """Wait until somebody waits."""
        loop, watched_since_s = asyncio.get_running_loop(), self._age.now_s()
        future = loop.create_future()
        loop.add_reader(self._listener, wake, future)
        try:
            await future
        finally:
            loop.remove_reader(self._listener)
        empty_until_s = self._age.was_empty_until_s(watched_since_s)
        if empty_until_s is not None:
            self._empty_s = max(self._empty_s, empty_until_s)

    def accept(self) -> tuple[socket.socket, float] | None:
        """Return a client's socket, and a time at which that did not wait here yet; None if nobody waits."""
        now_s = self._age.now_s()
        try:
            stream, _ = self._listener.accept()
        except BlockingIOError:
            self._empty_s = now_s
            return None
        empty_s = self._empty_s
        if len(self._let_in) == self._let_in.maxlen:
            empty_s = max(empty_s, self._let_in[0])
        self._let_in.append(now_s)
        return stream, empty_s
