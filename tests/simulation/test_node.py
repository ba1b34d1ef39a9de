import asyncio
import contextlib
import uuid
from collections.abc import Callable
from typing import Any

import can
import pytest

from twostage_servo.canbus.hub import Hub
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.canbus.link import BusSettings, Link, LinkError
from twostage_servo.drives.dbc.drive_side import DbcDriveSide
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.simulation.drive import SimulatedDrive
from twostage_servo.simulation.node import DriveNode
from twostage_servo.simulation.settings import SimulationSettings
from twostage_servo.timing.ticks import Ticks, real_time_loop
from twostage_servo.timing.virtual_clock import run


class FailingLink(Link):
    """A link that fails on demand, whose openings and closings are noted with their time."""

    def __init__(self, settings: BusSettings, accepted: list[Identifier]) -> None:
        super().__init__(settings, accepted)
        self.refused_openings = 0
        self.fail = ""
        self.history: list[tuple[str, float]] = []

    def open(self) -> None:
        self.history.append(("open", asyncio.get_running_loop().time()))
        if self.refused_openings:
            self.refused_openings -= 1
            raise LinkError("no such bus. Plug it in.")
        super().open()

    def close(self) -> None:
        if self.is_open:
            self.history.append(("close", asyncio.get_running_loop().time()))
        super().close()

    def drain(self, most: int | None = None) -> list[can.Message]:
        if self.fail == "drain":
            raise LinkError("bus gone. Look at the cable.")
        return super().drain(most)

    def send(self, message: can.Message) -> bool:
        if self.fail == "send":
            raise LinkError("bus gone. Look at the cable.")
        return super().send(message)


class Bench:
    """A drive node and a controller's link on one virtual bus. To be made inside the loop."""

    def __init__(
        self,
        profile: DriveProfile,
        observer: Callable[[float, SimulatedDrive], None] | None = None,
        **settings: Any,
    ) -> None:
        bus = BusSettings(interface="virtual", channel=f"test {uuid.uuid4()}", reopen_interval_ms=200.0)
        simulation = SimulationSettings(**settings)
        self.profile = profile
        self.drive = SimulatedDrive(simulation, DbcDriveSide(profile), asyncio.get_running_loop().time())
        self.drive_link = FailingLink(bus, [profile.command_id])
        self.node = DriveNode(self.drive, self.drive_link, simulation.cycle_ms / 1e3, observer)
        self.link = Link(bus, [profile.feedback_id])

    async def move(self, duration_s: float, effort: float) -> list[tuple[float, float]]:
        """Command the effort each 10 ms, after one command without Enable; gives (time, position) of each feedback."""
        loop = asyncio.get_running_loop()
        self.link.open()
        received: list[tuple[float, float]] = []
        async for tick in Ticks(0.01):
            if tick.deadline_s > duration_s:
                break
            received += [(loop.time(), self.profile.decode_feedback(frame).position) for frame in self.link.drain()]
            data = self.profile.encode_command(effort, tick.index > 1, tick.index)
            self.link.send(self.link.prepare(self.profile.command_id, data))
        self.link.close()
        return received


def test_a_closed_circle_of_frames_in_simulated_time_is_the_same_in_every_run(profile: DriveProfile) -> None:
    async def main() -> tuple[list[tuple[float, float]], list[tuple[float, float]], SimulatedDrive]:
        true: list[tuple[float, float]] = []
        bench = Bench(
            profile, lambda now_s, drive: true.append((now_s, drive.position)), noise_std=0.01, coulomb_friction=0.05
        )
        task = asyncio.create_task(bench.node.run())
        received = await bench.move(2.0, 1.0)
        bench.node.stop()
        await task
        return received, true, bench.drive

    received, true, drive = run(main())
    again, true_again, _ = run(main())
    assert (received, true) == (again, true_again)
    assert len(received) >= 198
    assert drive.counters.command_timeouts == 0
    # final velocity 180 (1 - 0.05) / 14, within half a per cent after 2 s
    assert drive.velocity == pytest.approx(180 * 0.95 / 14, rel=0.005)
    truth = [position for _, position in true]
    assert truth == sorted(truth)
    measured = [position for _, position in received]
    assert max(abs(a - b) for a, b in zip(measured, truth, strict=False)) < 0.06


def test_the_observer_sees_the_true_state_at_each_sample_lost_or_not(profile: DriveProfile) -> None:
    async def main() -> list[float]:
        seen: list[float] = []
        bench = Bench(profile, lambda now_s, _: seen.append(now_s), feedback="cyclic", frame_loss=0.9)
        task = asyncio.create_task(bench.node.run())
        asyncio.get_running_loop().call_at(0.0995, bench.node.stop)
        await task
        return seen

    # Its first cycle opens the link, the second one sends what has been due since the start.
    assert run(main()) == pytest.approx([0.002, *(n / 100 for n in range(1, 10))])


def test_stop_ends_it_and_closes_its_link(profile: DriveProfile) -> None:
    async def main() -> tuple[list[tuple[str, float]], float]:
        bench = Bench(profile)
        asyncio.get_running_loop().call_at(0.5004, bench.node.stop)
        await bench.node.run()
        return bench.drive_link.history, asyncio.get_running_loop().time()

    assert run(main()) == ([("open", 0.001), ("close", 0.5004)], 0.5004)


def test_several_drives_of_one_process_name_their_axes_in_the_log(
    profile: DriveProfile, caplog: pytest.LogCaptureFixture
) -> None:
    async def main() -> None:
        bus = BusSettings(interface="virtual", channel=f"test {uuid.uuid4()}")
        side = DbcDriveSide(profile)
        drive = SimulatedDrive(SimulationSettings(), side, asyncio.get_running_loop().time())
        node = DriveNode(drive, Link(bus, side.identifiers), 0.001, axis="y")
        asyncio.get_running_loop().call_at(0.01, node.stop)
        await node.run()

    with caplog.at_level("INFO"):
        run(main())
    assert "simulated drive of axis y: on the bus" in caplog.messages


def test_cancelling_it_closes_its_link(profile: DriveProfile) -> None:
    async def main() -> bool:
        bench = Bench(profile)
        task = asyncio.create_task(bench.node.run())
        await asyncio.sleep(0.05)
        assert bench.drive_link.is_open
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        return bench.drive_link.is_open

    assert run(main()) is False


@pytest.mark.parametrize("operation", ["drain", "send"])
def test_a_bus_that_fails_is_opened_again_at_the_reopen_interval(profile: DriveProfile, operation: str) -> None:
    async def main() -> tuple[list[tuple[str, float]], int]:
        loop = asyncio.get_running_loop()
        bench = Bench(profile, feedback="cyclic", cycle_ms=10.0)

        def pull_the_plug() -> None:
            bench.drive_link.fail = operation
            bench.drive_link.refused_openings = 2

        def plug_in() -> None:
            bench.drive_link.fail = ""

        loop.call_at(0.295, pull_the_plug)
        loop.call_at(0.4, plug_in)
        loop.call_at(1.995, bench.node.stop)
        await bench.node.run()
        return bench.drive_link.history, bench.drive_link.counters.sent

    history, sent = run(main())
    expected = [("open", 0.01), ("close", 0.3), ("open", 0.5), ("open", 0.7), ("open", 0.9), ("close", 1.995)]
    assert [what for what, _ in history] == [what for what, _ in expected]
    assert [at_s for _, at_s in history] == pytest.approx([at_s for _, at_s in expected], abs=0.011)
    # 100 feedback/s and 10 heartbeats/s for 0.28 s and again for 1.09 s
    assert 145 <= sent <= 155


def test_a_drive_that_lost_its_bus_stops_by_its_own_timeout(profile: DriveProfile) -> None:
    async def main() -> SimulatedDrive:
        bench = Bench(profile)
        task = asyncio.create_task(bench.node.run())
        move = asyncio.create_task(bench.move(0.5, 1.0))
        await asyncio.sleep(0.3)
        bench.drive_link.fail = "drain"
        bench.drive_link.refused_openings = 1000
        await move
        bench.node.stop()
        await task
        bench.drive.cycle(0.5)
        return bench.drive

    drive = run(main())
    assert (drive.enabled, drive.effort, drive.counters.command_timeouts) == (False, 0.0, 1)


def test_opening_in_a_thread_survives_cancellation(profile: DriveProfile) -> None:
    """In real time the link opens in a thread; whoever cancels the node must not be left with an open bus."""

    async def main() -> bool:
        loop = asyncio.get_running_loop()
        bus = BusSettings(interface="virtual", channel=f"test {uuid.uuid4()}")
        opening: asyncio.Future[None] = loop.create_future()
        link = Link(bus, [profile.command_id])

        original = loop.run_in_executor
        working: asyncio.Future[None] = loop.create_future()

        def slow(executor: Any, func: Callable[..., None], *args: Any) -> "asyncio.Future[None]":
            async def later() -> None:
                await opening
                func(*args)

            nonlocal working
            working = asyncio.ensure_future(later())
            return asyncio.shield(working)

        loop.run_in_executor = slow  # type: ignore[method-assign, assignment]
        drive = SimulatedDrive(SimulationSettings(), DbcDriveSide(profile), loop.time())
        task = asyncio.create_task(DriveNode(drive, link, 0.001).run())
        await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.sleep(0.01)
        assert task.cancelled()
        opening.set_result(None)
        await working
        loop.run_in_executor = original  # type: ignore[method-assign]
        return link.is_open

    assert run(main()) is False


def test_in_real_time_it_joins_a_hub_that_its_own_loop_serves(profile: DriveProfile) -> None:
    async def main() -> float:
        hub = Hub(port=0)
        await hub.start()
        bus = BusSettings(interface="socketcand", channel="can0", options={"host": "127.0.0.1", "port": hub.port})
        drive = SimulatedDrive(
            SimulationSettings(initial_position=3.5), DbcDriveSide(profile), asyncio.get_running_loop().time()
        )
        node = DriveNode(drive, Link(bus, [profile.command_id]), 0.001)
        task = asyncio.create_task(node.run())
        link = Link(bus, [profile.feedback_id])
        await asyncio.to_thread(link.open)
        ticks = Ticks(0.001)
        async with asyncio.timeout(60.0):
            async for _ in ticks:
                if frames := link.drain():
                    break
        node.stop()
        await task
        link.close()
        await hub.stop()
        return profile.decode_feedback(frames[0]).position

    with asyncio.Runner(loop_factory=real_time_loop) as runner:
        assert runner.run(main()) == pytest.approx(3.5)
