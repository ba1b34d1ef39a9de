"""When clients are served, on a host whose clock moves on while it works."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable

from tests.host_loop import HostLoop
from twostage_servo.service.background_server import BackgroundServer, Priority

PERIOD_S = 0.01


class BackgroundRig:
    """Serves whoever asks, one at a time, and records who was served and when."""

    def __init__(self) -> None:
        self.background = BackgroundServer(PERIOD_S)
        self.served: list[tuple[str, float]] = []
        self.clients: set[asyncio.Task[None]] = set()
        self.loop = asyncio.get_running_loop()

    def ask(self, name: str, work_s: float, rank: Priority = Priority.REQUEST) -> "asyncio.Task[None]":
        task = asyncio.create_task(self._serve(name, work_s, rank))
        self.clients.add(task)
        return task

    async def tick(self, next_s: float) -> None:
        """End a tick: the loop has to be free at a time; then let everybody do what can be done by then."""
        self.background.open(next_s)
        for _ in range(200):
            await asyncio.sleep(0)

    @property
    def names(self) -> str:
        return "".join(name for name, _ in self.served)

    async def _serve(self, name: str, work_s: float, rank: Priority) -> None:
        async with self.background.slot(rank):
            self.served.append((name, self.loop.time()))
            assert isinstance(self.loop, HostLoop)
            self.loop.work(work_s)


def on_host(script: Callable[[BackgroundRig], Awaitable[None]]) -> BackgroundRig:
    async def main() -> BackgroundRig:
        rig = BackgroundRig()
        await script(rig)
        for task in rig.clients:
            task.cancel()
        await asyncio.gather(*rig.clients, return_exceptions=True)
        return rig

    with asyncio.Runner(loop_factory=HostLoop) as runner:
        return runner.run(main())


def test_nobody_is_served_before_the_first_tick_and_all_in_their_order_after_it() -> None:
    async def script(rig: BackgroundRig) -> None:
        for name in "abc":
            rig.ask(name, 1e-4)
        await asyncio.sleep(0)
        assert rig.names == ""
        await rig.tick(rig.loop.time() + PERIOD_S)

    assert on_host(script).names == "abc"


def test_all_together_take_three_tenths_of_a_period_and_the_rest_waits_for_the_next_tick() -> None:
    async def script(rig: BackgroundRig) -> None:
        for name in "abcdefgh":
            rig.ask(name, 1e-3)
        await asyncio.sleep(0)
        await rig.tick(rig.loop.time() + PERIOD_S)
        assert rig.names == "abc"
        await rig.tick(rig.loop.time() + PERIOD_S)
        assert rig.names == "abcdef"

    on_host(script)


def test_no_turn_begins_that_could_last_into_the_wait_for_the_next_tick() -> None:
    async def script(rig: BackgroundRig) -> None:
        rig.ask("a", 1.5e-3)
        await asyncio.sleep(0)
        await rig.tick(rig.loop.time() + PERIOD_S)  # now it is known how long a slot may take
        free_until_s = rig.loop.time() + 2.5e-3
        for name in "bcd":
            rig.ask(name, 0.2e-3)
        await asyncio.sleep(0)
        rig.background.open(free_until_s)
        for _ in range(50):
            await asyncio.sleep(0)
        rig.loop._now_s = free_until_s - 1.0e-3  # type: ignore[attr-defined]
        rig.ask("e", 0.2e-3)
        await asyncio.sleep(0)
        assert rig.names == "abcd"
        await rig.tick(rig.loop.time() + PERIOD_S)
        assert rig.names == "abcde"

    on_host(script)


def test_one_is_served_after_each_tick_however_late_it_is() -> None:
    async def script(rig: BackgroundRig) -> None:
        for name in "abc":
            rig.ask(name, 1e-4)
        await asyncio.sleep(0)
        for served in ("a", "ab", "abc"):
            await rig.tick(rig.loop.time() - 1.0)
            assert rig.names == served

    on_host(script)


def test_the_urgent_go_first_and_may_use_all_of_the_time() -> None:
    async def script(rig: BackgroundRig) -> None:
        for name in "abcdef":
            rig.ask(name, 1e-3)
        for name in "XYZ":
            rig.ask(name, 2e-3, Priority.URGENT)
        await asyncio.sleep(0)
        await rig.tick(rig.loop.time() + PERIOD_S)
        assert rig.names == "XYZa"
        rig.ask("U", 1e-3, Priority.URGENT)
        await asyncio.sleep(0)
        assert rig.names == "XYZaU"

    on_host(script)


def test_a_flood_of_the_urgent_holds_up_no_tick_and_shuts_nobody_out() -> None:
    async def script(rig: BackgroundRig) -> None:
        for name in "ab":
            rig.ask(name, 0.5e-3)
        for name in "TUVWXYZ":
            rig.ask(name, 1.8e-3, Priority.URGENT)
        await asyncio.sleep(0)
        await rig.tick(rig.loop.time() - 1.0)
        assert rig.names == "Ta"
        ends_s = rig.loop.time() + PERIOD_S
        await rig.tick(ends_s)
        assert rig.names == "TaUVWXYb"
        assert rig.loop.time() < ends_s

    on_host(script)


def test_neither_requests_nor_connections_shut_the_others_out() -> None:
    async def script(rig: BackgroundRig) -> None:
        for name in "CD":
            rig.ask(name, 0.5e-3, Priority.CONNECTION)
        for name in "abcdefg":
            rig.ask(name, 1e-3)
        await asyncio.sleep(0)
        await rig.tick(rig.loop.time() + PERIOD_S)
        assert rig.names == "CDabc"
        await rig.tick(rig.loop.time() - 1.0)
        assert rig.names == "CDabcd"  # one of each rank comes in any case
        for name in "EFGHIJKL":
            rig.ask(name, 1e-3, Priority.CONNECTION)
        await asyncio.sleep(0)
        await rig.tick(rig.loop.time() + PERIOD_S)
        assert rig.names == "CDabcdEFGHIefg"

    on_host(script)


def test_who_reads_and_who_is_let_in_leave_each_other_and_the_requests_their_part() -> None:
    async def script(rig: BackgroundRig) -> None:
        for _ in range(12):
            rig.ask("C", 0.5e-3, Priority.CONNECTION)
            rig.ask("R", 0.5e-3, Priority.READING)
            rig.ask("a", 0.5e-3)
            rig.ask("w", 0.5e-3, Priority.WATCHING)
        await asyncio.sleep(0)
        await rig.tick(rig.loop.time() + PERIOD_S)
        assert rig.names == "CCCCCCCCCRRaaaaw"

    on_host(script)


def test_what_the_loop_does_between_two_turns_counts_as_well() -> None:
    """A flood of small requests costs mostly the passes of the loop that serve them."""

    async def script(rig: BackgroundRig) -> None:
        for _ in range(120):
            rig.ask("a", 1e-6)
        await asyncio.sleep(0)
        assert isinstance(rig.loop, HostLoop)
        rig.background.open(rig.loop.time() + PERIOD_S)
        for _ in range(200):
            rig.loop.work(1e-4)  # a pass
            await asyncio.sleep(0)
        assert 25 <= len(rig.names) <= 40

    on_host(script)


def test_one_who_leaves_the_queue_leaves_no_place_in_it() -> None:
    async def script(rig: BackgroundRig) -> None:
        waiting = [rig.ask("a", 1e-4) for _ in range(1000)]
        await asyncio.sleep(0)
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)
        assert not any(rig.background._queues.values())

    on_host(script)


def test_connections_take_no_more_than_their_share() -> None:
    async def script(rig: BackgroundRig) -> None:
        for name in "ABCDEFGH":
            rig.ask(name, 1e-3, Priority.CONNECTION)
        await asyncio.sleep(0)
        await rig.tick(rig.loop.time() + PERIOD_S)

    assert on_host(script).names == "ABCDE"


def test_a_turn_that_is_given_to_one_who_has_gone_is_passed_on() -> None:
    async def script(rig: BackgroundRig) -> None:
        leaving = rig.ask("a", 1e-4)
        rig.ask("b", 1e-4)
        await asyncio.sleep(0)
        rig.background.open(rig.loop.time() + PERIOD_S)
        leaving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await leaving
        for _ in range(5):
            await asyncio.sleep(0)

    assert on_host(script).names == "b"


def test_a_long_turn_does_not_shut_the_others_out_for_good() -> None:
    async def script(rig: BackgroundRig) -> None:
        rig.ask("a", 1.0)
        await asyncio.sleep(0)
        await rig.tick(rig.loop.time() + PERIOD_S)
        for name in "bcd":
            rig.ask(name, 1e-4)
        await asyncio.sleep(0)
        await rig.tick(rig.loop.time() + PERIOD_S)
        assert rig.names == "abcd"

    on_host(script)


def test_when_there_are_no_more_ticks_everybody_is_served() -> None:
    async def script(rig: BackgroundRig) -> None:
        for name in "abcdefgh":
            rig.ask(name, 1e-3)
        await asyncio.sleep(0)
        rig.background.end()
        for _ in range(50):
            await asyncio.sleep(0)
        rig.ask("i", 1e-3)
        for _ in range(5):
            await asyncio.sleep(0)

    assert on_host(script).names == "abcdefghi"
