"""A claim that the runs do not bear out is said not to hold; so `holds` is worth something."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from twostage_servo.control.optimal import ServoGains
from twostage_servo.paper.claims import Claim, check_claims
from twostage_servo.paper.examples import EXAMPLES
from twostage_servo.paper.experiment import simulate
from twostage_servo.paper.frames import FramesComparison
from twostage_servo.paper.methods import METHODS
from twostage_servo.paper.scores import Scores, score
from twostage_servo.paper.studies import Comparison, Curve, Studies, run_all

FRAMES = {
    example.name: FramesComparison(0.001, 0.001, 0.001, 0.001, 0.0, 600, frames={}, delayed={}) for example in EXAMPLES
}


@pytest.fixture(scope="module")
def studies() -> Studies:
    return run_all(lambda _: None)


def broken(claims: list[Claim]) -> list[str]:
    return [claim.claim for claim in claims if not claim.holds]


def changed(comparison: Comparison, method: str, change: Callable[[Scores], Scores]) -> Comparison:
    return replace(comparison, scores={**comparison.scores, method: change(comparison.scores[method])})


def with_curve(studies: Studies, change: Callable[[Curve], Curve]) -> Studies:
    """Both examples, the proposed law's curve over the set-points changed."""
    groups = tuple(
        tuple(change(curve) if curve.name == "proposed" else curve for curve in group) for group in studies.by_set_point
    )
    return replace(studies, by_set_point=groups)


def test_all_hold(studies: Studies) -> None:
    assert broken(check_claims(studies, FRAMES)) == []


@pytest.mark.parametrize(
    ("example", "method", "change", "words"),
    [
        (0, "proposed", lambda s: replace(s, velocity_noise_rms=1.0), "noise"),
        (1, "proposed", lambda s: replace(s, overshoot=1.0), "overshoots"),
        (1, "proposed", lambda s: replace(s, settling_time_s=5.5), "sooner"),
        (1, "proposed", lambda s: replace(s, settling_time_s=None), "sooner"),
        (1, "proposed", lambda s: replace(s, velocity_error_rms=1.0), "cruises"),
        (1, "proposed_as_printed", lambda s: replace(s, velocity_error_rms=1.0), "cruises"),
        (1, "proposed", lambda s: replace(s, changeover_effort_step=0.1), "without a step"),
        (1, "proposed", lambda s: replace(s, following_effort_step=0.1), "without a step"),
        (1, "proposed_as_printed", lambda s: replace(s, changeover_effort_step=0.0), "without a step"),
        (1, "proposed", lambda s: replace(s, velocity_error_rms=None), "cruises"),
    ],
)
def test_a_worse_run_breaks_its_claim_and_no_other(
    studies: Studies, example: int, method: str, change: Callable[[Scores], Scores], words: str
) -> None:
    comparisons = list(studies.comparisons)
    comparisons[example] = changed(comparisons[example], method, change)
    (claim,) = broken(check_claims(replace(studies, comparisons=tuple(comparisons)), FRAMES))
    assert words in claim


@pytest.mark.parametrize(
    ("method", "error", "words"),
    [
        ("conventional_differentiated", 0.0, "keeps an error"),
        ("conventional_model_difference", 0.05, "less than"),
        ("proposed", -0.05, "less than"),
    ],
)
def test_the_errors_under_load_are_looked_at(studies: Studies, method: str, error: float, words: str) -> None:
    under_load = tuple(changed(c, method, lambda s: replace(s, final_error=error)) for c in studies.under_load)
    claims = broken(check_claims(replace(studies, under_load=under_load), FRAMES))
    assert len(claims) == 2
    assert all(words in claim for claim in claims)


def test_an_overshoot_that_grows_with_the_set_point_is_noticed(studies: Studies) -> None:
    growing = with_curve(studies, lambda curve: replace(curve, overshoots=tuple(r / 100.0 for r in curve.set_points)))
    claims = broken(check_claims(growing, FRAMES))
    assert len(claims) == 2
    assert all("set-point" in claim for claim in claims)


@pytest.mark.parametrize("factor", [0.2, 3.0])
def test_a_change_over_at_the_wrong_distance_is_noticed(
    studies: Studies, monkeypatch: pytest.MonkeyPatch, factor: float
) -> None:
    right = ServoGains.changeover_time_s
    monkeypatch.setattr(ServoGains, "changeover_time_s", lambda gains, period_s: factor * right(gains, period_s))
    wrong = score(simulate(METHODS["proposed"].build, EXAMPLES[1]))
    comparisons = (studies.comparisons[0], changed(studies.comparisons[1], "proposed", lambda _: wrong))
    monkeypatch.undo()
    claims = broken(check_claims(replace(studies, comparisons=comparisons), FRAMES))
    assert any("without a step" in claim for claim in claims)


def test_a_comparison_over_frames_that_broke_off_is_noticed(studies: Studies) -> None:
    frames = {name: replace(pair, ticks=100) for name, pair in FRAMES.items()}
    assert len(broken(check_claims(studies, frames))) == 2


def test_a_difference_that_rounding_does_not_explain_is_noticed(studies: Studies) -> None:
    frames = {name: replace(pair, effort_difference_unexplained=1e-6) for name, pair in FRAMES.items()}
    claims = broken(check_claims(studies, frames))
    assert len(claims) == 2
    assert all("frames" in claim for claim in claims)
