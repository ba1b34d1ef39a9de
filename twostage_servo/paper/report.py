"""One HTML file that holds everything: claims, tables, figures, equations and corrections."""

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
from twostage_servo.paper.examples import EXAMPLES
from twostage_servo.paper.experiment import DIVERGED, DURATION_S, SEED
from twostage_servo.paper.frames import EXTRA_DELAY_MS, FramesComparison
from twostage_servo.paper.methods import METHODS
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
    ("final_error", "final error (mm)"),
)
"""Figures of the tables: name in the JSON, and heading."""


def figure_text(value: float | None) -> str:
    """Return a figure to four significant digits, without an exponent where that stays short."""
    if value is None:
        return "never"
    if abs(value) < 5e-7:
        return "0"
    return f"{value:.4g}" if 1e-3 <= abs(value) < 1e4 else f"{value:.1e}"


def score_text(scores: Scores, column: str) -> str:
    """Return one figure of :data:`COLUMNS` as the tables show it."""
    value: float | None = getattr(scores, column)
    return f"{value:.2f}" if column == "settling_time_s" and value is not None else figure_text(value)


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
    places = {
        "version": escape(__version__),
        "duration": f"{DURATION_S:g}",
        "seed": str(SEED),
        "load": f"{LOAD:g}",
        "printed_cruise": f"{studies.comparisons[1].scores['proposed_as_printed'].cruise_velocity:.1f}",
        "printed_load_error": f"{studies.under_load[0].scores['proposed_as_printed'].velocity_error_rms:.1f}",
        "position_quantum": f"{quanta.position_quantum:g}",
        "effort_quantum": f"{quanta.effort_quantum:g}",
        "claims": _claims(claims),
        "gains": _gains(),
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


def _claims(claims: Iterable[Claim]) -> str:
    rows = (
        _row(
            _cell(claim.claim),
            _cell(claim.measured),
            '<td class="holds">holds</td>' if claim.holds else '<td class="fails">does not hold</td>',
        )
        for claim in claims
    )
    return _table(("claim", "measured", ""), rows)


def _gains() -> str:
    rows = []
    for example in EXAMPLES:
        gains = example.gains
        numbers = (gains.f11, gains.f12, gains.f22, example.changeover_distance, *example.kalman.predictor)
        rows.append(
            _row(_cell(example.title), _number(f"{example.ratio:g}"), *(_number(f"{value:.6g}") for value in numbers))
        )
    heads = ("", "Q/R", "f11 (V/mm)", "f12 (V s/mm)", "f22 (V/mm)", "p (mm)")
    return _table((*heads, "A_o K: position", "velocity (1/s)", "load (V/mm)"), rows)


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
    return _table(("name", "method", "velocity", "stages"), rows)


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
    return [_number(score_text(scores, name)) for name, _ in COLUMNS]


def _loads(studies: Studies) -> str:
    rows = [
        _row(
            _cell(method.title),
            *(_number(f"{comparison.scores[name].final_error:+.4f}") for comparison in studies.under_load),
            ours=name == "proposed",
        )
        for name, method in METHODS.items()
    ]
    predicted = (_number(f"{steady_error(example, LOAD):+.4f}") for example in EXAMPLES)
    rows.append(_row(_cell("-f11 v_m T_s / f22: what theory says of the conventional law"), *predicted))
    return _table((f"final error (mm) under {LOAD:g} V", "Example 1", "Example 2"), rows)


def _frame_differences(frames: Mapping[str, FramesComparison]) -> str:
    rows = (
        _row(
            _cell(example.short_title),
            _number(f"{1e3 * frames[example.name].position_difference:.2f}"),
            _number(f"{1e3 * frames[example.name].effort_difference:.2f}"),
            _number(figure_text(1e3 * frames[example.name].effort_difference_explained)),
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
    rows = []
    for comparison in studies.comparisons:
        pair = frames[comparison.example.name]
        runs: dict[str, dict[str, Any]] = {
            "the law alone": comparison.scores["proposed"].as_json(),
            "over frames": pair.frames,
            f"over frames, {EXTRA_DELAY_MS:g} ms later": pair.delayed,
        }
        for title, figures in runs.items():
            numbers = (figure_text(figures[key]) for key in ("overshoot", "settling_time_s", "final_error"))
            rows.append(_row(_cell(comparison.example.short_title), _cell(title), *map(_number, numbers)))
    return _table(("", "", "overshoot (mm)", "settling (s)", "final error (mm)"), rows)


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
    return _table(("no.", "where", "printed", "read as", "why", "effect of the print"), rows)


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
    return _table(("", "", *(heading for _, heading in COLUMNS)), [*corrected.values(), *printed])


def _equations() -> str:
    parts = []
    for passage in PASSAGES:
        parts.append(f"<h3>{escape(passage.title)}</h3>\n<p>{escape(passage.text)}</p>\n")
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
    image = f'<img src="data:image/svg+xml;base64,{data}" alt="{caption}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _table(heads: Iterable[str], rows: Iterable[str]) -> str:
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "\n".join(rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def _row(*cells: str, ours: bool = False) -> str:
    kind = ' class="ours"' if ours else ""
    return f"<tr{kind}>{''.join(cells)}</tr>"


def _cell(text: str) -> str:
    return f"<td>{escape(text)}</td>"


def _number(text: str) -> str:
    return f'<td class="number">{escape(text)}</td>'
