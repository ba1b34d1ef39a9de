"""What the law learns of its plant: within a move, and from one move to the next.

Two fits run while a move from rest accelerates, one for each delay (:mod:`.identification`). Every tick the likelier
one gives the model. What the whole acceleration has shown is kept for the next move if it fits and lies within bounds;
otherwise the last believed model comes back.
"""

from math import copysign
from typing import Final, NamedTuple

from twostage_servo.control.laws.adaptive.identification import Fit, Prior, widened
from twostage_servo.control.laws.adaptive.rules import LearningRules
from twostage_servo.control.laws.law import Learned
from twostage_servo.control.plant import Plant

GAIN_BOUNDS: Final = (0.6, 1.65)
POLE_BOUNDS: Final = (0.5, 1.65)
"""Between which multiples of what is configured an identified gain and pole may lie."""

BEYOND_BOUNDS: Final = 1.5
"""Standard deviations by which a fit may lie beyond them and still be believed, at the bound."""

_UNKNOWN_SHARE: Final = 0.8
"""Share of the spread that is configured from which a plant counts as unknown still."""

_TICKS_UNTIL_ACTED: Final = 2
"""Ticks of a move until its first sample after an effort has acted in time; a late one takes a tick more."""

_FIRST_SURPRISE: Final = 6
"""Tick of a move from which a surprise counts: before, a fit goes by its prior most of all."""

_SURPRISES: Final = 2
"""Surprises in a row that end identification: one may be a bad sample."""

_FEWEST_TICKS: Final = 5
"""Ticks of a move below which nothing of it is kept."""

MOST_DELAY_EVIDENCE: Final = 200.0
"""Bound of the evidence for one delay that moves add up: so that a delay that has changed is found in a few moves."""


class Found(NamedTuple):
    """What the likelier fit says at the last sample, counted forward from where the move began.

    Attributes
    ----------
    position, velocity
        In axis unit and axis unit/s.
    load
        What acts against the move, friction included, in effort unit.
    plant
        Gain and pole, within their bounds.
    """

    position: float
    velocity: float
    load: float
    plant: Plant


class Learning:
    """Identifies the plant in each move, and keeps what is known of it.

    Parameters
    ----------
    configured
        The plant as it is configured.
    rules
        When a fit is believed.
    period_s
        The tick, in s.
    effort_limit
        Largest magnitude of the effort, in effort unit: the prior's loads are shares of it.

    Attributes
    ----------
    believed
        The plant to go by at the start of a move.
    loads
        What acted against the last move in each direction (1 or -1), friction included, in effort unit.
    is_known
        Whether a plant has been found that is known well.
    is_late
        Whether an effort acts a tick later, as far as is known.
    moves
        How many moves it has learned from.
    active
        Whether a move is being looked at.
    """

    __slots__ = (
        "_configured", "_delay_evidence", "_direction", "_effort_limit", "_fits", "_period_s", "_rules", "_shares",
        "_surprises", "_ticks", "active", "believed", "is_known", "is_late", "loads", "moves",
    )  # fmt: skip

    def __init__(self, configured: Plant, rules: LearningRules, period_s: float, effort_limit: float) -> None:
        self._rules = rules
        self._configured = configured
        self._period_s = period_s
        self._effort_limit = effort_limit
        self.forget()

    def forget(self) -> None:
        """Know nothing but what is configured."""
        share = self._rules.prior_share
        self.believed = self._configured
        self._shares = (share, share)
        self.loads: dict[float, float] = {}
        self.is_known = False
        self.is_late = False
        self.moves = 0
        self._delay_evidence = 0.0
        self._fits = self._new_fits(0.0, 1.0)
        self._direction = 1.0
        self.active = False
        self._ticks = self._surprises = 0

    @property
    def learned(self) -> Learned:
        """What is known by now."""
        gain_share, pole_share = self._shares
        return Learned(
            gain=self.believed.gain,
            pole=self.believed.pole,
            gain_share=gain_share,
            pole_share=pole_share,
            delay_ticks=int(self.is_late),
            delay_evidence=self._delay_evidence,
            load=(self.loads.get(1.0), self.loads.get(-1.0)),
            moves=self.moves,
            is_sure=self.is_known,
        )

    @property
    def identified(self) -> Plant | None:
        """The plant that is known, the same object until another is; None while none is."""
        return self.believed if self.is_known else None

    def recall(self, learned: Learned) -> None:
        """Know what has been learned before, which has been checked."""
        self.forget()
        self.believed = Plant(learned.gain, learned.pole)
        self._shares = learned.gain_share, learned.pole_share
        forward, backward = learned.load
        self.loads = {sign: load for sign, load in ((1.0, forward), (-1.0, backward)) if load is not None}
        self.is_known = learned.is_sure
        self.is_late = learned.delay_ticks > 0
        self.moves = learned.moves
        self._delay_evidence = learned.delay_evidence

    @property
    def is_new(self) -> bool:
        """Whether a plant is being identified of which no more is known than what is configured."""
        return self.active and self._shares[0] >= _UNKNOWN_SHARE * self._rules.prior_share

    def begin(self, direction: float, load: float, spread: float) -> None:
        """Begin to look at a move from rest.

        Parameters
        ----------
        direction
            1 or -1.
        load
            What is held against the move at rest, in effort unit.
        spread
            Standard deviation of a sample, in axis unit.
        """
        self._direction = direction
        self._fits = self._new_fits(load, spread)
        self.active = True
        self._ticks, self._surprises = -1, 0

    def _new_fits(self, load: float, spread: float) -> tuple[Fit, Fit]:
        """Return a fit for an effort that acts in time, and one for an effort that acts a tick later."""
        gain_share, pole_share = self._shares
        load_spread = self._rules.prior_load * self._effort_limit
        prior = Prior(self.believed.gain, self.believed.pole, load, gain_share, pole_share, load_spread)
        return Fit(prior, spread, self._period_s), Fit(prior, spread, self._period_s)

    def update(self, sample: float | None, effort: float, before: float) -> Found | None:
        """Take a tick, all of it counted in the direction of the move.

        Parameters
        ----------
        sample
            The measured position from where the move began, in axis unit; None where it is lost.
        effort, before
            The efforts u(k-1) and u(k-2), in effort unit.

        Returns
        -------
        Found or None
            What to go on with; None where the observer is to be believed.
        """
        soon, late = self._fits
        self._ticks += 1
        ticks = self._ticks
        if ticks < _TICKS_UNTIL_ACTED:
            return None
        soon.update(sample, effort)
        if ticks == _TICKS_UNTIL_ACTED:
            if sample is not None:
                late.begin_late(sample)
        else:
            late.update(sample, before)
        least = min(soon.surprise, late.surprise) if self._rules.finds_delay else soon.surprise
        surprised = ticks >= _FIRST_SURPRISE and least > self._rules.surprise
        self._surprises = self._surprises + 1 if surprised else 0
        if self._surprises or ticks <= _TICKS_UNTIL_ACTED:
            return None
        gap = late.evidence - soon.evidence
        if not self._rules.finds_delay:
            self.is_late = False
        elif self.moves == 0:
            self.is_late = gap + self._rules.delay_evidence < 0.0
        else:
            self.is_late = self._delay_evidence + gap < 0.0
        fit = late if self.is_late else soon
        return Found(fit.position, fit.velocity, fit.load, self._bounded(fit))

    @property
    def is_sure(self) -> bool:
        """Whether the likelier fit knows the gain, and which one is likelier."""
        gap = abs(self._fits[1].evidence - self._fits[0].evidence)
        fit, rules = self._fits[self.is_late], self._rules
        return fit.gain_share < rules.known_share and fit.pole_share < rules.known_share and self._knows_delay(gap)

    def _knows_delay(self, gap: float) -> bool:
        """Whether it is known which delay is right, by a difference of the evidence of a move or by former ones."""
        return not self._rules.finds_delay or self.moves > 0 or gap >= self._rules.delay_gap

    @property
    def contradicted(self) -> bool:
        """Whether neither fit explains the samples: something else acts."""
        return self._surprises >= _SURPRISES

    def give_up(self) -> bool:
        """End without keeping anything; return whether the model of this move is known well enough to go on with."""
        self.active, self._surprises = False, 0
        fit = self._fits[self.is_late]
        return self._ticks >= self._rules.early_ticks and fit.gain_share < self._rules.early_share

    def finish(self) -> bool:
        """End, and keep what has been found; return whether it is believed."""
        self.active = False
        if self._ticks < _FEWEST_TICKS:
            return False
        fit, rules = self._fits[self.is_late], self._rules
        plant = self._bounded(fit)
        gain_spread, pole_spread = abs(fit.gain) * fit.gain_share, fit.pole * fit.pole_share
        if (
            abs(plant.gain - fit.gain) > BEYOND_BOUNDS * gain_spread
            or abs(plant.pole - fit.pole) > BEYOND_BOUNDS * pole_spread
            or fit.misfit > rules.misfit * fit.samples
        ):
            return False
        gap = self._fits[1].evidence - self._fits[0].evidence
        gain_share = gain_spread / abs(plant.gain)
        if gain_share < rules.sure_share and self._knows_delay(abs(gap)):
            self.is_known = True
        self.believed = plant
        self._shares = (
            widened(gain_share, rules.prior_share),
            widened(pole_spread / plant.pole, rules.prior_share),
        )
        self.loads[self._direction] = fit.load
        gap = gap if rules.finds_delay else 0.0
        self._delay_evidence = _within(self._delay_evidence + gap, (-MOST_DELAY_EVIDENCE, MOST_DELAY_EVIDENCE))
        self.moves += 1
        return True

    def friction(self, at_rest: float, most: float) -> float:
        """Return how much of the load of the last move ends with the move, in effort unit; it never drives an axis.

        Friction does, and what the fit took for a load that goes with the speed. Both are in the loads of either
        direction alike, while what is held at rest has another sign there: so half of their sum is what ends. Where
        moves in one direction alone are known, it is what the load exceeds that which was held at rest.

        Parameters
        ----------
        at_rest
            What was held against the move before it, in effort unit.
        most
            Its largest magnitude, in effort unit.
        """
        load, opposite = self.loads[self._direction], self.loads.get(-self._direction)
        ends, sign = load - at_rest if opposite is None else 0.5 * (load + opposite), copysign(1.0, self.believed.gain)
        return sign * _within(sign * ends, (0.0, most))

    def _bounded(self, fit: Fit) -> Plant:
        configured = self._configured
        return Plant(
            _within(fit.gain / configured.gain, GAIN_BOUNDS) * configured.gain,
            _within(fit.pole / configured.pole, POLE_BOUNDS) * configured.pole,
        )


def _within(value: float, bounds: tuple[float, float]) -> float:
    return min(max(value, bounds[0]), bounds[1])
