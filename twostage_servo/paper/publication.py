"""What a run of everything is published as: one JSON object, and the files of the report."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from io import StringIO
from itertools import zip_longest
from typing import Any

from twostage_servo.paper import plots
from twostage_servo.paper.claims import Claim
from twostage_servo.paper.examples import EXAMPLES
from twostage_servo.paper.experiment import SEED
from twostage_servo.paper.frames import FramesComparison
from twostage_servo.paper.loops import margins_json
from twostage_servo.paper.report import render
from twostage_servo.paper.studies import LOAD, Comparison, Curve, Studies, steady_error


def results(studies: Studies, claims: Sequence[Claim], frames: Mapping[str, FramesComparison]) -> dict[str, Any]:
    """Return every number of the runs, in mm, mm/s, V and s, by example and method; `frames` by example."""
    return {
        "seed": SEED,
        "gains": {
            example.name: {
                **asdict(example.gains),
                "changeover_distance": example.changeover_distance,
                "kalman_gain": list(example.kalman.predictor),
            }
            for example in EXAMPLES
        },
        "margins": {example.name: margins_json(example) for example in EXAMPLES},
        **{pair.example.name: _scores(pair) for pair in studies.comparisons},
        "constant_load": {
            "load": LOAD,
            "predicted_conventional_error": {example.name: steady_error(example, LOAD) for example in EXAMPLES},
            **{pair.example.name: _scores(pair) for pair in studies.under_load},
        },
        "overshoot_by_set_point": _by_example(studies.by_set_point),
        "overshoot_by_phase": _by_example(studies.by_phase),
        "slips": [
            {
                "number": slip.erratum.number,
                "example": slip.example.name,
                "corrected": slip.corrected.as_json(),
                "printed": None if slip.printed is None else slip.printed.as_json(),
                "unsolvable": slip.unsolvable,
            }
            for slip in studies.slips
        ],
        "frames": {name: asdict(pair) for name, pair in frames.items()},
        "claims": [asdict(claim) for claim in claims],
    }


def report_files(
    studies: Studies, claims: Sequence[Claim], frames: Mapping[str, FramesComparison], result: dict[str, Any]
) -> dict[str, bytes]:
    """Return the content of every file of the report by its name.

    Parameters
    ----------
    studies, claims, frames
        As for :func:`results`.
    result
        What that returned.
    """
    files: dict[str, bytes] = {}
    pictures = _draw(studies)
    for picture in pictures:
        files[f"{picture.name}.svg"] = picture.svg
        files[f"{picture.name}.png"] = picture.png
    for comparison in studies.comparisons:
        files[f"{comparison.example.name}.csv"] = _samples(comparison).encode()
    files["results.json"] = (json.dumps(result, indent=2, allow_nan=False) + "\n").encode()
    files["report.html"] = render(studies, claims, frames, pictures).encode()
    return files


def _scores(comparison: Comparison) -> dict[str, Any]:
    return {name: scores.as_json() for name, scores in comparison.scores.items()}


def _by_example(curves: Sequence[Sequence[Curve]]) -> dict[str, Any]:
    return {
        example.name: {
            curve.name: {"set_points": list(curve.set_points), "overshoots": list(curve.overshoots)} for curve in group
        }
        for example, group in zip(EXAMPLES, curves, strict=True)
    }


def _draw(studies: Studies) -> list[plots.Picture]:
    with plots.our_style():
        return [
            *plots.papers_figures(*studies.comparisons),
            plots.printed_speed_stage(studies.comparisons[1]),
            plots.disturbance(studies.under_load),
            plots.set_point_dependence(studies.by_set_point),
            plots.phase_dependence(studies.by_phase),
            plots.loops(),
        ]


def _samples(comparison: Comparison) -> str:
    """Return every sample of every method's run as CSV, one row per tick; a run that ended early leaves cells empty."""
    columns: dict[str, list[float]] = {"time_s": []}
    for name, run in comparison.runs.items():
        columns["time_s"] = max(columns["time_s"], run.time_s, key=len)
        for quantity in ("position", "velocity", "law_velocity", "effort"):
            columns[f"{name}.{quantity}"] = getattr(run, quantity)
    text = StringIO(newline="")
    csv.writer(text).writerows([list(columns), *zip_longest(*columns.values())])
    return text.getvalue()
