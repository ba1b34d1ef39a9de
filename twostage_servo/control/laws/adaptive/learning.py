"""What the law learns of its plant: within a move, and from one move to the next.

Two fits run while a move from rest accelerates, one for each delay (:mod:`.identification`). Every tick the likelier
one gives the model. A third, for a delay of two ticks, only tells such an axis from one of another form. What the whole
acceleration has shown is kept for the next move if it fits and lies within bounds; otherwise the last believed model
comes back (:mod:`.acceptance`). Where no plant of the configured form fits, the next moves are controlled as if nothing
had been identified, and only watched, until one fits again (:mod:`.trust`).
"""

from math import copysign
from typing import Final, NamedTuple

from twostage_servo.control.laws.adaptive.acceptance import (
    beyond_bounds,
    bounded,
    cautious,
    poor_fit,
    rejection,
    unexplained,
    within,
)
from twostage_servo.control.laws.adaptive.identification import Acted, Fit, Prior, widened
from twostage_servo.control.laws.adaptive.rules import LearningRules
from twostage_servo.control.laws.adaptive.trust import Trust
from twostage_servo.control.laws.law import Learned
from twostage_servo.control.laws.rejection import Rejection
from twostage_servo.control.plant import Plant

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
    is_late
        Whether an effort acts a tick later, as far as is known.
    moves
        How many moves it has learned from.
    active
        Whether a move is being looked at.
    trust
        Whether the moves' fits are to be believed, and why the last one was not.
    only_watches
        Whether the move is looked at without being controlled by what it shows: no plant has fitted the one before.
    """

    __slots__ = (
        "_before", "_configured", "_delay_evidence", "_direction", "_effort_limit", "_fits", "_later", "_likelier",
        "_period_s", "_poor_fit", "_rules", "_shares", "_surprises", "_ticks", "_was_known", "_was_late", "active",
        "believed", "is_late", "loads", "moves", "only_watches", "trust",
    )  # fmt: skip

    def __init__(self, configured: Plant, rules: LearningRules, period_s: float, effort_limit: float) -> None:
        self._rules = rules
        self._configured = configured
        self._period_s = period_s
        self._effort_limit = effort_limit
        self.trust = Trust(rules.form_samples)
        self.active = False
        self.forget()

    def forget(self) -> None:
        """Know nothing but what is configured, and why the last fit was rejected: caution outlasts what was learned."""
        if self.active:
            self.give_up()
        self.trust.forget()
        share = self._rules.prior_share
        self.believed = self._configured
        self._shares = (share, share)
        self.loads: dict[float, float] = {}
        self._was_known = False
        self.is_late = self._likelier = self._was_late = False
        self.only_watches = False
        self._poor_fit: Rejection | None = None
        self.moves = 0
        self._delay_evidence = 0.0
        self._fits, self._later = self._new_fits(0.0, 1.0), self._new_fits(0.0, 1.0)[0]
        self._before = Acted(0.0)
        self._direction = 1.0
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
            rejection=self.trust.rejection,
        )

    @property
    def is_known(self) -> bool:
        """Whether a plant has been found that is known well, and nothing has spoken against it since."""
        return self._was_known and not self.trust.is_degraded

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
        self._was_known = learned.is_sure
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
        self._fits, self._later = self._new_fits(load, spread), self._new_fits(load, spread)[0]
        self.active = True
        self.only_watches = self.trust.only_watches
        self._likelier = self._was_late = self.is_late
        self._poor_fit = None
        self._ticks, self._surprises = -1, 0

    def _new_fits(self, load: float, spread: float) -> tuple[Fit, Fit]:
        """Return a fit for an effort that acts in time, and one for an effort that acts a tick later."""
        gain_share, pole_share = self._shares
        load_spread = self._rules.prior_load * self._effort_limit
        prior = Prior(self.believed.gain, self.believed.pole, load, gain_share, pole_share, load_spread)
        return Fit(prior, spread, self._period_s), Fit(prior, spread, self._period_s)

    def update(self, sample: float | None, effort: Acted, before: Acted, date_error_s: float = 0.0) -> Found | None:
        """Take a tick, all of it counted in the direction of the move.

        Parameters
        ----------
        sample
            The measured position from where the move began, in axis unit; None where it is lost.
        effort, before
            What has acted since the efforts u(k-1) and u(k-2).
        date_error_s
            By how much the date of the sample may be off, in s.

        Returns
        -------
        Found or None
            What to go on with; None where the observer is to be believed.
        """
        soon, late = self._fits
        self._ticks += 1
        ticks = self._ticks
        if ticks < _TICKS_UNTIL_ACTED:
            self._before = before
            return None
        soon.update(sample, effort, date_error_s)
        if ticks == _TICKS_UNTIL_ACTED:
            if sample is not None:
                late.begin_late(sample)
        else:
            late.update(sample, before, date_error_s)
            if ticks > _TICKS_UNTIL_ACTED + 1:
                self._later.update(sample, self._before, date_error_s)
        self._before = before
        least = min(soon.surprise, late.surprise) if self._rules.finds_delay else soon.surprise
        surprised = ticks >= _FIRST_SURPRISE and least > self._rules.surprise
        self._surprises = self._surprises + 1 if surprised else 0
        if self._surprises or ticks <= _TICKS_UNTIL_ACTED:
            return None
        gap = late.evidence - soon.evidence
        known = self._rules.delay_evidence if self.moves == 0 else self._delay_evidence
        self._likelier = self._rules.finds_delay and known + gap < 0.0
        self._poor_fit = self._poor_fit or poor_fit((soon, late, self._later), self._rules)
        if self.only_watches or self.contradicted:
            return None
        self.is_late = self._likelier
        fit = self._likelier_fit
        plant = bounded(fit, self._configured)
        return Found(fit.position, fit.velocity, fit.load, cautious(plant, self._configured) if self.is_new else plant)

    @property
    def _likelier_fit(self) -> Fit:
        return self._fits[self._likelier]

    @property
    def is_sure(self) -> bool:
        """Whether the likelier fit knows the gain, and which one is likelier."""
        gap = abs(self._fits[1].evidence - self._fits[0].evidence)
        fit, rules = self._likelier_fit, self._rules
        return fit.gain_share < rules.known_share and fit.pole_share < rules.known_share and self._knows_delay(gap)

    def _knows_delay(self, gap: float) -> bool:
        """Whether it is known which delay is right, by a difference of the evidence of a move or by former ones."""
        return not self._rules.finds_delay or self.moves > 0 or gap >= self._rules.delay_gap

    @property
    def contradicted(self) -> bool:
        """Whether the move is not to be controlled by what it shows: something else acts, or it is nonsense.

        A poor fit that is near the configured plant is still the best that there is in this move.
        """
        if self._surprises >= _SURPRISES:
            return True
        return self._poor_fit is not None and self._beyond_bounds() is not None

    def _beyond_bounds(self) -> Rejection | None:
        return beyond_bounds(self._likelier_fit, self._configured, self._rules)

    def give_up(self) -> bool:
        """End without keeping anything; return whether the model of this move is known well enough to go on with."""
        fit, rules = self._likelier_fit, self._rules
        rejection = self._poor_fit
        if self._surprises >= _SURPRISES:
            # A plant that has been good for so long has been disturbed.
            is_early = min(fit.samples for fit in self._fits) < 2 * rules.residual_samples
            if rejection is None and self._later.surprise > rules.surprise and (is_early or self._beyond_bounds()):
                rejection = unexplained()
        elif rejection is None and fit.samples >= rules.residual_samples:
            rejection = self._beyond_bounds()
        is_good = rejection is None or not rejection.degrades
        if rejection is not None and rejection.degrades and self.trust.counts(rejection):
            self._reject(rejection)
        self.active, self._surprises, self._poor_fit = False, 0, None
        return is_good and self._ticks >= rules.early_ticks and fit.gain_share < rules.early_share

    def _reject(self, why: Rejection) -> None:
        self.trust.reject(why, self._likelier_fit.samples, watched=self.only_watches)
        if why.is_of_the_form:
            self.is_late = self._was_late  # what looks like a delay is the form

    def finish(self) -> bool:
        """End, and keep what has been found; return whether it is believed."""
        self.active = False
        if self._ticks < _FEWEST_TICKS:
            return False
        fit, rules = self._likelier_fit, self._rules
        why, poor = rejection(fit, self._configured, rules), self._poor_fit
        if poor is not None and self.trust.counts(poor):
            why = poor
        if why is not None:
            self._reject(why)
            return False
        if not self.trust.accept(watched=self.only_watches):
            return False
        plant = bounded(fit, self._configured)
        gain_share, pole_share = (
            share * value / kept
            for share, value, kept in (
                (fit.gain_share, abs(fit.gain), abs(plant.gain)),
                (fit.pole_share, fit.pole, plant.pole),
            )
        )
        gap = self._fits[1].evidence - self._fits[0].evidence
        if gain_share < rules.sure_share and self._knows_delay(abs(gap)):
            self._was_known = True
        self.believed = plant
        self.is_late = self._likelier
        self._shares = widened(gain_share, rules.prior_share), widened(pole_share, rules.prior_share)
        self.loads[self._direction] = fit.load
        gap = gap if rules.finds_delay else 0.0
        self._delay_evidence = within(self._delay_evidence + gap, (-MOST_DELAY_EVIDENCE, MOST_DELAY_EVIDENCE))
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
        return sign * within(sign * ends, (0.0, most))
