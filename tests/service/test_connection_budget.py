"""Who goes and who waits where all places are taken: the rules by themselves."""

import asyncio
import socket
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack

import pytest

from twostage_servo.api.requests import StopRequest
from twostage_servo.service.connection import Connection
from twostage_servo.service.connections import MOST, Connections
from twostage_servo.service.newcomers import FAIR_CHANCE_S, MOST_SILENT, MOST_WAITING, Newcomers
from twostage_servo.service.request_age import RequestAge
from twostage_servo.timing.virtual_clock import run


class Ends:
    """Makes connections, and keeps their clients' ends."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self.theirs: dict[Connection, socket.socket] = {}

    def connection(self, peer: str = "") -> Connection:
        ours, theirs = (self._stack.enter_context(one) for one in socket.socketpair())
        ours.setblocking(False)
        connection = Connection(ours, len(self.theirs), 4096, RequestAge(0.01), 0.0)
        connection.peer = peer
        self.theirs[connection] = theirs
        return connection


@pytest.fixture
def ends() -> Iterator[Ends]:
    with ExitStack() as stack:
        yield Ends(stack)


# Those who are served -------------------------------------------------------------------------------------------------


def test_all_places_are_taken_when_the_last_one_is(ends: Ends) -> None:
    connections = Connections()
    for number in range(MOST):
        assert not connections.full
        assert len(connections) == number
        connections.add(ends.connection())
    assert connections.full
    first = next(iter(connections))
    connections.discard(first)
    connections.discard(first)
    assert first not in connections
    assert not connections.full


def test_who_goes_first() -> None:
    async def script(ends: Ends) -> None:
        connections = Connections()
        holder, idle, later, busy, stopping, ended = (ends.connection(name) for name in "hilbse")
        busy.begin_answer()
        stopping.hold_urgent(StopRequest())
        ended.ended = True
        for one in (holder, stopping, busy, idle, later, ended):
            connections.add(one)
        order = []
        while (leaving := connections.to_evict("h")) is not None:
            order.append(leaving)
            connections.discard(leaving)
        assert order == [ended, idle, later, busy, stopping]
        assert list(connections) == [holder]
        assert connections.to_evict(None) is holder

    with_ends(script)


def test_who_has_just_asked_for_something_is_the_last_to_go_of_those_who_are_idle(ends: Ends) -> None:
    connections = Connections()
    first, second, third = (ends.connection() for _ in range(3))
    for one in (first, second):
        connections.add(one)
    connections.touch(first)
    connections.touch(third)  # which is not among them
    assert list(connections) == [second, first]
    assert connections.to_evict(None) is second


# Those who have just come ---------------------------------------------------------------------------------------------


def with_ends(script: Callable[[Ends], Awaitable[None]]) -> None:
    async def main() -> None:
        with ExitStack() as stack:
            await script(Ends(stack))

    run(main())


def test_a_silent_one_has_its_fair_chance_before_another_takes_its_place() -> None:
    async def script(ends: Ends) -> None:
        newcomers = Newcomers(RequestAge(0.01))
        assert newcomers.oldest_silent() is None
        assert newcomers.pause_s() == 0.0
        first = ends.connection()
        newcomers.add_silent(first)
        await asyncio.sleep(0.015)
        for _ in range(MOST_SILENT - 1):
            assert not newcomers.is_silent_full
            assert newcomers.pause_s() == 0.0
            newcomers.add_silent(ends.connection())
        assert newcomers.is_silent_full
        assert len(newcomers) == MOST_SILENT
        assert newcomers.oldest_silent() is first
        assert newcomers.pause_s() == pytest.approx(FAIR_CHANCE_S - 0.015)
        await newcomers.room()
        assert asyncio.get_running_loop().time() == pytest.approx(FAIR_CHANCE_S)
        newcomers.remove_silent(first)
        newcomers.remove_silent(first)
        assert len(newcomers) == MOST_SILENT - 1
        newcomers.add_silent(ends.connection())
        await newcomers.room()
        assert asyncio.get_running_loop().time() == pytest.approx(0.015 + FAIR_CHANCE_S)  # the next one came then
        newcomers.close()

    with_ends(script)


def test_room_is_there_as_soon_as_a_silent_one_leaves() -> None:
    async def script(ends: Ends) -> None:
        newcomers = Newcomers(RequestAge(0.01))
        for _ in range(MOST_SILENT):
            newcomers.add_silent(ends.connection())
        waiting = asyncio.create_task(newcomers.room())
        await asyncio.sleep(0.001)
        assert not waiting.done()
        leaving = newcomers.oldest_silent()
        assert leaving is not None
        newcomers.remove_silent(leaving)
        await waiting
        assert asyncio.get_running_loop().time() == pytest.approx(0.001)
        newcomers.close()

    with_ends(script)


def test_those_who_speak_are_named_no_more_than_so_many_at_once_and_with_the_time_of_their_silence() -> None:
    async def script(ends: Ends) -> None:
        newcomers = Newcomers(RequestAge(0.01))
        ones = [ends.connection() for _ in range(5)]
        for one in ones:
            newcomers.add_silent(one)
        await asyncio.sleep(1.0)
        assert list(newcomers.speaking(3)) == []  # so all of them were silent until now
        await asyncio.sleep(1.0)
        hearing = asyncio.create_task(newcomers.somebody_speaks())
        await asyncio.sleep(0.5)
        assert not hearing.done()
        for one in ones[:4]:
            ends.theirs[one].send(b"x\n")
        await hearing
        spoke = list(newcomers.speaking(3))
        assert len(spoke) == 3
        for one in spoke:
            one.receive()
            assert one.arrived_after_s == 1.0
            newcomers.remove_silent(one)
        (last,) = newcomers.speaking(3)
        last.receive()
        assert last.arrived_after_s == 1.0  # it had spoken when the others were heard
        assert {last, *spoke} == set(ones[:4])
        newcomers.close()
        assert all(one.closed for one in (last, ones[4]))
        assert not any(one.closed for one in spoke)

    with_ends(script)


def test_those_who_wait_are_let_in_in_their_order_and_no_more_wait_than_may() -> None:
    async def script(ends: Ends) -> None:
        newcomers = Newcomers(RequestAge(0.01))
        assert newcomers.next_waiting() is None
        stop = StopRequest()
        ones = [ends.connection() for _ in range(MOST_WAITING)]
        for wave in range(2):
            hearing = asyncio.create_task(newcomers.somebody_waits())
            await asyncio.sleep(0.1)
            assert not hearing.done()
            for one in ones:
                assert not newcomers.is_waiting_full
                newcomers.add_waiting(one, stop if one is ones[1] else None)
            assert newcomers.is_waiting_full
            assert len(newcomers) == MOST_WAITING
            await hearing
            if wave == 0:
                came = [newcomers.next_waiting() for _ in ones]
                assert came == [(one, stop if one is ones[1] else None) for one in ones]
                assert newcomers.next_waiting() is None
        newcomers.close()
        assert all(one.closed for one in ones)
        assert len(newcomers) == 0

    with_ends(script)
