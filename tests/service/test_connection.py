"""One connection: what was read and is not served, what was written and is not taken."""

import asyncio
import socket
from collections.abc import Awaitable, Callable

import pytest

from twostage_servo.service.connection import Connection, ConnectionClosedError
from twostage_servo.service.request_age import RequestAge
from twostage_servo.timing.virtual_clock import run

LONGEST = 20
STOP = (b"stop", b"disarm")


def at_both_ends(script: Callable[[Connection, socket.socket], Awaitable[None]]) -> None:
    """Run a script with a connection and its client's end, in simulated time."""

    async def main() -> None:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            for end in (ours, theirs):
                end.setblocking(False)
            connection = Connection(ours, 7, LONGEST, RequestAge(0.01), 0.0)
            try:
                await script(connection, theirs)
            finally:
                connection.close()

    run(main())


def has_line(connection: Connection) -> bool:
    return connection.has_line


def has_unsent(connection: Connection) -> bool:
    return connection.has_unsent


def is_gone(connection: Connection) -> bool:
    return connection.gone


def read(connection: Connection, theirs: socket.socket, data: bytes) -> None:
    theirs.send(data)
    connection.receive()


def test_lines_are_taken_one_by_one_and_half_a_line_is_none_yet() -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        assert not has_line(connection)
        read(connection, theirs, b"one\ntwo\nth")
        assert has_line(connection)
        assert connection.pop_line() == b"one"
        assert connection.pop_line() == b"two"
        assert not has_line(connection)
        read(connection, theirs, b"ree\n")
        assert connection.pop_line() == b"three"
        assert not connection.ended

    at_both_ends(script)


def test_what_is_cut_off_by_the_end_is_a_line_and_nothing_is_none() -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        read(connection, theirs, b"cut")
        assert not has_line(connection)
        theirs.shutdown(socket.SHUT_WR)
        connection.receive()
        assert connection.ended
        assert has_line(connection)
        assert connection.pop_line() == b"cut"
        assert not has_line(connection)

    at_both_ends(script)


@pytest.mark.parametrize(("length", "too_long"), [(LONGEST - 1, False), (LONGEST, True)])
def test_a_line_with_its_end_may_be_as_long_as_the_longest(length: int, *, too_long: bool) -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        read(connection, theirs, length * b"x" + b"\nmore\n")
        assert connection.too_long is too_long
        assert has_line(connection)
        if not too_long:
            assert connection.pop_line() == length * b"x"
            connection.receive()
            assert connection.pop_line() == b"more"

    at_both_ends(script)


def test_no_more_is_read_than_the_longest_line_and_a_byte() -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        theirs.send(1000 * b"x")
        connection.receive()
        connection.receive()
        assert connection.too_long
        connection.end()
        assert not has_line(connection)
        assert connection.ended
        theirs.close()
        left = connection._stream.recv(1 << 16)
        assert len(left) == 1000 - (LONGEST + 1)

    at_both_ends(script)


@pytest.mark.parametrize(
    ("data", "longest", "names"),
    [
        (b"stop\n", 10, True),
        (b"a disarm b\n", 20, True),
        (b"status\nstop\n", 20, False),  # which is the next but one
        (b"stop", 10, True),  # cut off
        (b"status", 10, False),
        (b"xx stop\n", 8, True),
        (b"xxx stop\n", 8, False),  # longer than what is looked at
        (b"xxxxxx stop", 8, False),
        (b"xxxxstop", 8, False),
    ],
)
def test_whether_the_next_line_asks_for_something_urgent(data: bytes, longest: int, *, names: bool) -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        read(connection, theirs, data)
        assert connection.next_line_names(STOP, longest) is names

    at_both_ends(script)


@pytest.mark.parametrize(
    ("data", "ended", "none", "left"),
    [
        (b"status\nstop\nx\n", False, False, b"stop\nx\n"),
        (b"a\nb\nc disarm", False, False, b"c disarm"),
        (b"stop\nstop\n", False, False, b"stop\nstop\n"),
        (b"a\ndisarm\nstop\n", False, False, b"disarm\nstop\n"),
        (b"a\nb\nhalf", False, True, b"half"),
        (b"a\nb\nhalf", True, True, b""),
        (b"a\nb\n", False, True, b""),
    ],
)
def test_what_was_only_asked_is_forgotten_up_to_the_first_command(
    data: bytes, left: bytes, *, ended: bool, none: bool
) -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        read(connection, theirs, data)
        if ended:
            theirs.shutdown(socket.SHUT_WR)
            connection.receive()
        assert connection.drop_lines_without(STOP) is none
        assert bytes(connection._incoming) == left

    at_both_ends(script)


def test_a_client_is_gone_when_both_directions_are_closed() -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        assert not is_gone(connection)
        theirs.shutdown(socket.SHUT_WR)
        connection.receive()
        assert connection.ended
        assert not is_gone(connection)  # it may wait for an answer
        theirs.close()
        assert is_gone(connection)

    at_both_ends(script)


def test_what_is_written_is_kept_until_it_is_taken_and_comes_whole() -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        whole = b"".join(b"%07d\n" % number for number in range(200_000))
        connection.write(b"")
        assert not has_unsent(connection)
        for start in range(0, len(whole), 100_000):
            connection.write(whole[start : start + 100_000])
        assert has_unsent(connection)
        taking = asyncio.create_task(connection.flushed())
        came = b""
        while len(came) < len(whole):
            await asyncio.sleep(0.001)
            assert not (taking.done() and connection.has_unsent)
            came += theirs.recv(1 << 20)
        await taking
        assert came == whole
        assert not has_unsent(connection)

    at_both_ends(script)


def test_a_snapshot_is_left_out_while_something_older_waits() -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        assert connection.send_snapshot(b"first\n")
        connection.write((1 << 20) * b"x")
        assert has_unsent(connection)
        assert not connection.send_snapshot(b"second\n")
        assert not connection.send_snapshot(b"third\n")
        assert connection.unsent == 2
        came = b""
        while connection.has_unsent:
            came += theirs.recv(1 << 20)
            await asyncio.sleep(0.001)
        assert connection.send_snapshot(b"fourth\n")
        assert connection.unsent == 2
        came += theirs.recv(1 << 21)
        assert came.startswith(b"first\n")
        assert came.endswith(b"fourth\n")

    at_both_ends(script)


def test_what_is_written_to_nobody_is_lost_and_is_no_error() -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        theirs.close()
        connection.write(b"lost")
        assert not has_unsent(connection)
        connection.write(b"lost, too")
        assert not has_unsent(connection)
        assert is_gone(connection)
        assert not connection.send_snapshot(b"lost")
        await connection.flushed()  # which never comes

    at_both_ends(script)


def test_after_it_is_closed_nothing_is_written_or_waited_for() -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        connection.write((1 << 20) * b"x")
        waiting = [asyncio.create_task(one) for one in (connection.readable(), connection.flushed())]
        await asyncio.sleep(0.0)
        connection.close()
        connection.close()
        for one in waiting:
            with pytest.raises(ConnectionClosedError, match="this side has closed"):
                await one
        with pytest.raises(ConnectionClosedError):
            await connection.readable()
        connection.write(b"more")
        assert not has_unsent(connection)
        assert not connection.send_snapshot(b"more")
        assert is_gone(connection)

    at_both_ends(script)


def test_what_the_client_said_last_does_not_take_back_what_it_was_told() -> None:
    """With unread data the kernel would reset the connection."""

    async def script(connection: Connection, theirs: socket.socket) -> None:
        theirs.send(1000 * b"x")
        connection.write(b"told")
        connection.close()
        assert theirs.recv(100) == b"told"
        assert theirs.recv(100) == b""

    at_both_ends(script)


def test_bytes_came_after_the_last_moment_at_which_there_was_nothing() -> None:
    async def script(connection: Connection, theirs: socket.socket) -> None:
        await asyncio.sleep(1.0)
        read(connection, theirs, b"one\n")
        assert connection.arrived_after_s == 0.0  # nobody has looked since it was made
        await asyncio.sleep(1.0)
        read(connection, theirs, b"two\n")
        assert connection.arrived_after_s == 1.0  # that read has emptied it
        await asyncio.sleep(1.0)
        connection.receive()  # nothing
        await asyncio.sleep(1.0)
        connection._incoming.clear()
        read(connection, theirs, (LONGEST + 1) * b"x")  # as much as is read at once: there may be more
        assert connection.arrived_after_s == 3.0
        await asyncio.sleep(1.0)
        connection._incoming.clear()
        read(connection, theirs, b"x")
        assert connection.arrived_after_s == 3.0
        connection.was_empty(4.5)
        connection.was_empty(4.0)
        read(connection, theirs, b"y")
        assert connection.arrived_after_s == 5.0  # the read before

    at_both_ends(script)
