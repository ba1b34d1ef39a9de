"""A drive's start-up, step by step and tick by tick."""

import asyncio

import can
import pytest

from tests.service.rig import World, simulate
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.drives.dbc.drive import DbcDrive
from twostage_servo.drives.frame import ReceivedFrame, SentFrame
from twostage_servo.drives.start_up import StartUp, StartUpStep

PERIOD_S = 0.01


def sent(number: int) -> SentFrame:
    return SentFrame(Identifier(number, extended=False), bytes((number,)))


def frame(number: int) -> can.Message:
    return can.Message(arbitration_id=number, is_extended_id=False)


def step(number: int, *, retries: int = 0, waits: bool = True, timeout_s: float = 0.03) -> StartUpStep:
    def answers(received: ReceivedFrame) -> bool:
        return received.arbitration_id == number + 1

    return StartUpStep((sent(number),), answers if waits else None, timeout_s, retries, f"step {number} failed")


def ticks(start_up: StartUp, count: int) -> list[int]:
    """What is sent in the next ticks: the number of the frame, 0 where there is none."""
    frames = [start_up.frames(0) for _ in range(count)]
    return [one[0].identifier.identifier if one else 0 for one in frames]


def is_done(start_up: StartUp) -> bool:
    return start_up.is_done


def test_an_empty_sequence_is_done_from_the_start() -> None:
    start_up = StartUp((), PERIOD_S)
    assert is_done(start_up)
    assert ticks(start_up, 3) == [0, 0, 0]
    start_up.accept(frame(1))
    start_up.restart()
    assert is_done(start_up)
    assert start_up.failure == ""


def test_each_step_waits_for_its_answer() -> None:
    start_up = StartUp((step(10), step(20)), PERIOD_S)
    assert ticks(start_up, 2) == [10, 0]
    start_up.accept(frame(21))  # of another step
    assert ticks(start_up, 1) == [0]
    start_up.accept(frame(11))
    assert not is_done(start_up)
    assert ticks(start_up, 2) == [20, 0]
    start_up.accept(frame(21))
    assert is_done(start_up)
    assert ticks(start_up, 5) == [0] * 5


def test_a_step_that_waits_for_nothing_is_over_as_it_is_sent() -> None:
    start_up = StartUp((step(10, waits=False), step(20, waits=False)), PERIOD_S)
    assert ticks(start_up, 1) == [10]
    assert not is_done(start_up)
    assert ticks(start_up, 1) == [20]
    assert is_done(start_up)


def test_what_comes_before_the_question_is_no_answer_to_it() -> None:
    start_up = StartUp((step(10),), PERIOD_S)
    start_up.accept(frame(11))
    assert not is_done(start_up)


@pytest.mark.parametrize("retries", [0, 1, 3])
def test_it_is_tried_again_and_then_begins_anew(retries: int) -> None:
    start_up = StartUp((step(10, waits=False), step(20, retries=retries)), PERIOD_S)
    assert ticks(start_up, 1) == [10]
    assert ticks(start_up, 3 * (1 + retries)) == [20, 0, 0] * (1 + retries)
    assert start_up.failure == ""
    assert ticks(start_up, 2) == [10, 20]
    assert start_up.failure == "step 20 failed"
    start_up.accept(frame(21))
    assert is_done(start_up)


def test_missed_ticks_count() -> None:
    start_up = StartUp((step(10, retries=1),), PERIOD_S)
    assert start_up.frames(5) == (sent(10),)  # nothing had been sent yet
    assert start_up.frames(1) == ()
    assert start_up.frames(1) == (sent(10),)


def test_it_can_be_begun_anew_at_any_time() -> None:
    start_up = StartUp((step(10), step(20)), PERIOD_S)
    start_up.frames(0)
    start_up.accept(frame(11))
    start_up.frames(0)
    start_up.restart()
    assert ticks(start_up, 1) == [10]
    start_up.accept(frame(21))
    assert not is_done(start_up)


def test_a_drive_that_has_booted_is_started_again() -> None:
    start = SentFrame(Identifier(0, extended=False), b"\1")
    steps = (StartUpStep((start,), lambda received: received.arbitration_id == 0x701, 0.5, 0, "no heartbeat"),)

    async def script(world: World) -> None:
        loop = world.axis_loop
        assert isinstance(loop.drive, DbcDrive)
        loop.drive.start_up, loop.start_up = steps, StartUp(steps, PERIOD_S)
        await world.until(lambda: loop.start_up.is_done)
        await world.seconds(0.5)
        assert started(world) == [b"\1"]
        world.drive.reboot(asyncio.get_running_loop().time(), 0.05)
        await world.seconds(0.5)
        assert started(world) == [b"\1", b"\1"]
        assert loop.start_up.is_done

    def started(world: World) -> list[bytes]:
        return [data for _, _, number, data in world.trace if number == 0]

    simulate(script)
