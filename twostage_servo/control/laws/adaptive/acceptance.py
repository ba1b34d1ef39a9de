"""Whether what a move has shown is accepted as the plant, and why not.

Least squares always finds a gain and a pole, on a plant of another form as well. What tells is what is left: of samples
with independent errors the residual is distributed as chi-square with as many degrees of freedom as there are samples
more than it takes, so its mean is 1 for each (Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to
Tracking and Navigation*, 2001, section 5.4). The bound is wider, since a healthy axis has friction, a load and a
quantum as well; docs/adaptive-law.md has what healthy axes and those of another form leave.
"""

from collections.abc import Sequence
from typing import Final

from twostage_servo.control.laws.adaptive.identification import Fit
from twostage_servo.control.laws.adaptive.rules import LearningRules
from twostage_servo.control.laws.rejection import Rejection, RejectionCode
from twostage_servo.control.plant import MODEL_ERROR, Plant

GAIN_BOUNDS: Final = (0.6, 1.65)
POLE_BOUNDS: Final = (0.5, 1.65)
"""Between which multiples of what is configured an identified gain and pole may lie."""

BEYOND_BOUNDS: Final = 1.5
"""Standard deviations by which a fit may lie beyond them and still be believed, at the bound."""


def within(value: float, bounds: tuple[float, float]) -> float:
    """Return the value, or the bound that it is beyond."""
    return min(max(value, bounds[0]), bounds[1])


def bounded(fit: Fit, configured: Plant) -> Plant:
    """Return gain and pole of a fit, within their bounds."""
    return Plant(
        within(fit.gain / configured.gain, GAIN_BOUNDS) * configured.gain,
        within(fit.pole / configured.pole, POLE_BOUNDS) * configured.pole,
    )


def cautious(plant: Plant, configured: Plant) -> Plant:
    """Return a plant that answers the effort by no less than one that is as far off its model as it may be.

    A first move on what seems to answer by less would be pushed by as much more; but it may be an encoder that shows
    half of the way, and then the axis has gone twice as far until that is certain.
    """
    gain = configured.gain * max(plant.gain / configured.gain, 1.0 - MODEL_ERROR)
    return Plant(gain, plant.pole)


def unexplained() -> Rejection:
    """Return that of a move which no fit explains from one sample to the next."""
    return Rejection(
        RejectionCode.UNEXPLAINED_MOTION,
        "two consecutive positions were far from those of every plant that fits the ones before: the axis has met "
        "something, or it is no plant of the configured form (a resonance, backlash, a coupling that slips)",
        degrades=True,
    )


def poor_fit(fits: Sequence[Fit], rules: LearningRules) -> Rejection | None:
    """Return why no fit is that of a plant of the configured form; None where one is, or too little is seen."""
    if min(fit.samples for fit in fits) < rules.residual_samples:
        return None
    mosts = [rules.first_residual + rules.residual * fit.freedom for fit in fits]
    # The misfit is never less than the residual, and costs nothing.
    if any(fit.misfit <= most or fit.residual <= most for fit, most in zip(fits, mosts, strict=True)):
        return None
    fit, most = min(zip(fits, mosts, strict=True), key=lambda pair: pair[0].residual - pair[1])
    return Rejection(
        RejectionCode.FIT_RESIDUAL,
        f"{fit.samples} positions leave a residual of {fit.residual:.3g} of their variances from the plant that fits "
        f"them best, and may leave {most:.3g}: it is no plant of the configured form (a resonance, backlash, a "
        "coupling that slips), or something disturbed the move",
        degrades=True,
    )


def beyond_bounds(fit: Fit, configured: Plant, rules: LearningRules) -> Rejection | None:
    """Return which of gain and pole is known to lie beyond its bounds; None if neither is."""
    for code, name, value, share, known, bounds in (
        (RejectionCode.GAIN_OUT_OF_BOUNDS, "gain", fit.gain, fit.gain_share, configured.gain, GAIN_BOUNDS),
        (RejectionCode.POLE_OUT_OF_BOUNDS, "pole", fit.pole, fit.pole_share, configured.pole, POLE_BOUNDS),
    ):
        multiple, spread = value / known, abs(value / known) * share
        bound = within(multiple, bounds)
        if abs(multiple - bound) > BEYOND_BOUNDS * spread:
            low, high = bounds
            return Rejection(
                code,
                f"the {name} of the plant is {multiple:.3g} ± {spread:.2g} times axis.plant.{name}, and may be {low:g} "
                f"to {high:g} times that: set axis.plant.{name} to what the axis has",
                degrades=not low / rules.far <= multiple <= high * rules.far,
            )
    return None


def rejection(fit: Fit, configured: Plant, rules: LearningRules) -> Rejection | None:
    """Return why a plant that fits is not accepted at the end of a move; None if it is."""
    if (found := beyond_bounds(fit, configured, rules)) is not None:
        return found
    if fit.misfit > rules.misfit * fit.samples:
        return Rejection(
            RejectionCode.FAR_FROM_EXPECTED,
            f"{fit.samples} positions were {fit.misfit / fit.samples:.3g} variances off what was expected of each, and "
            f"may be {rules.misfit:g}: the plant is too far from what was known of it",
            degrades=False,
        )
    return None
