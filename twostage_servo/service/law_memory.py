"""Keeps what the laws of the axes have learned from one run of the service to the next (``axis.law.memory``)."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, Protocol

import structlog

from twostage_servo.api.fields import JsonObject
from twostage_servo.api.records import JsonRecord
from twostage_servo.control.laws.law import Learned
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.telemetry.learned_files import LearnedFile

if TYPE_CHECKING:
    from twostage_servo.axis.axis import Axis
    from twostage_servo.timing.ticks import Tick

_FORMAT: Final = 1
_HANGS: Final = (
    "the disk does not respond, so that what was learned may be erased or not: see that its file has gone before the "
    "service starts again"
)


class LearnedStore(Protocol):
    """Keeps a document for each axis, and tells what becomes of it; but for reading, it never waits."""

    def exists(self, axis: str) -> bool:
        """Whether there is one, or may be."""

    def read(self, axis: str) -> JsonObject | None:
        """Return it, None if there is none; raise OSError or ValueError if it cannot be read."""

    def write(self, axis: str, document: JsonObject, file: LearnedFile) -> None:
        """Begin to replace it."""

    def erase(self, axis: str, file: LearnedFile) -> None:
        """Begin to erase it."""

    async def settled(self) -> bool:
        """Wait for a short time until what was begun has ended; return whether it has."""


class LearnedPlant(JsonRecord):
    """What a law has learned; see :class:`~twostage_servo.control.laws.law.Learned`."""

    gain: float
    pole: float
    gain_share: float
    pole_share: float
    delay_ticks: int
    delay_evidence: float
    load: list[float | None]
    moves: int
    is_sure: bool


class LearnedDocument(JsonRecord):
    """The same with what it holds for: another plant, tick or unit makes it worthless."""

    format: int
    axis: str
    law: str
    unit: str
    effort_unit: str
    tick_ms: float
    configured_gain: float
    configured_pole: float
    learned: LearnedPlant


class LawMemory:
    """Writes what has been learned when a motion has ended, erases it when a law has to forget, restores it at start.

    Parameters
    ----------
    axis_loops
        The axes.
    store
        Where it is kept.
    """

    def __init__(self, axis_loops: Sequence[AxisLoop], store: LearnedStore) -> None:
        self._store = store
        self._axes = [_AxisMemory(axis_loop, store) for axis_loop in axis_loops]

    @property
    def is_used(self) -> bool:
        """Whether any axis is to keep what it learns."""
        return any(one.is_kept for one in self._axes)

    def restore(self) -> None:
        """Let each law go on with what its axis has learned before; waits for the store, before the first tick."""
        for one in self._axes:
            one.restore()

    def publish(self, _: "Tick") -> None:
        """Look at the axes after a tick."""
        for one in self._axes:
            one.look()

    async def erase(self, axis_loops: Sequence[AxisLoop]) -> None:
        """Erase what is kept of some axes, and wait for it: their laws are about to forget.

        What has become of it stands in `learned_file` of each.
        """
        for one in self._axes:
            if one.axis_loop in axis_loops:
                one.erase()
        if not await self._store.settled():
            for axis_loop in axis_loops:
                axis_loop.learned_file.fail(_HANGS, would_return=True)

    def finish(self) -> None:
        """Keep what has been learned since: the service ends."""
        for one in self._axes:
            one.finish()


class _AxisMemory:
    """What is kept of one axis.

    Attributes
    ----------
    axis_loop
        The axis.
    """

    def __init__(self, axis_loop: AxisLoop, store: LearnedStore) -> None:
        self.axis_loop = axis_loop
        self._store = store
        self._axis = axis_loop.axis
        self._state = self._axis.state
        self._forgotten = self._axis.times_forgotten
        self._kept: Learned | None = None
        self._may_exist = store.exists(axis_loop.name)

    @property
    def is_kept(self) -> bool:
        """Whether the settings want it."""
        return self._axis.settings.law.memory == "file" and self._axis.learned is not None

    def restore(self) -> None:
        """Recall it; one that cannot be used is left out, with a warning."""
        if not self.is_kept:
            return
        try:
            document = self._store.read(self.axis_loop.name)
            if document is None:
                return
            learned = _learned_in(LearnedDocument.from_json(document), self._axis)
            self._axis.recall(learned)
        except (OSError, ValueError, OverflowError) as error:
            text = "what the law had learned is not used: the first move begins with the configured plant"
            structlog.get_logger().warning(text, axis=self.axis_loop.name, error=str(error) or type(error).__name__)
        else:
            self._kept = learned
            text = "the law goes on with what it had learned"
            structlog.get_logger().info(text, axis=self.axis_loop.name, moves=learned.moves)

    def look(self) -> None:
        """Look at the axis after a tick: it costs next to nothing while the state stays the same."""
        axis = self.axis_loop.axis
        if axis is not self._axis:  # of settings that were read again: it begins with what the former one knew
            self._axis, self._forgotten = axis, axis.times_forgotten
        elif axis.times_forgotten != self._forgotten:
            self._forgotten = axis.times_forgotten
            self.erase()
        if axis.state is not self._state:
            self._state = axis.state
            self._keep()

    def finish(self) -> None:
        """Look once more."""
        self.look()
        if self.axis_loop.learned_file.would_return:
            self.erase()
        self._keep()

    def _keep(self) -> None:
        axis, learned = self._axis, self._axis.learned
        if not self.is_kept or learned is None or not learned.moves or learned == self._kept:
            return
        self._kept, self._may_exist = learned, True
        self._store.write(self.axis_loop.name, _document(axis, learned).to_json(), self.axis_loop.learned_file)

    def erase(self) -> None:
        """Erase it also where the settings keep it no more: they may be changed back."""
        self._kept = None
        if self._may_exist or self.axis_loop.learned_file.would_return:
            self._may_exist = False
            self._store.erase(self.axis_loop.name, self.axis_loop.learned_file)


def _document(axis: "Axis", learned: Learned) -> LearnedDocument:
    settings = axis.settings
    return LearnedDocument(
        format=_FORMAT,
        axis=settings.name,
        law=settings.law.type,
        unit=settings.unit,
        effort_unit=settings.effort_unit,
        tick_ms=1e3 * axis.design.period_s,
        configured_gain=settings.plant.gain,
        configured_pole=settings.plant.pole,
        learned=LearnedPlant(
            gain=learned.gain,
            pole=learned.pole,
            gain_share=learned.gain_share,
            pole_share=learned.pole_share,
            delay_ticks=learned.delay_ticks,
            delay_evidence=learned.delay_evidence,
            load=list(learned.load),
            moves=learned.moves,
            is_sure=learned.is_sure,
        ),
    )


def _learned_in(document: LearnedDocument, axis: "Axis") -> Learned:
    """Return what a document says was learned.

    Raises
    ------
    ValueError
        If it holds for something else than this axis as it is configured.
    """
    learned = document.learned
    if len(learned.load) != 2:
        raise ValueError(f"load has {len(learned.load)} values, and must have 2")
    forward, backward = learned.load
    values = vars(learned) | {"load": (forward, backward)}
    found = Learned(**values)
    now = vars(_document(axis, found))
    changed = [
        f"{name} was {then!r:.40} and is {now[name]!r:.40}"
        for name, then in vars(document).items()
        if name != "learned" and then != now[name]
    ]
    if changed:
        raise ValueError("it was learned for something else: " + ", ".join(changed))
    return found
