"""The tables of the report, as data; the template makes HTML of them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from twostage_servo.paper.claims import Claim
from twostage_servo.paper.errata import ERRATA
from twostage_servo.paper.examples import EXAMPLES
from twostage_servo.paper.experiment import DIVERGED
from twostage_servo.paper.frames import EXTRA_DELAY_MS, FramesComparison
from twostage_servo.paper.loops import margins_of
from twostage_servo.paper.methods import METHODS
from twostage_servo.paper.scores import Scores
from twostage_servo.paper.studies import LOAD, Comparison, SlipEffect, Studies, steady_error

COLUMNS: Final = (
    ("overshoot", "overshoot (mm)"),
    ("settling_time_s", "settling (s)"),
    ("speed_overshoot", "speed overshoot (mm/s)"),
    ("velocity_noise_rms", "velocity noise (mm/s)"),
    ("velocity_error_rms", "velocity error (mm/s)"),
    ("changeover_effort_step", "effort step (V)"),
    ("following_effort_step", "next step (V)"),
    ("ordinary_effort_step", "ordinary step (V)"),
    ("final_error", "final error (mm)"),
)
"""Figures of the tables: name in the JSON, and heading."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a table: a text, in which indices are set, or something of another kind."""

    text: str
    kind: Literal["text", "number", "code", "name", "holds", "fails", "whole row"] = "text"
    span: int = 1


@dataclass(frozen=True, slots=True)
class Row:
    """One row of a table; ``ours`` stands out."""

    cells: Sequence[Cell]
    ours: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """A table whose first ``texts`` columns hold text and whose others hold numbers."""

    heads: Sequence[str]
    rows: Sequence[Row]
    texts: int = 1


def figure_text(value: float | None, digits: int = 4) -> str:
    """Return a figure to some significant digits, without an exponent where that stays short; None as a dash."""
    if value is None:
        return "-"
    if abs(value) < 5e-7:
        return "0"
    if abs(value) >= 10 ** (digits - 1):
        return f"{value:.0f}"
    return f"{value:.{digits}g}" if abs(value) >= 1e-3 else f"{value:.1e}"


def score_text(figures: Mapping[str, Any], column: str, digits: int = 4) -> str:
    """Return one figure of a run, by its name in the JSON, as the tables show it."""
    value: float | None = figures[column]
    if column == "settling_time_s":
        return "never" if value is None else f"{value:.2f}"
    return figure_text(value, digits)


def claims_table(claims: Iterable[Claim]) -> Table:
    """Return the table of what the paper claims, and whether it holds."""
    rows = [
        Row(
            (
                Cell(claim.claim),
                Cell(claim.measured),
                Cell("holds", "holds") if claim.holds else Cell("does not hold", "fails"),
            )
        )
        for claim in claims
    ]
    return Table(("claim", "measured", "verdict"), rows, texts=3)


def gains_table() -> Table:
    """Return the table of the gains of both examples."""
    rows = []
    for example in EXAMPLES:
        gains = example.gains
        numbers = (gains.f11, gains.f12, gains.f22, example.changeover_distance, *example.kalman.predictor)
        texts = (f"{example.ratio:g}", *(f"{value:.6g}" for value in numbers))
        rows.append(Row((Cell(example.title), *map(_number, texts))))
    heads = ("", "Q/R", "f11 (V/mm)", "f12 (V s/mm)", "f22 (V/mm)", "p (mm)")
    return Table((*heads, "A_o K: position", "velocity (1/s)", "disturbance (V/mm)"), rows)


def margins_table() -> Table:
    """Return the table of the margins of both examples' loops."""
    rows = []
    for example in EXAMPLES:
        for stage, margins in margins_of(example).items():
            delay_ms = 1e3 * margins.delay_margin_s
            numbers = (margins.gain_margin, margins.phase_margin_deg, delay_ms, margins.modulus_margin)
            rows.append(Row((Cell(example.title), Cell(stage), *(_number(figure_text(value)) for value in numbers))))
    heads = ("", "", "gain margin", "phase margin (deg)", "delay margin (ms)", "modulus margin")
    return Table(heads, rows, texts=2)


def methods_table() -> Table:
    """Return the table of the methods."""
    rows = [
        Row(
            (
                Cell(name, "code"),
                Cell(method.title),
                Cell(method.velocity_from),
                Cell("two" if method.two_stage else "one"),
            )
        )
        for name, method in METHODS.items()
    ]
    return Table(("name", "method", "velocity", "stages"), rows, texts=4)


def scores_table(comparison: Comparison) -> Table:
    """Return the table of what each method came to in an example."""
    rows = [
        Row((Cell(METHODS[name].title), *_figures(scores)), ours=name == "proposed")
        for name, scores in comparison.scores.items()
    ]
    return Table(("method", *(heading for _, heading in COLUMNS)), rows)


def _figures(scores: Scores) -> list[Cell]:
    if scores.diverged:
        text = f"runs away: more than {DIVERGED / 1e3:g} m from the set-point after {scores.duration_s:.2f} s"
        return [Cell(text, "whole row", len(COLUMNS))]
    return [_number(score_text(scores.as_json(), name)) for name, _ in COLUMNS]


def loads_table(studies: Studies) -> Table:
    """Return the table of the final error of each method under a constant load."""
    rows = [
        Row(
            (
                Cell(method.title),
                *(_number(figure_text(comparison.scores[name].final_error)) for comparison in studies.under_load),
            ),
            ours=name == "proposed",
        )
        for name, method in METHODS.items()
    ]
    predicted = [_number(f"{steady_error(example, LOAD):+.4f}") for example in EXAMPLES]
    rows.append(Row((Cell("theory, for the conventional law"), *predicted)))
    return Table((f"final error (mm) under {LOAD:g} V", "Example 1", "Example 2"), rows)


def frame_differences_table(frames: Mapping[str, FramesComparison]) -> Table:
    """Return the table of what frames change of a run without noise."""
    rows = []
    for example in EXAMPLES:
        pair = frames[example.name]
        numbers = (
            f"{1e3 * pair.position_difference:.2f}",
            f"{1e3 * pair.effort_difference:.2f}",
            figure_text(1e3 * pair.effort_difference_unexplained),
        )
        rows.append(Row((Cell(example.short_title), *map(_number, numbers))))
    heads = (
        "without noise",
        "positions differ by (µm)",
        "efforts by (mV)",
        "efforts, the law alone rounded alike (mV)",
    )
    return Table(heads, rows)


def frame_scores_table(studies: Studies, frames: Mapping[str, FramesComparison]) -> Table:
    """Return the table of what the law came to behind frames."""
    columns = ("overshoot", "settling_time_s", "speed_overshoot", "final_error")
    rows = []
    for comparison in studies.comparisons:
        pair = frames[comparison.example.name]
        runs = {
            "the law alone": comparison.scores["proposed"].as_json(),
            "over frames": pair.frames,
            f"over frames, {EXTRA_DELAY_MS:g} ms later": pair.delayed,
        }
        for title, figures in runs.items():
            numbers = (score_text(figures, column) for column in columns)
            rows.append(Row((Cell(comparison.example.short_title), Cell(title), *map(_number, numbers))))
    return Table(
        ("", "", "overshoot (mm)", "settling (s)", "speed overshoot (mm/s)", "final error (mm)"), rows, texts=2
    )


def errata_table() -> Table:
    """Return the table of the corrections."""
    rows = [
        Row(
            tuple(
                map(
                    Cell,
                    (str(erratum.number), erratum.where, erratum.printed, erratum.read_as, erratum.why, erratum.effect),
                )
            )
        )
        for erratum in ERRATA
    ]
    return Table(("no.", "where", "printed", "read as", "why", "effect of the print"), rows, texts=6)


def slips_table(slips: Iterable[SlipEffect]) -> Table:
    """Return the table of what each slip of the print changes."""
    corrected: dict[tuple[str, str], Row] = {}
    printed = []
    for slip in slips:
        baseline = slip.erratum.baseline
        name = Cell(slip.example.short_title, "name")
        title = Cell(f"corrected: {METHODS[baseline].title}")
        corrected[baseline, slip.example.name] = Row((title, name, *_figures(slip.corrected)), ours=True)
        if slip.printed is None:
            figures = [Cell(slip.unsolvable or "", "whole row", len(COLUMNS))]
        else:
            figures = _figures(slip.printed)
        printed.append(Row((Cell(f"slip {slip.erratum.number}"), name, *figures)))
    return Table(("", "", *(heading for _, heading in COLUMNS)), [*corrected.values(), *printed], texts=2)


def _number(text: str) -> Cell:
    return Cell(text, "number")
