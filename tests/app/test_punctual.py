"""What makes a service punctual on its host: put in place while it runs, told, and taken back."""

import asyncio
import contextlib
import gc

import pytest
import structlog

from tests.service.rig import World, simulate
from twostage_servo.app import punctual as module
from twostage_servo.app.punctual import punctual
from twostage_servo.host import realtime
from twostage_servo.host.garbage import GarbageCollection, postponed
from twostage_servo.host.realtime import Grant, RealtimeReport
from twostage_servo.host.settings import RealtimeSettings
from twostage_servo.service.runtime import Runtime
from twostage_servo.timing.output_offset import FixedOffset
from twostage_servo.timing.wake_margin import FixedMargin

GRANTED = Grant("cpus", "0", "0")
REFUSED = Grant("scheduling", "SCHED_FIFO 40", "SCHED_OTHER", "the kernel refused it", "setcap cap_sys_nice+ep")


@pytest.fixture(autouse=True)
def kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the kernel grant one thing and refuse another, and this process stay as it is."""
    monkeypatch.setattr(realtime, "apply", lambda _: RealtimeReport((GRANTED, REFUSED)))


def settings(**values: object) -> RealtimeSettings:
    return RealtimeSettings.model_validate(
        {"busy_wait": 100.0, "output_offset": 300.0, "collect_garbage": "python"} | values
    )


def punctual_of(world: World, **values: object) -> contextlib.AbstractContextManager[Runtime]:
    return punctual(settings(**values), world.service.axis_loops, world.parts.period_s)


def test_what_was_granted_and_refused_stands_in_the_log_and_in_the_status() -> None:
    async def script(world: World) -> None:
        with punctual_of(world) as runtime:
            assert runtime.report is not None
            assert runtime.report().to_json() == {
                "busy_wait": 100.0, "margin_us": 100.0, "output_offset": 300.0, "output_offset_us": 300.0,
                "granted": {"cpus": "0"},
                "refused": [
                    {
                        "what": "scheduling", "asked": "SCHED_FIFO 40", "why": "the kernel refused it",
                        "remedy": "setcap cap_sys_nice+ep",
                    }
                ],
                "garbage": None,
            }  # fmt: skip

    with structlog.testing.capture_logs() as logs:
        simulate(script)
    assert [line for line in logs if line.get("room") == "realtime"] == [
        {"event": "granted", "log_level": "info", "room": "realtime", "what": "cpus", "granted": "0"},
        {
            "event": "the kernel refused it", "log_level": "warning", "room": "realtime", "what": "scheduling",
            "asked": "SCHED_FIFO 40", "remedy": "setcap cap_sys_nice+ep",
        },
    ]  # fmt: skip


def test_the_loop_gets_the_margin_and_the_offset_that_were_asked_for() -> None:
    async def script(world: World) -> None:
        with punctual_of(world) as runtime:
            assert isinstance(runtime.ticks.margin, FixedMargin)
            assert runtime.ticks.margin_s == pytest.approx(100e-6)
            assert isinstance(runtime.output_offset, FixedOffset)
            assert runtime.output_offset.offset_s == pytest.approx(300e-6)
            assert runtime.idle == ()
        with punctual_of(world, busy_wait="off", output_offset="off") as runtime:
            assert runtime.report is not None
            told = runtime.report()
            assert (told.margin_us, told.output_offset_us) == (0.0, None)

    simulate(script)


def test_the_step_of_each_axis_has_run_before_the_first_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    warmed = []

    def warm_up(step: object) -> None:
        warmed.append(float(step()))  # type: ignore[operator]

    async def script(world: World) -> None:
        monkeypatch.setattr(module, "warm_up", warm_up)
        before = world.axis.effort
        with punctual_of(world):
            assert world.axis.effort == before  # it is another law than the axis'

    simulate(script)
    assert len(warmed) == 1


def test_garbage_is_collected_between_ticks_as_long_as_the_service_is_punctual() -> None:
    async def script(world: World) -> None:
        with punctual(
            settings(collect_garbage="between_ticks"), world.service.axis_loops, world.parts.period_s
        ) as runtime:
            assert not gc.isenabled()
            assert runtime.report is not None
            (idle,) = runtime.idle
            world.loop.listen(lambda tick: idle.open(tick.deadline_s + world.parts.period_s))
            told = runtime.report().to_json()["garbage"]
            assert set(told) == {"collections", "postponed", "longest_us"}
            cycles: list[object] = []
            for _ in range(2000):
                cycle: list[object] = []
                cycle.append(cycle)
                cycles.append(cycle)
            await world.seconds(0.1)
            told = runtime.report().to_json()["garbage"]
            assert told["collections"] >= 1
            assert told["longest_us"] > 0.0
        assert gc.isenabled()

    was_enabled = gc.isenabled()
    try:
        simulate(script)
    finally:
        if not was_enabled:
            gc.disable()


def test_python_collects_at_any_time_where_the_settings_say_so_though_the_start_has_postponed_it() -> None:
    async def script(world: World) -> None:
        with postponed():
            assert not gc.isenabled()
            with punctual_of(world):
                assert gc.isenabled()
        assert gc.isenabled()

    simulate(script)


@pytest.mark.parametrize("driven", [False, True])
def test_the_idle_time_ends_where_the_loop_begins_to_wait_for_the_next_deadline(
    monkeypatch: pytest.MonkeyPatch, *, driven: bool
) -> None:
    asked: list[tuple[float, bool]] = []

    async def script(world: World) -> None:
        if driven:
            await world.armed()
        with punctual(
            settings(collect_garbage="between_ticks"), world.service.axis_loops, world.parts.period_s
        ) as runtime:
            monkeypatch.setattr(
                GarbageCollection,
                "after_tick",
                lambda _, idle_s, *, driven: asked.append((idle_s, driven)),
            )
            (idle,) = runtime.idle
            idle.open(asyncio.get_running_loop().time() + 0.0079)

    simulate(script)
    (idle_s, is_driven) = asked[0]
    assert idle_s == pytest.approx(0.01 - 100e-6 - 0.002)
    assert is_driven is driven
