"""What the law learns of its plant: within a move, and from one move to the next.

Two fits run while a move from rest accelerates, one for each delay (:mod:`.identification`). Every tick the likelier
one gives the model. What the whole acceleration has shown is kept for the next move if it fits and lies within bounds;
otherwise the last believed model comes back.
"""

from typing import Final, NamedTuple

from twostage_servo.control.laws.adaptive.identification import Fit, Prior, widened
from twostage_servo.control.laws.adaptive.rules import LearningRules
from twostage_servo.control.plant import Plant

GAIN_BOUNDS: Final = (0.6, 1.65)
POLE_BOUNDS: Final = (0.5, 1.65)
"""Between which multiples of what is configured an identified gain and pole may lie."""
BEYOND_BOUNDS: Final = 1.5
"""Standard deviations by which a fit may lie beyond them and still be believed, at the bound."""


class Estimate(NamedTuple):
    """What the likelier fit says, forward from where the move began, at the last sample."""

    position: float
    velocity: float
    load: float
    plant: Plant
    is_late: bool


_UNKNOWN_SHARE: Final = 0.8
_FIRST_SURPRISE: Final = 6
_FEWEST_TICKS: Final = 5


class Learning:
    """Keeps what is known of the plant."""

    def __init__(self, configured: Plant, rules: LearningRules, period_s: float, effort_limit: float) -> None:
        self.rules = rules
        self.configured = configured
        self._period_s = period_s
        self._effort_limit = effort_limit
        self.forget()

    def forget(self) -> None:
        """Know nothing but what is configured."""
        share = self.rules.prior_share
        self.believed = self.configured
        self._shares = (share, share)
        self.loads: dict[float, float] = {}
        self.is_known = False
        self.is_late = False
        self.moves = 0
        self._delay_evidence = 0.0
        self._fits = self._new_fits(0.0, 1.0, self.rules.prior_load)
        self.active = False
        self._ticks = self._surprises = 0

    @property
    def is_new(self) -> bool:
        """Whether a plant is being identified of which no more is known than what is configured."""
        return self.active and self._shares[0] >= _UNKNOWN_SHARE * self.rules.prior_share

    def begin(self, direction: float, load: float, spread: float) -> None:
        """Begin to look at a move from rest; `load` (effort unit) is what seems to act against it."""
        rules = self.rules
        self._direction = direction
        self._fits = self._new_fits(load, spread, rules.known_load if direction in self.loads else rules.prior_load)
        self.active = True
        self._ticks, self._surprises = -1, 0

    def _new_fits(self, load: float, spread: float, load_share: float) -> tuple[Fit, Fit]:
        """Return a fit for an effort that acts in time, and one for an effort that acts a tick later."""
        gain_share, pole_share = self._shares
        load_spread = load_share * self._effort_limit
        prior = Prior(self.believed.gain, self.believed.pole, load, gain_share, pole_share, load_spread)
        return Fit(prior, spread, self._period_s), Fit(prior, spread, self._period_s)

    def update(self, sample: float | None, effort: float, before: float) -> Estimate | None:
        """Take a tick: the sample, forward from the start, and the efforts u(k-1) and u(k-2), forward.

        Returns the estimate to go on with; None where the observer is to be believed.
        """
        soon, late = self._fits
        self._ticks += 1
        ticks = self._ticks
        if ticks < 2:
            return None
        soon.update(sample, effort)
        if ticks == 2:
            if sample is not None:
                late.begin_late(sample)
        else:
            late.update(sample, before)
        surprised = ticks >= _FIRST_SURPRISE and min(soon.surprise, late.surprise) > self.rules.surprise
        self._surprises = self._surprises + 1 if surprised else 0
        if self._surprises or ticks < 3:
            return None
        gap = late.evidence - soon.evidence
        if self.moves == 0:
            self.is_late = gap + self.rules.delay_evidence < 0.0
        else:
            self.is_late = self._delay_evidence + gap < 0.0
        fit = late if self.is_late else soon
        return Estimate(fit.position, fit.velocity, fit.load, self._bounded(fit), self.is_late)

    @property
    def is_sure(self) -> bool:
        """Whether the likelier fit knows the gain, and which one is likelier."""
        gap = abs(self._fits[1].evidence - self._fits[0].evidence)
        fit, rules = self._fits[self.is_late], self.rules
        return (
            fit.gain_share < rules.known_share
            and fit.pole_share < rules.known_share
            and (self.moves > 0 or gap >= rules.delay_gap)
        )

    @property
    def contradicted(self) -> bool:
        """Whether neither fit explains the samples: something else acts."""
        return self._surprises >= 2

    def give_up(self) -> bool:
        """End without keeping anything; return whether the model of this move is known well enough to go on with."""
        self.active, self._surprises = False, 0
        fit = self._fits[self.is_late]
        if self._ticks >= self.rules.early_ticks and fit.gain_share < self.rules.early_share:
            self.is_known = True
            return True
        return False

    def finish(self) -> bool:
        """End, and keep what has been found; return whether it is believed."""
        self.active = False
        if self._ticks < _FEWEST_TICKS:
            return False
        fit, rules = self._fits[self.is_late], self.rules
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
        if gain_share < rules.sure_share and (self.moves > 0 or abs(gap) >= rules.delay_gap):
            self.is_known = True
        self.believed = plant
        self._shares = (
            widened(gain_share, rules.prior_share),
            widened(pole_spread / plant.pole, rules.prior_share),
        )
        self.loads[self._direction] = fit.load
        self._delay_evidence = min(max(self._delay_evidence + gap, -200.0), 200.0)
        self.moves += 1
        return True

    def _bounded(self, fit: Fit) -> Plant:
        configured = self.configured
        return Plant(
            _within(fit.gain / configured.gain, GAIN_BOUNDS) * configured.gain,
            _within(fit.pole / configured.pole, POLE_BOUNDS) * configured.pole,
        )


def _within(value: float, bounds: tuple[float, float]) -> float:
    return min(max(value, bounds[0]), bounds[1])
