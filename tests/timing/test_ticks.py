import asyncio
import contextlib
import itertools
import math
import selectors

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.host_loop import HostLoop
from twostage_servo.timing.ticks import Tick, Ticks, WakeMargin, real_time_loop
from twostage_servo.timing.virtual_clock import VirtualClockLoop, run

PERIOD_S = 0.01


async def collect(ticks: Ticks, bodies_s: list[float]) -> list[tuple[Tick, float]]:
    """Serve one tick for each body, which takes the given time; gives the ticks and when they were served."""
    loop = asyncio.get_running_loop()
    served = []
    remaining = iter(bodies_s)
    async for tick in ticks:
        served.append((tick, loop.time()))
        body_s = next(remaining, None)
        if body_s is None:
            ticks.stop()
        else:
            await asyncio.sleep(body_s)
    return served


def test_the_first_tick_is_one_period_after_the_start_and_deadlines_are_multiples_not_sums() -> None:
    served = run(collect(Ticks(PERIOD_S), [0.0] * 999))
    assert [tick.index for tick, _ in served] == list(range(1, 1001))
    for tick, now_s in served:
        assert tick == Tick(tick.index, tick.index * PERIOD_S, 0.0, 0)
        assert now_s == tick.deadline_s


def test_a_given_start_sets_the_phase() -> None:
    served = run(collect(Ticks(PERIOD_S, start_s=0.004), [0.0, 0.0]))
    assert [now_s for _, now_s in served] == [0.004 + n * PERIOD_S for n in (1, 2, 3)]


def test_a_start_in_the_past_counts_what_was_missed_and_does_not_serve_it() -> None:
    served = run(collect(Ticks(PERIOD_S, start_s=-0.035), [0.0]))
    (first, _), (second, _) = served
    assert (first.index, first.missed) == (3, 2)
    assert first.lateness_s == pytest.approx(0.005)
    assert (second.index, second.missed, second.lateness_s) == (4, 0, 0.0)


def test_a_late_tick_skips_whole_periods_and_keeps_the_phase() -> None:
    served = run(collect(Ticks(PERIOD_S), [0.0, 0.034, 0.0, 0.0]))
    assert [(tick.index, tick.missed) for tick, _ in served] == [(1, 0), (2, 0), (5, 2), (6, 0), (7, 0)]
    late = served[2][0]
    assert late.lateness_s == pytest.approx(0.004)
    assert late.deadline_s == pytest.approx(0.05)
    assert [now_s for _, now_s in served[3:]] == [6 * PERIOD_S, 7 * PERIOD_S]


def test_a_body_that_ends_on_a_later_deadline_gets_that_one_on_time() -> None:
    served = run(collect(Ticks(PERIOD_S), [3 * PERIOD_S, 0.0]))
    assert [(tick.index, tick.missed) for tick, _ in served] == [(1, 0), (4, 2), (5, 0)]
    assert served[1][0].lateness_s < 1e-12


@pytest.mark.parametrize("start_s", [0.0, 0.1, 0.3, 1.7])
def test_a_body_that_ends_exactly_on_a_later_deadline_never_gets_the_one_before(start_s: float) -> None:
    """In floats (start + n period - start) / period often falls short of n; the tick would come twice in a row."""

    async def main(deadlines: list[int]) -> list[int]:
        loop = asyncio.get_running_loop()
        ticks = Ticks(PERIOD_S, start_s)
        served = []
        for index in deadlines:
            reached = loop.create_future()
            loop.call_at(start_s + index * PERIOD_S, reached.set_result, None)
            await reached
            served.append((await anext(ticks)).index)
        return served

    deadlines = list(range(3, 1000, 3))
    assert any(math.floor((start_s + n * PERIOD_S - start_s) / PERIOD_S) < n for n in deadlines)
    assert run(main(deadlines)) == deadlines


@given(st.lists(st.floats(0.0, 0.1), min_size=1, max_size=40), st.sampled_from([0.001, 0.01, 1 / 3, 0.007]))
def test_whatever_the_bodies_take_there_is_no_burst_and_no_lag(bodies_s: list[float], period_s: float) -> None:
    served = run(collect(Ticks(period_s), bodies_s))
    assert len(served) == len(bodies_s) + 1
    for (before, _), (tick, _) in itertools.pairwise(served):
        assert tick.index == before.index + 1 + tick.missed
        assert tick.missed >= 0
    for (tick, now_s), body_s in zip(served[1:], bodies_s, strict=True):
        assert tick.deadline_s == tick.index * period_s
        assert tick.lateness_s == max(0.0, now_s - tick.deadline_s)
        assert 0.0 <= tick.lateness_s < period_s
        assert tick.lateness_s <= body_s + 1e-9


def test_an_overdue_tick_still_lets_other_tasks_run() -> None:
    async def main() -> int:
        passes = 0

        async def other() -> None:
            nonlocal passes
            while True:
                passes += 1
                await asyncio.sleep(0)

        task = asyncio.create_task(other())
        ticks = Ticks(PERIOD_S, start_s=-1.0)
        await anext(ticks)
        before = passes
        ticks._index = 0  # overdue again, as after a suspension
        await anext(ticks)
        gained = passes - before
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        return gained

    assert run(main()) > 0


def test_stop_ends_a_wait_at_once_and_for_good() -> None:
    async def main() -> tuple[list[Tick], float, list[Tick]]:
        loop = asyncio.get_running_loop()
        ticks = Ticks(1.0)
        loop.call_at(2.5, ticks.stop)
        served = [tick async for tick in ticks]
        return served, loop.time(), [tick async for tick in ticks]

    served, ended_s, again = run(main())
    assert [tick.index for tick in served] == [1, 2]
    assert ended_s == 2.5
    assert again == []


def test_stop_before_the_first_tick_and_twice() -> None:
    ticks = Ticks(PERIOD_S)
    ticks.stop()
    ticks.stop()
    assert run(collect(ticks, [])) == []


def test_a_cancelled_wait_leaves_no_timer_and_can_be_taken_up_again() -> None:
    async def main() -> tuple[list[asyncio.TimerHandle], Tick]:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualClockLoop)
        ticks = Ticks(1.0)
        task = asyncio.ensure_future(anext(ticks))
        await asyncio.sleep(0.5)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        return [timer for timer in loop._scheduled if not timer.cancelled()], await anext(ticks)

    live_timers, tick = run(main())
    assert live_timers == []
    assert (tick.index, tick.deadline_s) == (1, 1.0)


@pytest.mark.parametrize("period_s", [0.0, -0.01, math.nan, math.inf])
def test_a_period_that_is_none_is_refused(period_s: float) -> None:
    with pytest.raises(ValueError, match="tick period"):
        Ticks(period_s)


def test_the_real_time_loop_waits_in_select_and_gives_the_same_ticks() -> None:
    async def main() -> list[Tick]:
        assert isinstance(asyncio.get_running_loop()._selector, selectors.SelectSelector)  # type: ignore[attr-defined]
        ticks = Ticks(0.001)
        return [await anext(ticks) for _ in range(5)]

    with asyncio.Runner(loop_factory=real_time_loop) as runner:
        served = runner.run(main())
    assert all(tick.index == before.index + 1 + tick.missed for before, tick in itertools.pairwise(served))
    assert all(tick.lateness_s >= 0.0 for tick in served)


# With a margin --------------------------------------------------------------------------------------------------------


class ToldMargin:
    """A margin that keeps what it is told."""

    def __init__(self, margin_s: float) -> None:
        self.margin_s = margin_s
        self.told_s: list[float] = []

    def learn(self, wake_latency_s: float) -> None:
        self.told_s.append(wake_latency_s)


def on_host(margin: ToldMargin, latencies_s: list[float], bodies_s: list[float]) -> list[Tick]:
    """The ticks on a host with these wake-up latencies; a body is waited for without a timer, so it needs none."""

    async def main() -> list[Tick]:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, HostLoop)
        loop.latencies_s = itertools.chain(latencies_s, itertools.repeat(0.0))
        ticks, served = Ticks(PERIOD_S, margin=margin), []
        for body_s in [*bodies_s, 0.0]:
            served.append(await anext(ticks))
            loop.work(body_s)
        return served

    with asyncio.Runner(loop_factory=HostLoop) as runner:
        return runner.run(main())


def test_a_wake_up_within_the_margin_makes_the_tick_punctual() -> None:
    served = on_host(ToldMargin(300e-6), [100e-6, 299e-6, 0.0, 200e-6], [0.0] * 3)
    assert [tick.index for tick in served] == [1, 2, 3, 4]
    for tick in served:
        assert 0.0 <= tick.lateness_s < 1e-6


def test_a_wake_up_beyond_the_margin_is_late_by_the_rest_of_it() -> None:
    served = on_host(ToldMargin(300e-6), [500e-6, 13e-3], [0.0])
    assert served[0].lateness_s == pytest.approx(200e-6, abs=2e-6)
    assert (served[1].index, served[1].missed) == (3, 1)
    assert served[1].lateness_s == pytest.approx(2.7e-3, abs=2e-6)


def test_the_margin_is_told_each_wake_up_latency_but_not_that_of_an_overdue_timer() -> None:
    margin = ToldMargin(300e-6)
    served = on_host(margin, [100e-6, 150e-6], [0.0, 12e-3])
    assert [tick.index for tick in served] == [1, 2, 3]
    assert margin.told_s == [pytest.approx(100e-6, abs=2e-6), pytest.approx(150e-6, abs=2e-6)]


def test_a_body_that_ends_within_the_margin_is_no_wake_up_and_the_tick_is_punctual() -> None:
    margin = ToldMargin(300e-6)
    served = on_host(margin, [], [PERIOD_S - 100e-6])
    assert len(margin.told_s) == 1
    assert 0.0 <= served[1].lateness_s < 1e-6


def test_a_clock_that_stands_still_is_waited_for_and_gives_the_same_ticks() -> None:
    """Simulated time has no use for a margin; one that is given by mistake must not hang it."""
    bodies_s = [0.0, 0.034, 0.0, PERIOD_S - 1e-4, 0.0]

    async def main(margin: WakeMargin | None) -> list[tuple[Tick, float]]:
        return await collect(Ticks(PERIOD_S, margin=margin), bodies_s)

    assert run(main(ToldMargin(300e-6))) == run(main(None))


def test_stop_ends_a_wait_with_a_margin_before_it_waits_busily() -> None:
    async def main() -> tuple[list[Tick], float]:
        loop = asyncio.get_running_loop()
        ticks = Ticks(1.0, margin=ToldMargin(1e-3))
        loop.call_at(2.5, ticks.stop)
        return [tick async for tick in ticks], loop.time()

    served, ended_s = run(main())
    assert [tick.index for tick in served] == [1, 2]
    assert ended_s == 2.5


@pytest.mark.parametrize("way_s", [1e-6, 4e-6, 15e-6])
def test_a_body_that_takes_a_while_to_begin_begins_at_its_deadline_and_never_before(way_s: float) -> None:
    """It takes that long from the end of the busy-wait to the body, now and then a millisecond."""
    begun_s: list[float] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, HostLoop)
        ticks = Ticks(PERIOD_S, margin=ToldMargin(300e-6))
        async for tick in ticks:
            loop.work(1e-3 if tick.index % 50 == 0 else way_s)
            begun_s.append(ticks.begin(tick) - tick.deadline_s)
            assert tick.lateness_s == max(0.0, begun_s[-1])
            if tick.index == 400:
                ticks.stop()

    with asyncio.Runner(loop_factory=HostLoop) as runner:
        runner.run(main())
    punctual = [one for one in begun_s if one < 0.5e-3]
    assert len(punctual) == len(begun_s) - 8
    assert min(punctual) >= 0.0
    assert max(punctual) < 0.4e-6


def test_without_a_margin_no_tick_begins_early() -> None:
    async def main() -> None:
        ticks = Ticks(PERIOD_S)
        async for tick in ticks:
            assert ticks.begin(tick) == tick.deadline_s
            if tick.index == 100:
                ticks.stop()

    run(main())


def test_the_current_margin_is_told() -> None:
    ticks = Ticks(PERIOD_S)
    assert ticks.margin_s == 0.0
    ticks.margin = ToldMargin(150e-6)
    assert ticks.margin_s == 150e-6


def test_the_real_time_loop_waits_busily_until_the_deadline() -> None:
    async def main() -> list[Tick]:
        ticks = Ticks(0.001, margin=ToldMargin(100e-6))
        return [await anext(ticks) for _ in range(5)]

    with asyncio.Runner(loop_factory=real_time_loop) as runner:
        served = runner.run(main())
    assert all(tick.index == before.index + 1 + tick.missed for before, tick in itertools.pairwise(served))
    assert all(tick.lateness_s >= 0.0 for tick in served)
