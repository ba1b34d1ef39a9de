"""One HTML file that holds everything: claims, tables, figures, equations and corrections."""

import math
import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any, Final

from latex2mathml.converter import convert

from twostage_servo import __version__
from twostage_servo.paper.claims import Claim
from twostage_servo.paper.equations import PASSAGES, Equation
from twostage_servo.paper.errata import ERRATA
from twostage_servo.paper.examples import EXAMPLES, PERIOD_S, SET_POINT, VELOCITY
from twostage_servo.paper.experiment import DIVERGED, DURATION_S, SEED
from twostage_servo.paper.frames import EXTRA_DELAY_MS, FramesComparison
from twostage_servo.paper.loops import margins_of
from twostage_servo.paper.methods import CONVENTIONAL, METHODS
from twostage_servo.paper.plots import Picture
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


def render(
    studies: Studies, claims: Sequence[Claim], frames: Mapping[str, FramesComparison], pictures: Sequence[Picture]
) -> str:
    """Return the report: the template with numbers, tables and figures in their places.

    Parameters
    ----------
    studies
        All runs.
    claims
        What holds.
    frames
        What the frames change, by the example's name.
    pictures
        Every figure; its name is its place in the template.
    """
    quanta = frames[EXAMPLES[0].name]
    second = studies.comparisons[1].scores
    late1, late2 = (example.gains.f22 * VELOCITY * PERIOD_S / 8.0 for example in EXAMPLES)
    difference = studies.difference_without_sensor[1]
    places = {
        "version": escape(__version__),
        "duration": f"{DURATION_S:g}",
        "seed": str(SEED),
        "period": f"{1e3 * PERIOD_S:g}",
        "set_point": f"{SET_POINT:g}",
        "velocity": f"{VELOCITY:g}",
        "noise_variance": f"{EXAMPLES[0].noise_variance:g}",
        "noise_gain": f"{math.sqrt(2.0) / PERIOD_S:.0f}",
        "proposed_speed": f"{second['proposed'].speed_overshoot:.0f}",
        "conventional_speed": f"{second[CONVENTIONAL].speed_overshoot:.0f}",
        "sensor_speed": f"{second['conventional_two_output'].speed_overshoot:.0f}",
        "nominal_speed": f"{studies.nominal_speed_overshoot:.0f}",
        "difference_overshoot": figure_text(difference.overshoot, 1),
        "difference_settling": score_text(difference.as_json(), "settling_time_s"),
        "swing": f"{studies.speed_stage_swing_hz:.0f}",
        "short_overshoot": f"{_overshoot_at(studies, 50.0):.2f}",
        "late1": f"{late1:.1g}",
        "late2": f"{late2:.1g}",
        "load": f"{LOAD:g}",
        "printed_cruise": figure_text(second["proposed_as_printed"].cruise_velocity),
        "printed_load_error": figure_text(studies.under_load[0].scores["proposed_as_printed"].velocity_error_rms, 3),
        "position_quantum": f"{quanta.position_quantum:g}",
        "effort_quantum": f"{quanta.effort_quantum:g}",
        "claims": _claims(claims),
        "gains": _gains(),
        "margins": _margins(),
        "methods": _methods(),
        "scores1": _scores(studies.comparisons[0]),
        "scores2": _scores(studies.comparisons[1]),
        "loads": _loads(studies),
        "frame_differences": _frame_differences(frames),
        "frame_scores": _frame_scores(studies, frames),
        "errata": _errata(),
        "slips": _slips(studies.slips),
        "equations": _equations(),
        **{picture.name: _picture(picture) for picture in pictures},
    }
    template = files("twostage_servo.paper").joinpath("report_template.html").read_text("utf-8")
    return Template(template).substitute(places)


def _overshoot_at(studies: Studies, set_point: float) -> float:
    """Return the proposed law's overshoot in Example 2 at one of the set-points of the study, in mm."""
    curve = next(curve for curve in studies.by_set_point[1] if curve.name == "proposed")
    return curve.overshoots[curve.set_points.index(set_point)]


def _claims(claims: Iterable[Claim]) -> str:
    rows = (
        _row(
            _cell(claim.claim),
            _cell(claim.measured),
            '<td class="holds">holds</td>' if claim.holds else '<td class="fails">does not hold</td>',
        )
        for claim in claims
    )
    return _table(("claim", "measured", "verdict"), rows, texts=3)


def _gains() -> str:
    rows = []
    for example in EXAMPLES:
        gains = example.gains
        numbers = (gains.f11, gains.f12, gains.f22, example.changeover_distance, *example.kalman.predictor)
        rows.append(
            _row(_cell(example.title), _number(f"{example.ratio:g}"), *(_number(f"{value:.6g}") for value in numbers))
        )
    heads = ("", "Q/R", "f11 (V/mm)", "f12 (V s/mm)", "f22 (V/mm)", "p (mm)")
    return _table((*heads, "A_o K: position", "velocity (1/s)", "disturbance (V/mm)"), rows)


def _margins() -> str:
    rows = [
        _row(
            _cell(example.title),
            _cell(stage),
            _number(figure_text(margins.gain_margin)),
            _number(figure_text(margins.phase_margin_deg)),
            _number(figure_text(1e3 * margins.delay_margin_s)),
            _number(figure_text(margins.modulus_margin)),
        )
        for example in EXAMPLES
        for stage, margins in margins_of(example).items()
    ]
    heads = ("", "", "gain margin", "phase margin (deg)", "delay margin (ms)", "modulus margin")
    return _table(heads, rows, texts=2)


def _methods() -> str:
    rows = (
        _row(
            f"<td><code>{escape(name)}</code></td>",
            _cell(method.title),
            _cell(method.velocity_from),
            _cell("two" if method.two_stage else "one"),
        )
        for name, method in METHODS.items()
    )
    return _table(("name", "method", "velocity", "stages"), rows, texts=4)


def _scores(comparison: Comparison) -> str:
    rows = (
        _row(_cell(METHODS[name].title), *_figures(scores), ours=name == "proposed")
        for name, scores in comparison.scores.items()
    )
    return _table(("method", *(heading for _, heading in COLUMNS)), rows)


def _figures(scores: Scores) -> list[str]:
    if scores.diverged:
        text = f"runs away: more than {DIVERGED / 1e3:g} m from the set-point after {scores.duration_s:.2f} s"
        return [f'<td colspan="{len(COLUMNS)}">{text}</td>']
    return [_number(score_text(scores.as_json(), name)) for name, _ in COLUMNS]


def _loads(studies: Studies) -> str:
    rows = [
        _row(
            _cell(method.title),
            *(_number(figure_text(comparison.scores[name].final_error)) for comparison in studies.under_load),
            ours=name == "proposed",
        )
        for name, method in METHODS.items()
    ]
    predicted = (_number(f"{steady_error(example, LOAD):+.4f}") for example in EXAMPLES)
    rows.append(_row(_cell("theory, for the conventional law"), *predicted))
    return _table((f"final error (mm) under {LOAD:g} V", "Example 1", "Example 2"), rows)


def _frame_differences(frames: Mapping[str, FramesComparison]) -> str:
    rows = (
        _row(
            _cell(example.short_title),
            _number(f"{1e3 * frames[example.name].position_difference:.2f}"),
            _number(f"{1e3 * frames[example.name].effort_difference:.2f}"),
            _number(figure_text(1e3 * frames[example.name].effort_difference_unexplained)),
        )
        for example in EXAMPLES
    )
    heads = (
        "without noise",
        "positions differ by (µm)",
        "efforts by (mV)",
        "efforts, the law alone rounded alike (mV)",
    )
    return _table(heads, rows)


def _frame_scores(studies: Studies, frames: Mapping[str, FramesComparison]) -> str:
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
            rows.append(_row(_cell(comparison.example.short_title), _cell(title), *map(_number, numbers)))
    return _table(
        ("", "", "overshoot (mm)", "settling (s)", "speed overshoot (mm/s)", "final error (mm)"), rows, texts=2
    )


def _errata() -> str:
    rows = (
        _row(
            *map(
                _cell,
                (str(erratum.number), erratum.where, erratum.printed, erratum.read_as, erratum.why, erratum.effect),
            )
        )
        for erratum in ERRATA
    )
    return _table(("no.", "where", "printed", "read as", "why", "effect of the print"), rows, texts=6)


def _slips(slips: Iterable[SlipEffect]) -> str:
    corrected: dict[tuple[str, str], str] = {}
    printed = []
    for slip in slips:
        baseline = slip.erratum.baseline
        name = f'<td class="name">{escape(slip.example.short_title)}</td>'
        title = _cell(f"corrected: {METHODS[baseline].title}")
        corrected[baseline, slip.example.name] = _row(title, name, *_figures(slip.corrected), ours=True)
        if slip.printed is None:
            figures = [f'<td colspan="{len(COLUMNS)}">{escape(slip.unsolvable or "")}</td>']
        else:
            figures = _figures(slip.printed)
        printed.append(_row(_cell(f"slip {slip.erratum.number}"), name, *figures))
    return _table(("", "", *(heading for _, heading in COLUMNS)), [*corrected.values(), *printed], texts=2)


def _equations() -> str:
    parts = []
    for passage in PASSAGES:
        parts.append(f"<h3>{escape(passage.title)}</h3>\n<p>{_typeset(passage.text)}</p>\n")
        parts.extend(_equation(equation) for equation in passage.equations)
    return "".join(parts)


def _equation(equation: Equation) -> str:
    source = f"({equation.tag})"
    if equation.errata:
        numbers = ", ".join(str(number) for number in equation.errata)
        source += f", {'erratum' if len(equation.errata) == 1 else 'errata'} {numbers}"
    mathematics = convert(equation.latex, display="block")
    return f'<div class="equation"><div>{mathematics}</div><div class="note">{source}</div></div>\n'


def _picture(picture: Picture) -> str:
    caption = escape(picture.caption)
    data = b64encode(picture.svg).decode("ascii")
    image = f'<img src="data:image/svg+xml;base64,{data}" alt="">'  # the caption says what it shows
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _table(heads: Sequence[str], rows: Iterable[str], *, texts: int = 1) -> str:
    """Return a table whose first `texts` columns hold text and whose others hold numbers."""
    head = "".join(_head(text, number=index >= texts) for index, text in enumerate(heads))
    body = "\n".join(rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def _head(text: str, *, number: bool) -> str:
    if not text:
        return "<td></td>"
    kind = ' class="number"' if number else ""
    return f'<th scope="col"{kind}>{_typeset(text)}</th>'


def _row(*cells: str, ours: bool = False) -> str:
    kind = ' class="ours"' if ours else ""
    return f"<tr{kind}>{''.join(cells)}</tr>"


def _cell(text: str) -> str:
    return f"<td>{_typeset(text)}</td>"


def _typeset(text: str) -> str:
    """Escape a text, and set the index of a symbol such as x_o1 below its letter."""
    return re.sub(r"(?<![A-Za-z0-9_])([A-Za-z])_([A-Za-z0-9]+)", r"\1<sub>\2</sub>", escape(text))


def _number(text: str) -> str:
    return f'<td class="number">{escape(text)}</td>'
