import asyncio
import socket
import threading
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.timing.ticks import Ticks
from twostage_servo.timing.virtual_clock import DeadlockError, VirtualClockLoop, run


def test_time_begins_at_zero_and_jumps_to_each_deadline_exactly() -> None:
    deadlines_s = [1e-6, 0.001, 0.1 + 0.2, 86400.0 * 3, 1e9 / 3]

    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        times = [loop.time()]
        for deadline_s in deadlines_s:
            reached = loop.create_future()
            loop.call_at(deadline_s, reached.set_result, None)
            await reached
            times.append(loop.time())
        return times

    assert run(main()) == [0.0, *deadlines_s]


@given(st.lists(st.integers(0, 5), max_size=60))
def test_timers_run_by_deadline_and_equal_ones_in_the_order_of_scheduling(deadlines_ms: list[int]) -> None:
    ran: list[tuple[int, int]] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        for number, deadline_ms in enumerate(deadlines_ms):
            loop.call_at(deadline_ms / 1000, ran.append, (deadline_ms, number))
        await asyncio.sleep(1.0)

    run(main())
    assert ran == sorted((deadline_ms, number) for number, deadline_ms in enumerate(deadlines_ms))


def test_asyncio_alone_does_not_keep_the_order_of_equal_deadlines() -> None:
    """The reason for the ordered timers: when this fails, asyncio's heap has become stable and they can go."""
    loop = asyncio.SelectorEventLoop()
    try:
        ran: list[int] = []
        past_s = loop.time() - 1.0
        for number in range(10):
            loop.call_at(past_s, ran.append, number)
        loop.call_soon(loop.stop)
        loop.run_forever()
        loop.call_soon(loop.stop)
        loop.run_forever()
        assert sorted(ran) == list(range(10))
        assert ran != list(range(10))
    finally:
        loop.close()


def test_two_tickers_meet_in_the_same_order_whatever_the_rounding_of_their_deadlines() -> None:
    """2 * 0.05 == 10 * 0.01, but 3 * 0.05 > 15 * 0.01 by a rounding, which must not decide."""
    order: dict[int, list[str]] = {}

    async def tick(name: str, ticks: Ticks, every: int) -> None:
        async for passed in ticks:
            if passed.index % every == 0:
                order.setdefault(passed.index // every, []).append(name)
            if passed.index >= 100 * every:
                return

    async def main() -> None:
        await asyncio.gather(tick("fast", Ticks(0.01), 5), tick("slow", Ticks(0.05), 1))

    assert {n * 0.05 > 5 * n * 0.01 for n in range(1, 101)} == {True, False}
    run(main())
    # The slow one's timer is set earlier, at the meeting before.
    assert order == {n: ["slow", "fast"] for n in range(1, 101)}


def test_a_cancelled_timer_does_not_move_the_clock() -> None:
    async def main() -> float:
        loop = asyncio.get_running_loop()
        loop.call_at(0.5, pytest.fail, "a cancelled timer ran").cancel()
        await asyncio.sleep(1.0)
        return loop.time()

    assert run(main()) == 1.0


def test_cancelled_timers_do_not_pile_up() -> None:
    async def main() -> int:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualClockLoop)
        for _ in range(1000):
            loop.call_later(1e6, pytest.fail, "a cancelled timer ran").cancel()
        loop.call_later(1e5, pytest.fail, "a live timer, ahead of the cancelled ones")
        await asyncio.sleep(1.0)
        return len(loop._scheduled)

    assert run(main()) == 1


def test_real_descriptors_are_served_before_time_moves() -> None:
    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        near, far = socket.socketpair()
        with near, far:
            near.setblocking(False)
            loop.call_at(1000.0, pytest.fail, "time ran past what was ready")
            times = []
            for _ in range(5):
                loop.call_later(0.25, far.send, b"frame")
                assert await loop.sock_recv(near, 16) == b"frame"
                times.append(loop.time())
            return times

    assert run(main()) == [0.25, 0.5, 0.75, 1.0, 1.25]


def test_streams_over_tcp_work_and_cost_no_simulated_time() -> None:
    async def main() -> tuple[bytes, float]:
        async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(await reader.readline())
            writer.close()
            await writer.wait_closed()

        async with await asyncio.start_server(echo, "127.0.0.1", 0) as server:
            reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
            writer.write(b"position\n")
            answer = await reader.readline()
            writer.close()
            await writer.wait_closed()
        return answer, asyncio.get_running_loop().time()

    assert run(main()) == (b"position\n", 0.0)


def test_with_nothing_but_a_descriptor_it_waits_for_that() -> None:
    async def main() -> bytes:
        loop = asyncio.get_running_loop()
        near, far = socket.socketpair()
        with near, far:
            near.setblocking(False)
            sender = threading.Thread(target=far.send, args=(b"late",))
            loop.call_soon(sender.start)
            received = await loop.sock_recv(near, 16)
            sender.join()
            return received

    assert run(main()) == b"late"


def test_a_deadlock_is_an_error_and_not_a_hang() -> None:
    async def main() -> None:
        await asyncio.sleep(3.0)
        await asyncio.get_running_loop().create_future()

    with pytest.raises(DeadlockError, match="deadlock in simulated time"):
        run(main())


def test_an_executor_runs_inline() -> None:
    async def main() -> tuple[threading.Thread, float]:
        loop = asyncio.get_running_loop()
        thread = await loop.run_in_executor(None, threading.current_thread)
        assert await asyncio.to_thread(divmod, 7, 2) == (3, 1)
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(divmod, 1, 0)
        return thread, loop.time()

    assert run(main()) == (threading.main_thread(), 0.0)


def test_timeouts_of_asyncio_are_in_simulated_time() -> None:
    async def main() -> float:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(3600.0):
                await asyncio.Event().wait()
        return asyncio.get_running_loop().time()

    assert run(main()) == 3600.0


def test_a_closed_loop_takes_no_timer() -> None:
    loop = VirtualClockLoop()
    loop.close()
    with pytest.raises(RuntimeError, match="closed"):
        loop.call_at(1.0, print)


def test_the_course_of_a_program_is_the_same_in_every_run() -> None:
    def course() -> list[tuple[str, float]]:
        events: list[tuple[str, float]] = []

        async def worker(name: str, period_s: float, note: Callable[[tuple[str, float]], None]) -> None:
            for _ in range(50):
                await asyncio.sleep(period_s)
                note((name, asyncio.get_running_loop().time()))

        async def main() -> None:
            await asyncio.gather(*(worker(f"worker {n}", 0.001 * (1 + n % 4), events.append) for n in range(20)))

        run(main())
        return events

    first = course()
    assert len(first) == 1000
    assert course() == first
