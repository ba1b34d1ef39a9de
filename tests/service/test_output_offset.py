import asyncio
import itertools

import pytest

from tests.host_loop import HostLoop
from tests.service.rig import BUS
from twostage_servo.app.build import build_parts, build_service
from twostage_servo.config.loader import load
from twostage_servo.service.runtime import Runtime
from twostage_servo.simulation.bus import Wire
from twostage_servo.timing.output_offset import FixedOffset
from twostage_servo.timing.ticks import Ticks

WORK_S = [20e-6, 90e-6, 40e-6, 250e-6, 10e-6, 60e-6]
"""What the arithmetic of a tick takes, tick by tick."""


def sent_after_s(offset: FixedOffset | None) -> list[float]:
    """How long after the deadlines of the ticks the commands left, on a host whose arithmetic takes its time."""

    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, HostLoop)
        wire = Wire(loop.time)
        sent_s: dict[int, float] = {}
        due_s: dict[int, float] = {}

        def note_frame(tick_index: int, direction: str, _identifier: int, _data: bytes) -> None:
            assert direction == "sent"
            sent_s.setdefault(tick_index, loop.time())

        parts = build_parts(load(None), BUS, lambda _: wire.attach("service"), (note_frame,))
        axis_loop = parts.axis_loop()
        runtime = Runtime(Ticks(parts.period_s), offset)
        service = build_service(
            parts, runtime, lambda _: {}, publishers=(lambda tick: due_s.update({tick.index: tick.deadline_s}),)
        )
        work, decide = itertools.cycle(WORK_S), axis_loop.update

        def update() -> None:
            decide()
            loop.work(next(work))

        axis_loop.update = update  # type: ignore[method-assign]
        loop.call_later((len(WORK_S) + 2) * service.ticks.period_s, service.shut_down)
        await service.run()
        assert (service.statistics.duration["hold"].largest_us > 0.0) is (offset is not None)
        return [sent - due_s[tick] for tick, sent in sent_s.items()]

    with asyncio.Runner(loop_factory=HostLoop) as runner:
        return runner.run(main())


def test_commands_leave_as_soon_as_they_are_ready_without_an_offset() -> None:
    after_s = sent_after_s(None)
    assert len(after_s) >= len(WORK_S)
    assert max(after_s) - min(after_s) == pytest.approx(max(WORK_S) - min(WORK_S), abs=2e-6)


def test_commands_leave_at_the_offset_and_only_what_is_not_ready_leaves_later() -> None:
    after_s = sent_after_s(FixedOffset(120e-6, 0.01))
    late = [one for one in after_s if one > 125e-6]
    assert len(after_s) >= len(WORK_S)
    assert 1 <= len(late) <= 2
    assert min(late) > 250e-6
    punctual = [one for one in after_s if one not in late]
    assert punctual == pytest.approx([120e-6] * len(punctual), abs=2e-6)
