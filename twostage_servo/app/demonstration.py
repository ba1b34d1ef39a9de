"""One run of the demo: the real service and the real drive node on the virtual bus, and the true plant watched."""

import asyncio
import hashlib
import itertools
import math
import struct
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from twostage_servo.api.fields import JsonObject
from twostage_servo.app.closed_loop import ClosedLoop, closed_loop
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import MOVING, State
from twostage_servo.canbus.link import BusSettings
from twostage_servo.config.loader import Config, LoadedConfig
from twostage_servo.host.settings import RealtimeSettings
from twostage_servo.service.snapshot import law_status
from twostage_servo.telemetry.sample import FIELDS, Sample
from twostage_servo.timing.ticks import Tick

_READY_S = 3.0
"""Longest wait for the first feedback, and for arming."""
_SETTLING_S = 15.0
"""What a move may take beyond its cruise before it counts as failed."""
_HOLD_S = 1.0
"""How long the demo lets the axis hold before it looks at the final error."""
_ORDINARY_TICKS = 50
"""Ticks before the change-over whose largest change of effort counts as the ordinary one."""
_OPERATING = MOVING | {State.HOLDING}


class TracedTick(NamedTuple):
    """One tick of the demo: the loop's view, and the true plant's state."""

    sample: Sample
    changeovers: int
    true_position: float
    true_velocity: float


_NAMES: Final = {
    "position": "estimated_position",
    "velocity": "estimated_velocity",
    "disturbance": "estimated_disturbance",
}
"""What columns of a tick are called in a trace, where the true ones stand beside them."""
_LEADING: Final = (
    "time_s", "state", "changeovers", "true_position", "true_velocity", "measured_position", "estimated_position",
    "estimated_velocity", "estimated_disturbance", "effort", "speed_reference", "following_error",
)  # fmt: skip
_OF_SAMPLE: Final = tuple(_NAMES.get(name, name) for name in FIELDS)
TRACE_FIELDS: Final = (*_LEADING, *(name for name in _OF_SAMPLE if name not in _LEADING))
"""The columns of a trace: all of a tick, and the true plant's."""


def trace_row(tick: TracedTick) -> list[Any]:
    """Return the row of a trace, in the order of :data:`TRACE_FIELDS`."""
    values = dict(zip(_OF_SAMPLE, tick.sample, strict=True)) | tick._asdict()
    return [values[name] for name in TRACE_FIELDS]


_FIGURES: Final = ("final_error", "overshoot", "settling_band", "settling_time_s", "peak_velocity", "changeover")
"""What is told of a move."""


class _Move(NamedTuple):
    """A move as the demo ran it."""

    start_s: float
    start: float
    target: float


class FrameHash:
    """The hash of all frames that the service sends and receives, each with its tick."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def observe(self, tick_index: int, direction: str, identifier: int, data: bytes) -> None:
        """Add a frame to the hash."""
        self._hash.update(struct.pack("<q?IB", tick_index, direction == "sent", identifier, len(data)) + data)

    def hexdigest(self) -> str:
        """Return the hash."""
        return self._hash.hexdigest()


async def demonstrate(
    loaded: LoadedConfig[Config],
    target: float,
    velocity: float,
    progress: Callable[[float, TracedTick], None] | None = None,
    realtime: RealtimeSettings | None = None,
    moves: int = 1,
) -> "Demonstration":
    """Run the whole demo on the running loop.

    Parameters
    ----------
    loaded
        The configuration of the axis.
    target, velocity
        The move, in axis unit and axis unit/s.
    progress
        Called now and then, with the share of the way that lies behind the axis, and the newest sample.
    realtime
        Makes the service punctual on its host; None in simulated time.
    moves
        How many, alternately to the target and back.

    Raises
    ------
    ConfigError
        If no service can be built from the configuration.
    """
    bus = BusSettings(interface="virtual", channel="twostage-servo-demo").with_frames_of(loaded.config.bus)
    frames = FrameHash()
    async with closed_loop(loaded, bus=bus, realtime=realtime, observers=(frames.observe,)) as loop:
        demonstration = Demonstration(loop, loaded.config, frames, (target, velocity, moves), progress)
        loop.listen(demonstration.on_tick)
        await demonstration.run()
    loop.serving.result()  # which raises a defect of the service
    return demonstration


class Demonstration:
    """One run: what it asks of the axis, and the bookkeeping of the true plant. Made by :func:`demonstrate`.

    Attributes
    ----------
    samples
        Each tick.
    failure
        Why the move was not carried out; None if it was.
    refused
        What the axis has refused, or None.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        config: Config,
        frames: FrameHash,
        asked: tuple[float, float, int],
        progress: Callable[[float, TracedTick], None] | None,
    ) -> None:
        self.samples: list[TracedTick] = []
        self.failure: str | None = None
        self.refused: Refused | None = None
        self._loop = loop
        self._config = config
        self._frames = frames
        self._target, self._velocity, self._count = asked
        self._progress = progress
        self._axis_loop = loop.axis_loop()
        self._drive = loop.axes[self._axis_loop.name].drive
        self._waiting: tuple[Callable[[], bool], asyncio.Future[bool], float] | None = None
        self._moves: list[_Move] = []

    @property
    def traits(self) -> DriveTraits:
        """What is known of the drive beforehand, such as the quanta of its signals."""
        return self._axis_loop.drive.traits

    async def run(self) -> None:
        """Arm, and make the moves that were asked for; end early if the service has ended by itself."""
        operating = asyncio.ensure_future(self._operate())
        try:
            await asyncio.wait((operating, self._loop.serving), return_when=asyncio.FIRST_COMPLETED)
            if operating.done():
                operating.result()
        except Refused as refused:
            self.refused = refused
        finally:
            operating.cancel()

    async def _operate(self) -> None:
        axis = self._axis_loop.axis
        await self._until(lambda: axis.ready_to_arm, _READY_S)
        try:
            axis.arm()
        except Refused as refused:
            self.failure = f"the axis cannot be armed: {refused}"
            return
        if not await self._until(lambda: axis.state is State.HOLDING or axis.trip is not None, _READY_S) or axis.trip:
            self.failure = "the axis did not arm" + (f": {axis.trip.cause}" if axis.trip else "")
            return
        home = self._drive.position
        for number in range(self._count):
            await self._run_move(home if number % 2 else self._target)
            if self.failure is not None:
                return

    async def _run_move(self, target: float) -> None:
        """Move, and hold for a second."""
        axis = self._axis_loop.axis
        asked = axis.move_to(target, self._velocity)
        move = _Move(self.samples[-1].sample.time_s, self._drive.position, target)
        self._moves.append(move)
        expected_s = abs(target - move.start) / self._velocity + _SETTLING_S
        if not await self._until(lambda: asked.outcome is not MoveOutcome.MOVING, expected_s):
            self.failure = (
                f"the axis was not within {self._config.axis.window.position:g} {self._config.axis.unit} of "
                f"the set-point after {expected_s:.1f} s"
            )
        elif asked.outcome is MoveOutcome.REACHED:
            await self._until(lambda: axis.trip is not None, _HOLD_S)
        if axis.trip is not None:
            self.failure = f"the axis tripped: {axis.trip.cause}"

    async def _until(self, condition: Callable[[], bool], longest_s: float) -> bool:
        """Wait, tick by tick, until a condition holds; return whether it does."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[bool] = loop.create_future()
        self._waiting = (condition, future, loop.time() + longest_s)
        return await future

    def on_tick(self, tick: Tick) -> None:
        """Keep a sample, and look whether what is waited for has come."""
        axis, sample = self._axis_loop.axis, self._axis_loop.sample
        assert sample is not None  # noqa: S101 - the tick has been recorded
        self.samples.append(TracedTick(sample, axis.changeovers, self._drive.position, self._drive.velocity))
        if tick.index % 5 == 0:
            self._show(self.samples[-1])
        if self._waiting is not None:
            condition, future, deadline_s = self._waiting
            if not future.done() and (condition() or tick.deadline_s >= deadline_s):
                future.set_result(condition())

    def _show(self, sample: TracedTick) -> None:
        if self._progress is None or not self._moves:
            return
        move = self._moves[-1]
        length = move.target - move.start
        share = (sample.true_position - move.start) / length if length else 1.0
        self._progress(share, sample)

    def result(self) -> JsonObject:
        """Return the contract's JSON object."""
        statistics, trip = self._loop.parts.statistics, self._axis_loop.axis.trip
        scores = [self._score(index) for index in range(len(self._moves))]
        law = law_status(self._axis_loop.axis).to_json()
        return {
            "target": self._target,
            **(scores[0] if scores else dict.fromkeys(_FIGURES)),
            "ticks": {
                "count": statistics.count,
                "missed": statistics.missed,
                "lateness_us": statistics.lateness.summary(),
            },
            "frames": {
                name: getattr(self._axis_loop.bus.link.counters, name) for name in ("received", "sent", "rejected")
            },
            "trip": None if trip is None else {"code": trip.code, "cause": trip.cause, "next_action": trip.next_action},
            "failure": self.failure,
            "law": {name: value for name, value in law.items() if name != "file_error"},  # it keeps no file
            "moves": [{"target": move.target, **score} for move, score in zip(self._moves, scores, strict=True)],
            "trace_sha256": self._frames.hexdigest(),
        }

    def _score(self, index: int) -> JsonObject:
        move = self._moves[index]
        start_s, start, target = move
        end_s = self._moves[index + 1].start_s if index + 1 < len(self._moves) else math.inf
        samples = [s for s in self.samples if start_s <= s.sample.time_s < end_s and s.sample.state in _OPERATING]
        direction = 1.0 if target >= start else -1.0
        window = max(1e-3 * abs(target - start), self._config.axis.window.position)
        outside = [index for index, s in enumerate(samples) if abs(s.true_position - target) > window]
        if not outside:
            settling_s: float | None = 0.0
        elif outside[-1] + 1 < len(samples):
            settling_s = samples[outside[-1] + 1].sample.time_s - start_s
        else:
            settling_s = None
        return {
            "final_error": samples[-1].true_position - target,
            "overshoot": max(0.0, *(direction * (s.true_position - target) for s in samples)),
            "settling_band": window,
            "settling_time_s": settling_s if settling_s is None else round(settling_s, 6),
            "peak_velocity": max(abs(s.true_velocity) for s in samples),
            "changeover": self._changeover(move, samples),
        }

    def _changeover(self, move: _Move, samples: list[TracedTick]) -> dict[str, float] | None:
        steps = [
            abs(self._sent(now.sample.effort) - self._sent(before.sample.effort))
            for before, now in itertools.pairwise(samples)
        ]
        for index, (before, now) in enumerate(itertools.pairwise(samples)):
            if now.changeovers > before.changeovers:
                return {
                    "time_s": round(now.sample.time_s - move.start_s, 6),
                    "distance": abs(move.target - now.true_position),
                    "effort_step": steps[index],
                    "ordinary_effort_step": max(steps[max(0, index - _ORDINARY_TICKS) : index], default=0.0),
                }
        return None

    def _sent(self, effort: float) -> float:
        quantum = self.traits.effort_quantum
        return round(effort / quantum) * quantum if quantum else effort
