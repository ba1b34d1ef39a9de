"""A drive that reports in two frames, read as the page on the drive protocol shows it."""

import re
import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.drives_of_others import node
from tests.service.rig import World, simulate
from twostage_servo.axis.messages import Feedback
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.canbus.identifier import Identifier
from twostage_servo.config.loader import load
from twostage_servo.drives.frame import SentFrame

__all__ = ["node"]

NODE = ("protocol.type=node", "protocol.node=5")
PAGE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text(encoding="utf-8")
STATE_ID = Identifier(0x285, extended=False)


class Sending:
    """Whether the simulated drive sends its state, and in which order the two."""

    state = True
    order = 1


@pytest.fixture
def sending(node: None, monkeypatch: pytest.MonkeyPatch) -> Sending:
    """Let the drive of the example report in two frames."""
    load(None, NODE)  # which imports it
    module, shown = sys.modules["node_drive"], dict[str, Any]()
    (block,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    exec(block, shown)  # noqa: S102 - our own page
    sending = Sending()

    class Drive(module.NodeDrive):  # type: ignore[name-defined,misc]
        def __init__(self, number: int) -> None:
            super().__init__(number)
            reading = shown["TwoFrames"]()
            self.decoders |= {STATE_ID: reading.read_state, self.feedback_id: reading.read_position}

    def feedback(side: Any, report: Feedback) -> Sequence[SentFrame]:
        if not side._runs:
            return ()
        state = struct.pack("<?B", report.enabled, report.fault_code)
        position = struct.pack("<iB", round(1e3 * report.position), (report.counter or 0) % 256)
        frames = SentFrame(STATE_ID, state), SentFrame(side._drive.feedback_id, position)
        return frames[:: sending.order] if sending.state else frames[1:]

    monkeypatch.setattr(module, "NodeDrive", Drive)
    monkeypatch.setattr(module.NodeSide, "feedback", feedback)
    return sending


@pytest.mark.parametrize("order", [1, -1])
def test_it_moves_an_axis(sending: Sending, order: int) -> None:
    sending.order = order

    async def script(world: World) -> None:
        await world.armed()
        world.axis.move_to(50.0, 100.0)
        await world.until(lambda: world.state() is State.HOLDING)
        assert world.drive.position == pytest.approx(50.0, abs=0.1)
        assert world.axis_loop.bus.link.counters.rejected == 0

    simulate(script, *NODE)


def test_its_position_alone_is_no_feedback(sending: Sending) -> None:
    async def script(world: World) -> None:
        await world.armed()
        sending.state = False
        await world.until(lambda: world.state() is State.TRIPPED)
        assert world.axis.trip is not None
        assert world.axis.trip.code is TripCode.STALE_FEEDBACK

    simulate(script, *NODE)
