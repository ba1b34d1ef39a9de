"""From a run to the figures that methods are compared by."""

import itertools
import math
from dataclasses import asdict, dataclass
from statistics import fmean, pstdev
from typing import Any, Final

from twostage_servo.paper.examples import PERIOD_S
from twostage_servo.paper.experiment import Run

SETTLING_SHARE: Final = 1e-3
"""Half width of the settling band, as a share of the move."""
CRUISE_WINDOW_S: Final = (1.5, 3.0)
FINAL_WINDOW_S: Final = 1.0
"""The final error is the mean over this last stretch, so that noise does not decide it."""
ORDINARY_TICKS: Final = 50


@dataclass(frozen=True, slots=True)
class Scores:
    """Figures of one run, in mm, mm/s, V and s, of the true plant but for the velocity's noise.

    Attributes
    ----------
    overshoot
        Largest distance beyond the set-point, at least 0.
    settling_time_s
        When the position enters ±0.1 % of the move for good; None if it does not.
    speed_overshoot
        Largest velocity beyond the cruise velocity before the change-over (in the whole run, for laws without one), at
        least 0.
    velocity_noise_rms
        Standard deviation of the velocity that the law uses, from 1.5 to 3.0 s, whatever the axis does then; None for a
        run that was given up before.
    velocity_error_rms
        Root mean square of the true velocity minus the cruise velocity, in the same window; None likewise.
    cruise_velocity
        Mean of the true velocity from 1.5 to 3.0 s, or to the change-over if that comes first; None if it comes before.
    changeover_effort_step
        Step of the effort into the tick of the change-over. 0 for a law that has no change-over (`changeovers` 0).
    following_effort_step
        Step of the effort out of it, into the next tick. Here the position term acts for the first time.
    ordinary_effort_step
        Largest step of the effort in the half second before the change-over, to compare with.
    final_error
        Mean of position minus set-point over the last second; None for a run that was given up.
    changeovers
        0 or 1.
    diverged
        Whether the run was given up because the plant had run away; the figures then are those until there.
    duration_s
        Length of the run.
    """

    overshoot: float
    settling_time_s: float | None
    speed_overshoot: float
    velocity_noise_rms: float | None
    velocity_error_rms: float | None
    cruise_velocity: float | None
    changeover_effort_step: float
    following_effort_step: float
    ordinary_effort_step: float
    final_error: float | None
    changeovers: int
    diverged: bool
    duration_s: float

    def as_json(self) -> dict[str, Any]:
        """Return the figures by name."""
        return asdict(self)


def score(run: Run) -> Scores:
    """Compute the figures of a run."""
    direction = math.copysign(1.0, run.set_point)
    errors = [position - run.set_point for position in run.position]
    before = run.changeover if run.changeover is not None else len(run.velocity)
    first, last = (round(edge_s / PERIOD_S) for edge_s in CRUISE_WINDOW_S)
    cruise, used = run.velocity[first:last], run.law_velocity[first:last]
    reference = direction * run.reference
    into, out, ordinary = _effort_steps(run)
    whole_window = len(run.velocity) >= last
    return Scores(
        overshoot=max(0.0, *(direction * error for error in errors)),
        settling_time_s=_settling_time_s(errors, SETTLING_SHARE * abs(run.set_point)),
        speed_overshoot=max(0.0, *(direction * velocity - run.reference for velocity in run.velocity[: before + 1])),
        velocity_noise_rms=pstdev(used) if whole_window else None,
        velocity_error_rms=(
            math.sqrt(fmean((velocity - reference) ** 2 for velocity in cruise)) if whole_window else None
        ),
        cruise_velocity=fmean(run.velocity[first : min(last, before)]) if before > first else None,
        changeover_effort_step=into,
        following_effort_step=out,
        ordinary_effort_step=ordinary,
        final_error=None if run.diverged else fmean(errors[-round(FINAL_WINDOW_S / PERIOD_S) :]),
        changeovers=0 if run.changeover is None else 1,
        diverged=run.diverged,
        duration_s=round(PERIOD_S * len(run.position), 9),
    )


def _settling_time_s(errors: list[float], band: float) -> float | None:
    outside = [k for k, error in enumerate(errors) if abs(error) > band]
    entered = outside[-1] + 1 if outside else 0
    return None if entered == len(errors) else round(PERIOD_S * entered, 9)


def _effort_steps(run: Run) -> tuple[float, float, float]:
    """Return the steps of the effort into and out of the tick of the change-over, and the largest before it."""
    steps = [abs(now - before) for before, now in itertools.pairwise(run.effort)]
    at = run.changeover
    if at is None:
        return 0.0, 0.0, max(steps, default=0.0)
    ordinary = steps[max(0, at - 1 - ORDINARY_TICKS) : max(0, at - 1)]
    into, out = (steps[index] if 0 <= index < len(steps) else 0.0 for index in (at - 1, at))
    return into, out, max(ordinary, default=0.0)
