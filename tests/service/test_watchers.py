"""Snapshots of many axes for many watchers: made once a tick, shared, and never while a tick is under way."""

import asyncio
import contextlib
import itertools
import json
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from tests.service.operators import Operator, connect, serve
from tests.service.rig import World
from tests.service.test_several_axes import Plant, axis_page, machine_file, operate
from twostage_servo.api.status import AxisReport
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.background_server import Priority
from twostage_servo.service.control_socket import ControlSocket
from twostage_servo.service.snapshot import report_axis
from twostage_servo.service.status_lines import StatusLines
from twostage_servo.service.watchers import Watchers
from twostage_servo.timing.virtual_clock import run

NAMES = ["a", "b", "c", "d"]
WATCHERS = 63
TICKS = 20


def four_axes(folder: Path) -> Path:
    pages = {name: axis_page(name, "can0", offset=number) for number, name in enumerate(NAMES)}
    return machine_file(folder, pages)


class Work:
    """Counts the reports of axes that are made, and those of them while a tick is under way."""

    def __init__(self, plant: Plant, patch: pytest.MonkeyPatch) -> None:
        self.made = self.within_ticks = 0
        self._in_tick = False
        report, publish = report_axis, plant.service.publish

        def counted(axis_loop: AxisLoop) -> AxisReport:
            self.made += 1
            self.within_ticks += self._in_tick
            return report(axis_loop)

        def published(tick: Any) -> None:
            self._in_tick = True
            publish(tick)
            self._in_tick = False

        patch.setattr("twostage_servo.service.status_lines.report_axis", counted)
        patch.setattr(plant.service, "publish", published)


def test_what_many_watchers_see_of_many_axes_is_made_once_a_tick_and_outside_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "s"

    async def script(plant: Plant) -> None:
        control = plant.loop.control_socket(path)
        await control.start()
        watchers: list[Operator] = []
        for number in range(WATCHERS):
            watcher = await connect(path)
            axis = {} if number % 3 else {"axis": NAMES[number % len(NAMES)]}
            await watcher.done(op="watch", every=1, **axis)
            watchers.append(watcher)
        work, count = Work(plant, monkeypatch), plant.service.statistics.count
        seen = [[await watcher.answer() for _ in range(TICKS)] for watcher in watchers]
        ticks = plant.service.statistics.count - count
        assert work.within_ticks == 0
        assert work.made <= len(NAMES) * (ticks + 1)
        for number, snapshots in enumerate(seen):
            counts = [snapshot["ticks"]["count"] for snapshot in snapshots]
            assert {after - before for before, after in itertools.pairwise(counts)} <= {1}
            if number % 3:
                assert set(snapshots[0]["axes"]) == set(NAMES)
            else:
                assert snapshots[0]["axis"]["name"] == NAMES[number % len(NAMES)]
        await control.stop()
        for watcher in watchers:
            watcher.die()

    operate(four_axes(tmp_path), script)


def test_a_line_has_what_the_snapshot_has(tmp_path: Path) -> None:
    async def script(plant: Plant) -> None:
        status = StatusLines(plant.requests.status.report)
        for name in (None, *NAMES):
            axis_loop = None if name is None else plant.loop.axis_loop(name)
            line = json.loads(b"".join(status.line(axis_loop, b'{"ok":true,')))
            addressed = None if axis_loop is None else [axis_loop]
            whole = json.loads(json.dumps(plant.requests.status.report.snapshot(addressed)))
            assert line == {"ok": True} | whole
        assert status.made == len(NAMES)
        status.forget()
        list(status.line(None, b"{"))
        assert status.made == 2 * len(NAMES)

    operate(four_axes(tmp_path), script)


def test_a_flood_of_stops_makes_one_report_a_tick_and_a_command_is_seen_in_its_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "s"

    async def script(world: World, control: ControlSocket) -> None:
        operator, other = await connect(path), await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.axis.ready_to_arm or world.state() == "holding")
        await world.seconds(0.5)
        assert (await operator.done(op="move", position=100.0))["move"]["outcome"] == "moving"
        assert (await other.done(op="stop"))["axis"]["state"] == "stopping"
        assert (await other.done(op="stop", quick=True))["axis"]["state"] == "quick_stopping"
        await world.seconds(1.0)
        made, count = control._sessions._requests.status.made, world.service.statistics.count
        other.writer.write(b'{"op": "stop"}\n' * 500)
        for _ in range(500):
            await other.answer()
        assert control._sessions._requests.status.made - made <= world.service.statistics.count - count + 1

    serve(path, script)


def test_a_defect_in_what_is_shown_ends_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "s"

    async def script(world: World, _: ControlSocket) -> None:
        watcher = await connect(path)
        await watcher.done(op="watch", every=1)

        def defect(_: AxisLoop) -> dict[str, Any]:
            raise ZeroDivisionError("a defect")

        monkeypatch.setattr("twostage_servo.service.status_lines.report_axis", defect)
        await world.seconds(0.2)
        assert isinstance(world.service.shutdown.failure, ZeroDivisionError)

    serve(path, script)


class FewPieces:
    """BackgroundServer of one piece each, and something that happens after the first of them."""

    slice_s = 0.0

    def __init__(self, after_the_first: Callable[[], None]) -> None:
        self._then = [after_the_first]

    @contextlib.asynccontextmanager
    async def slot(self, _: Priority) -> AsyncIterator[None]:
        yield
        if self._then:
            self._then.pop()()


class OneSlot:
    """Time that is given once something has happened."""

    slice_s = 0.0

    def __init__(self, before: Callable[[], None]) -> None:
        self._before = before

    @contextlib.asynccontextmanager
    async def slot(self, _: Priority) -> AsyncIterator[None]:
        self._before()
        yield


class Watcher:
    """A connection that watches, as far as snapshots go."""

    def __init__(self) -> None:
        self.busy = False
        self.lines: list[bytes] = []

    def send_snapshot(self, line: bytes) -> bool:
        self.lines.append(line)
        return True


class Shown:
    """What there is to be shown now: in two pieces, of which each tells the time at which it was made."""

    now = 0

    def line(self, _: str | None, before: bytes) -> Iterator[bytes]:
        yield b"%d" % self.now
        yield b" %d" % self.now


@pytest.mark.parametrize("later", [1, 7, 1000])
@pytest.mark.parametrize("watched_before", [False, True])
def test_what_was_begun_for_a_watcher_who_has_gone_is_shown_to_nobody_later(later: int, watched_before: bool) -> None:
    """One `watch` was ended in the middle of its snapshot, on a busy host; the next one was shown how it was then."""
    first, second, shown = Watcher(), Watcher(), Shown()
    connections = {first: None, second: None}
    book: Any = type("Book", (dict,), {"touch": lambda *_: None})(connections)
    background: Any = FewPieces(lambda: book.pop(first))
    status: Any = shown
    watchers = Watchers(book, status, background)

    async def script() -> None:
        working = asyncio.create_task(watchers.run())
        watchers.begin(cast("Any", first), 1, None)
        if watched_before:
            watchers.begin(cast("Any", second), 5, None)
            sent = watchers._watches[cast("Any", second)]  # it has been sent one, and is not due before
            watchers._watches[cast("Any", second)] = sent._replace(due=later + 1)
        for tick in (1, later):
            shown.now = tick
            watchers.publish(tick)
            await asyncio.sleep(0.001)
        if not watched_before:
            watchers.begin(cast("Any", second), 1, None)
        shown.now = later + 1
        watchers.publish(later + 1)
        await asyncio.sleep(0.001)
        working.cancel()

    run(script())
    assert (first.lines, second.lines) == ([], [b"%d %d" % (later + 1, later + 1)])


async def publish_two_ticks(watchers: Watchers, shown: Shown) -> None:
    """Let the watchers be served in two ticks, and go on after each."""
    working = asyncio.create_task(watchers.run())
    for tick in (1, 2):
        shown.now = tick
        watchers.publish(tick)
        await asyncio.sleep(0.001)
        assert not working.done()
    working.cancel()


def test_whoever_begins_to_watch_is_not_shown_what_another_was_shown_before_in_the_same_tick() -> None:
    """Between the two somebody may have commanded: `arm`, and then a snapshot that says `disarmed`, is none of it."""
    first, second, shown = Watcher(), Watcher(), Shown()
    book: Any = type("Book", (dict,), {"touch": lambda *_: None})({first: None, second: None})
    background = FewPieces(lambda: watchers.begin(cast("Any", second), 10, None))
    watchers = Watchers(book, cast("Any", shown), cast("Any", background))
    watchers.begin(cast("Any", first), 10, None)

    run(publish_two_ticks(watchers, shown))
    assert (first.lines, second.lines) == ([b"1 1"], [b"2 2"])


@pytest.mark.parametrize("begins_anew", [False, True])
def test_who_ends_while_the_snapshot_waits_for_its_time_is_sent_none(*, begins_anew: bool) -> None:
    first, second, shown = Watcher(), Watcher(), Shown()
    book: Any = type("Book", (dict,), {"touch": lambda *_: None})({first: None, second: None})

    def end() -> None:
        if shown.now == 1 and not first.lines:
            watchers.end(cast("Any", first))
            if begins_anew:
                watchers.begin(cast("Any", first), 10, None)

    watchers = Watchers(book, cast("Any", shown), cast("Any", OneSlot(end)))
    watchers.begin(cast("Any", first), 10, None)
    watchers.begin(cast("Any", second), 10, None)

    run(publish_two_ticks(watchers, shown))
    assert (first.lines, second.lines) == ([b"2 2"] if begins_anew else [], [b"1 1"])
