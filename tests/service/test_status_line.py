"""The line for `systemctl status`, of the real service in simulated time."""

from tests.service.rig import World, simulate
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.service.status_line import WORDS
from twostage_servo.timing.ticks import Tick


class Told:
    """A manager that takes each line."""

    def __init__(self, lines: list[str]) -> None:
        self._lines = lines

    def __call__(self, line: str) -> bool:
        self._lines.append(line)
        return True


def test_every_state_has_its_words() -> None:
    assert set(WORDS) == set(State)


def test_what_an_axis_does_is_told_once_a_change() -> None:
    async def script(world: World) -> None:
        lines: list[str] = []
        world.loop.listen(world.status_line(Told(lines)).publish)
        await world.cruising()
        await world.until(lambda: world.state() is State.HOLDING)
        await world.seconds(5.0)
        assert [line for line in lines if "bus" not in line and "silent" not in line] == [
            "x disarmed", "x moving", "x holding",
        ]  # fmt: skip

    simulate(script)


def test_an_override_is_told_while_it_is_in_force() -> None:
    async def script(world: World) -> None:
        await world.cruising()
        assert world.line() == "x moving"
        world.axis.set_override(0.0)
        assert world.line() == "x moving, override 0 %"
        world.axis.disarm()
        await world.until(lambda: world.state() is State.DISARMED)
        assert world.line() == "x disarmed"

    simulate(script)


def test_a_line_that_could_not_be_told_is_told_later() -> None:
    async def script(world: World) -> None:
        busy, lines = True, list[str]()

        def show(line: str) -> bool:
            if not busy:
                lines.append(line)
            return not busy

        world.loop.listen(world.status_line(show).publish)
        await world.armed()
        world.axis.raise_trip(TripCode.STALL, "nothing moves")
        await world.seconds(1.0)
        assert lines == []
        busy = False
        await world.seconds(1.0)
        (line,) = lines
        assert line.startswith("x tripped (stall)")

    simulate(script)


def test_a_trip_is_told_with_its_cause_and_what_to_do_next() -> None:
    async def script(world: World) -> None:
        await world.armed()
        world.axis.raise_trip(TripCode.STALL, "effort 12 V\nand no motion.")
        await world.seconds(1.0)
        line = world.line()
        assert line.startswith("x tripped (stall): effort 12 V and no motion. Find what blocks the axis")
        world.axis.reset()
        assert world.line() == "x disarmed"

    simulate(script)


def test_a_silent_drive_a_bus_in_trouble_and_one_that_is_gone_are_told() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        world.axis_loop.bus.link.controller_state = "passive"
        assert world.line() == "x disarmed, bus can0 error-passive"
        world.axis.drive.forget()
        assert world.line() == "x disarmed, the drive is silent"
        world.axis_loop.bus.error = "bus socketcan can0 failed: Network is down. Bring it up."
        line = world.line()
        assert line == "x disarmed, no bus: bus socketcan can0 failed: Network is down. Bring it up."
        world.axis_loop.bus.error = "x" * 10_000
        assert len(world.line()) == 2000
        world.axis_loop.bus.error = None

    simulate(script)


def test_missed_ticks_and_the_end_are_told() -> None:
    async def script(world: World) -> None:
        lines: list[str] = []
        world.loop.listen(world.status_line(Told(lines)).publish)
        await world.until(lambda: world.axis.ready_to_arm)
        world.ticks.hold_s = 0.05
        await world.seconds(1.5)
        assert "x disarmed | late, 4 ticks missed in the last second" in lines
        await world.seconds(2.0)
        assert lines[-1] == "x disarmed"
        world.service.shut_down()
        assert world.line() == "ending | x disarmed"

    simulate(script)


def test_missed_ticks_are_those_of_whole_seconds() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        lines: list[str] = []
        line, statistics = world.status_line(Told(lines)), world.service.statistics
        for index, missed in ((0, 0), (99, 3), (100, 4), (199, 4), (200, 4), (210, 9), (300, 9)):
            statistics.missed = missed
            line.publish(Tick(index, 0.01 * index, 0.0, 0))
        assert lines == [
            "x disarmed", "x disarmed | late, 4 ticks missed in the last second", "x disarmed",
            "x disarmed | late, 5 ticks missed in the last second",
        ]  # fmt: skip

    simulate(script)


def test_a_line_is_told_ten_times_a_second_at_most() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        told: list[int] = []

        def show(_: str) -> bool:
            told.append(index)
            return False

        line = world.status_line(show)
        for index in range(35):
            line.publish(Tick(index, 0.01 * index, 0.0, 0))
        assert told == [0, 10, 20, 30]

    simulate(script)
