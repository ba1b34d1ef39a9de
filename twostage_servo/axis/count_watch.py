"""Watches whether an encoder goes on counting from where it was last seen, above all after it was silent for a while.

A drive that was switched off and on counts anew, and its encoder may then show any count. Three things tell it:

1. The count has moved by more than ``axis.limits.overspeed`` allows in the time.
2. After a long silence, the count has moved by more than the axis coasts. A hand may have pushed it as well, unseen.
3. After a long silence nothing proves that the drive is still the one that it was. A boot counter does.

The last two concern axes that were homed: where positions are the encoder's own count, it is taken for one that keeps
its count. A silence is long when an armed axis trips by it in any case.

The time between two samples is that between their dates. The first sample after a suspension of the service may answer
the last command before it, and is then as old as that: the time until the next one includes the suspension.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from twostage_servo.axis.design import AxisDesign

_SAMPLES_BEYOND = 2
"""Samples in a row that are a count which has moved: one is a spike."""

_JITTER_TICKS = 1
"""Ticks by which the time between two samples may be longer than it seems."""


@dataclass(slots=True)
class CountHistory:
    """What has been seen of the count: all of it goes on when the settings change.

    Attributes
    ----------
    range_s
        For how long the axis may go on at `speed` without being seen, in s.
    place
        The last sample that was believed, in axis unit; None before the first.
    place_age_s
        How old it was when it was read, in s.
    ticks
        Ticks since it was read.
    age_s
        How old the last sample was when it was read, in s.
    silent_ticks
        Ticks since it was read.
    longest_silence
        The longest time without a sample since the one that was believed, in ticks.
    beyond
        Samples in a row, up to now, that are too far away.
    speed
        Largest speed that the axis may have had at the sample that was believed, in axis unit/s.
    awaits_proof
        Whether only the drive's next heartbeat will say whether it is still the one that it was.
    """

    range_s: float
    place: float | None = None
    place_age_s: float = 0.0
    ticks: int = 0
    age_s: float = 0.0
    silent_ticks: int = 0
    longest_silence: int = 0
    beyond: int = 0
    speed: float = 0.0
    awaits_proof: bool = False


class CountWatch:
    """Looks, once a tick, at what the encoder shows; see the module's text.

    Parameters
    ----------
    design
        The axis.
    resolution
        Step in which the encoder's position is reported, in axis unit; 0 if it has none.
    distance
        Returns how far it is from one position to another, in axis unit, the shorter way round a counter that wraps.

    Attributes
    ----------
    known
        What it has seen so far.
    """

    __slots__ = ("_design", "_distance", "_driven_s", "_long_silence", "_tolerance", "known")

    def __init__(self, design: AxisDesign, resolution: float, distance: Callable[[float, float], float]) -> None:
        settings = design.settings
        self._design = design
        self._distance = distance
        self._tolerance = design.sample_tolerance(resolution)
        self._long_silence = design.ticks(settings.limits.stale_feedback_ms) + settings.limits.missed_ticks
        self._driven_s = 1e-3 * settings.arming_timeout_ms
        self.known = CountHistory(range_s=design.coasting_s)

    def update(
        self,
        missed: int,
        position: float | None,
        speed: float,
        *,
        driven: bool,
        homed: bool,
        counts_boots: bool,
        age_s: float | None = None,
    ) -> str | None:
        """Check a tick.

        Parameters
        ----------
        missed
            Ticks that were missed just before it.
        position
            This tick's sample in axis unit; None if there is none.
        speed
            Largest speed that the axis has, or is commanded to have, in axis unit/s.
        driven
            Whether the drive may be enabled, so that it goes on with its last effort when the bus is lost.
        homed
            Whether positions count from a place that was found or told.
        counts_boots
            Whether the drive has a boot counter, and has told it before.
        age_s
            How long before the tick the sample was taken, in s; None: as long as the one before it.

        Returns
        -------
        str or None
            Why the place of the axis is no longer known, if something shows that in this tick.
        """
        known = self.known
        known.ticks += 1 + missed
        known.silent_ticks += 1 + missed
        reason = self._check_silence(homed=homed, counts_boots=counts_boots)
        if position is None:
            return reason
        age_s = known.age_s if age_s is None else age_s
        silence = known.silent_ticks + self._ticks_older(known.age_s, age_s)
        known.longest_silence = max(known.longest_silence, silence)
        ticks = known.ticks + self._ticks_older(known.place_age_s, age_s)
        reason = self._check_count(position, ticks, homed=homed) or reason
        if not known.beyond:
            self._believe(position, ticks, age_s, speed, driven=driven)
        known.silent_ticks, known.age_s = 0, age_s
        return reason

    def restart(self) -> None:
        """Begin afresh: the drive says that it has booted."""
        self.known.place = None
        self.known.beyond = 0
        self.known.awaits_proof = False

    def confirm_count(self) -> None:
        """Accept an unchanged boot count as proof that the drive still counts; in a silence it proves nothing yet."""
        if self.known.silent_ticks == 0:
            self.known.awaits_proof = False

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        if self.known.place is not None:
            self.known.place += distance

    def continue_from(self, former: "CountWatch") -> None:
        """Continue from the state of a former one on the same encoder."""
        self.known = replace(former.known)

    def _check_silence(self, *, homed: bool, counts_boots: bool) -> str | None:
        known = self.known
        if known.place is None or known.silent_ticks <= self._long_silence or not homed or known.awaits_proof:
            return None
        if counts_boots:
            known.awaits_proof = True
            return None
        return (
            f"no feedback came for {self._ms(known.silent_ticks)} ms, more than the {self._ms(self._long_silence)} ms "
            "of axis.limits.stale_feedback_ms plus missed_ticks: the drive may have been switched off and on and have "
            "lost its count, and has no boot counter to prove otherwise"
        )

    def _ticks_older(self, before_s: float, now_s: float) -> int:
        """Return by how many ticks a sample before was older than the one of now; 0 where it was younger.

        Of two samples such as these the time between them is less, and that of the ticks is allowed for.
        """
        return max(0, round((before_s - now_s) / self._design.period_s))

    def _check_count(self, position: float, ticks: int, *, homed: bool) -> str | None:
        """Check a sample that was taken so many ticks after the one that was believed."""
        known = self.known
        if known.place is None:
            return None
        moved = self._distance(known.place, position)
        unseen_s = (ticks + _JITTER_TICKS) * self._design.period_s
        allowed, by = unseen_s * self._design.settings.limits.overspeed, "axis.limits.overspeed allows"
        if homed and known.longest_silence > self._long_silence and known.speed * known.range_s < allowed:
            allowed, by = known.speed * known.range_s, "a coasting axis can move"
        allowed += self._tolerance
        known.beyond = known.beyond + 1 if abs(moved) > allowed else 0
        if known.beyond < _SAMPLES_BEYOND:
            return None
        known.beyond = 0
        unit = self._design.settings.unit
        return (
            f"the encoder's count moved by {moved:+.4g} {unit} within {self._ms(ticks)} ms (longest silence: "
            f"{self._ms(known.longest_silence)} ms), more than the {allowed:.4g} {unit} that {by}: the drive may have "
            "been switched off and on and have lost its count, or the axis was moved unobserved"
        )

    def _believe(self, position: float, ticks: int, age_s: float, speed: float, *, driven: bool) -> None:
        known, range_s, shown = self.known, self._design.coasting_s + (self._driven_s if driven else 0.0), 0.0
        if known.place is not None:
            shown = abs(self._distance(known.place, position)) / (ticks * self._design.period_s)
        speed = min(max(speed, shown), self._design.settings.limits.overspeed)
        if self._ticks_older(age_s, known.place_age_s):  # it was taken long before the speed that is known now
            speed = max(speed, known.speed)
        known.place, known.place_age_s, known.speed, known.range_s = position, age_s, speed, range_s
        known.ticks = known.longest_silence = 0

    def _ms(self, ticks: int) -> str:
        return f"{1e3 * self._design.period_s * ticks:g}"
