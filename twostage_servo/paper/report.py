"""One HTML file that holds everything: claims, tables, figures, equations and corrections."""

import math
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from typing import Any

from latex2mathml.converter import convert
from markupsafe import Markup, escape

from twostage_servo.html_pages import page
from twostage_servo.paper.claims import Claim
from twostage_servo.paper.equations import PASSAGES, Equation
from twostage_servo.paper.examples import EXAMPLES, PERIOD_S, SET_POINT, VELOCITY
from twostage_servo.paper.experiment import DURATION_S, SEED
from twostage_servo.paper.frames import FramesComparison
from twostage_servo.paper.methods import CONVENTIONAL
from twostage_servo.paper.plots import Picture
from twostage_servo.paper.report_tables import (
    claims_table,
    errata_table,
    figure_text,
    frame_differences_table,
    frame_scores_table,
    gains_table,
    loads_table,
    margins_table,
    methods_table,
    score_text,
    scores_table,
    slips_table,
)
from twostage_servo.paper.studies import LOAD, Studies
from twostage_servo.version import __version__


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
        "version": __version__,
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
        "claims": claims_table(claims),
        "gains": gains_table(),
        "margins": margins_table(),
        "methods": methods_table(),
        "scores1": scores_table(studies.comparisons[0]),
        "scores2": scores_table(studies.comparisons[1]),
        "loads": loads_table(studies),
        "frame_differences": frame_differences_table(frames),
        "frame_scores": frame_scores_table(studies, frames),
        "errata": errata_table(),
        "slips": slips_table(studies.slips),
        "equations": _equations(),
        "pictures": {
            picture.name: {"caption": picture.caption, "data": b64encode(picture.svg).decode("ascii")}
            for picture in pictures
        },
        "typeset": typeset,
    }
    return page("paper/report.html.jinja", **places)


def _overshoot_at(studies: Studies, set_point: float) -> float:
    """Return the proposed law's overshoot in Example 2 at one of the set-points of the study, in mm."""
    curve = next(curve for curve in studies.by_set_point[1] if curve.name == "proposed")
    return curve.overshoots[curve.set_points.index(set_point)]


def _equations() -> list[dict[str, Any]]:
    return [
        {
            "title": passage.title,
            "text": passage.text,
            "equations": [
                {"mathematics": Markup(convert(equation.latex, display="block")), "source": _source(equation)}  # noqa: S704 - made of our own LaTeX
                for equation in passage.equations
            ],
        }
        for passage in PASSAGES
    ]


def _source(equation: Equation) -> str:
    if not equation.errata:
        return f"({equation.tag})"
    numbers = ", ".join(str(number) for number in equation.errata)
    return f"({equation.tag}), {'erratum' if len(equation.errata) == 1 else 'errata'} {numbers}"


def typeset(text: str) -> Markup:
    """Escape a text, and set the index of a symbol such as x_o1 below its letter."""
    return Markup(re.sub(r"(?<![A-Za-z0-9_])([A-Za-z])_([A-Za-z0-9]+)", r"\1<sub>\2</sub>", str(escape(text))))  # noqa: S704 - escaped
