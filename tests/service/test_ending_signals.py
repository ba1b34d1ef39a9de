"""Signals that would end the process: real ones, to the real service in simulated time."""

import asyncio
import signal
import threading
from collections.abc import Iterator

import pytest
import structlog

from tests.service.rig import World, simulate
from twostage_servo.axis.state import State
from twostage_servo.service.ending_signals import ENDING, EndingSignals, _name

NAMED = [
    signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM,
    signal.SIGVTALRM, signal.SIGPROF, signal.SIGXCPU, signal.SIGIO, signal.SIGPWR, signal.SIGSTKFLT, signal.SIGRTMIN,
    signal.SIGRTMAX,
]  # fmt: skip


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Begin with the defaults of a fresh interpreter, and leave what was there."""
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    changeable = set(before) - {signal.SIGKILL, signal.SIGSTOP}
    for number in changeable:
        if number not in {signal.SIGPIPE, signal.SIGXFSZ, signal.SIGCHLD}:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number in changeable:
        signal.signal(number, before[number] or signal.SIG_DFL)


def disabled_at_the_end(world: World) -> bool:
    return [(command.effort, command.enable) for _, command in world.sent()][-3:] == [(0.0, False)] * 3


def send_in_mid_move(*numbers: int, pause_s: float = 0.0) -> tuple[int, World, float]:
    """Send signals to a service whose axis cruises; return the exit code, and how far the axis still went."""

    async def script(world: World) -> tuple[int, World, float]:
        signals.call(world.service.shut_down, asyncio.get_running_loop())
        await world.cruising()
        place = world.drive.position
        for number in numbers:
            signal.raise_signal(number)
            await world.seconds(pause_s)
        await world.until(world.serving.done)
        return signals.exit_code, world, world.drive.position - place

    with EndingSignals() as signals:
        return simulate(script)


@pytest.mark.parametrize("number", NAMED, ids=_name)
def test_each_brakes_and_disables_the_drive(number: signal.Signals) -> None:
    exit_code, world, travel = send_in_mid_move(number)
    assert exit_code == (0 if number in {signal.SIGTERM, signal.SIGINT} else 128 + number)
    assert disabled_at_the_end(world)
    assert world.drive.counters.command_timeouts == 0
    assert world.axis.trip is None
    assert 2.0 < travel < 10.0  # a controlled stop from 100 mm/s with 1000 mm/s²: 5 mm


@pytest.mark.parametrize(
    "numbers",
    [(signal.SIGTERM,) * 3, (signal.SIGINT,) * 3, (signal.SIGHUP, signal.SIGTERM), (signal.SIGTERM, signal.SIGHUP)],
    ids=lambda numbers: " ".join(_name(number) for number in numbers),
)
def test_another_one_does_not_cut_the_braking_short(numbers: tuple[int, ...]) -> None:
    exit_code, world, travel = send_in_mid_move(*numbers, pause_s=0.015)
    assert exit_code == (0 if numbers[0] in {signal.SIGTERM, signal.SIGINT} else 128 + numbers[0])
    assert disabled_at_the_end(world)
    assert world.drive.counters.command_timeouts == 0
    assert 2.0 < travel < 10.0


@pytest.mark.parametrize("number", [signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU], ids=lambda number: number.name)
def test_a_controller_is_not_suspended(number: signal.Signals) -> None:
    async def script(world: World) -> None:
        signals.call(world.service.shut_down, asyncio.get_running_loop())
        await world.cruising()
        signal.raise_signal(number)
        await world.seconds(0.5)
        assert world.state() is State.SPEED_STAGE
        assert world.service.statistics.missed == 0

    with EndingSignals() as signals:
        signal.raise_signal(number)  # also before there is a loop
        simulate(script)
    assert signals.received is None


def test_all_that_can_be_caught_and_would_end_the_process_are_caught() -> None:
    with EndingSignals():
        left = {
            number
            for number in signal.valid_signals()
            if signal.getsignal(number) is signal.SIG_DFL and number not in {signal.SIGKILL, signal.SIGSTOP}
        }
    faults = {"SIGABRT", "SIGBUS", "SIGFPE", "SIGILL", "SIGSEGV", "SIGSYS", "SIGTRAP"}
    harmless = {"SIGCHLD", "SIGCONT", "SIGURG", "SIGWINCH"}
    assert {_name(number) for number in left} == faults | harmless
    assert len(ENDING) > 40  # the real-time signals, too


def test_the_process_gets_its_handlers_back() -> None:
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    with EndingSignals():
        assert signal.getsignal(signal.SIGHUP) is not signal.SIG_DFL
    assert {number: signal.getsignal(number) for number in signal.valid_signals()} == before


def test_what_was_ignored_or_caught_before_stays_so() -> None:
    """As SIGHUP is under nohup."""
    caught: list[int] = []
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGUSR1, lambda number, _: caught.append(number))
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # which is how one asks a service to end: never ignored
    with EndingSignals() as signals:
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGUSR1)
        assert signals.received is None
        with pytest.raises(SystemExit):
            signal.raise_signal(signal.SIGTERM)
    assert caught == [signal.SIGUSR1]


@pytest.mark.parametrize(
    ("number", "exit_code"), [(signal.SIGTERM, 0), (signal.SIGHUP, 129), (signal.SIGQUIT, 131), (signal.SIGUSR1, 138)]
)
def test_before_there_is_anything_to_bring_to_rest_the_program_ends_at_once(
    number: signal.Signals, exit_code: int
) -> None:
    with EndingSignals(), pytest.raises(SystemExit) as ended:
        signal.raise_signal(number)
    assert ended.value.code == exit_code


def test_an_interruption_before_that_is_one() -> None:
    with EndingSignals(), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_one_that_was_swallowed_at_the_start_ends_the_service_when_it_runs() -> None:
    async def script(world: World) -> bool:
        signals.call(world.service.shut_down, asyncio.get_running_loop())
        await world.until(world.serving.done)
        return disabled_at_the_end(world)

    with EndingSignals() as signals:
        with pytest.raises(SystemExit):
            signal.raise_signal(signal.SIGHUP)
        assert simulate(script)
    assert signals.exit_code == 129


def test_one_that_comes_before_the_first_tick_ends_the_service() -> None:
    async def script(world: World) -> int:
        signals.call(world.service.shut_down, asyncio.get_running_loop())
        signal.raise_signal(signal.SIGUSR1)
        await world.until(world.serving.done)
        return world.service.statistics.count

    with EndingSignals() as signals:
        assert simulate(script) <= 4
    assert signals.exit_code == 138


def test_one_that_comes_while_the_bus_does_not_open_ends_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        signals.call(world.service.shut_down, asyncio.get_running_loop())
        world.axis_loop.bus.link.close()
        world.axis_loop.bus.error = "lost"

        async def slowly() -> None:
            await asyncio.sleep(1e6)

        monkeypatch.setattr(world.axis_loop.bus.link, "open_in_thread", slowly)
        world.axis_loop.bus.start()
        await world.seconds(1.0)
        signal.raise_signal(signal.SIGHUP)
        await world.until(world.serving.done)

    with EndingSignals() as signals:
        simulate(script)
    assert signals.exit_code == 129


def test_in_another_thread_than_the_main_one_nothing_is_caught() -> None:
    def enter() -> None:
        with EndingSignals():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()


@pytest.mark.parametrize(
    ("number", "level", "name"),
    [
        (signal.SIGTERM, "info", "SIGTERM"),
        (signal.SIGINT, "info", "SIGINT"),
        (signal.SIGHUP, "warning", "SIGHUP"),
        (signal.SIGRTMIN + 3, "warning", "SIGRTMIN+3"),
    ],
)
def test_the_log_says_on_which_signal_the_service_ends(number: int, level: str, name: str) -> None:
    with structlog.testing.capture_logs() as logs:
        send_in_mid_move(number)
    told = [line for line in logs if line["event"] == "ending on a signal"]
    assert told == [{"event": "ending on a signal", "log_level": level, "signal": name}]


def test_that_it_was_not_suspended_is_told_with_what_ends_it() -> None:
    async def script(world: World) -> None:
        signals.call(world.service.shut_down, asyncio.get_running_loop())
        signal.raise_signal(signal.SIGTSTP)
        await world.seconds(0.1)

    with EndingSignals() as signals, structlog.testing.capture_logs() as logs:
        simulate(script)
        signal.raise_signal(signal.SIGTSTP)  # when the loop is closed there is nothing to tell any more
    (told,) = [line for line in logs if "signal" in line]
    assert (told["log_level"], told["signal"]) == ("warning", "SIGTSTP")
    assert "end it with SIGTERM or Ctrl-C" in told["event"]


def test_one_that_comes_when_the_loop_is_closed_decides_on_the_exit_code_alone() -> None:
    async def script(world: World) -> None:
        signals.call(world.service.shut_down, asyncio.get_running_loop())

    with EndingSignals() as signals:
        simulate(script)
        signal.raise_signal(signal.SIGHUP)
    assert signals.exit_code == 129
