"""`paper`: both examples of the paper with every method, as a table, as JSON, and as a report with figures."""

import argparse
import csv
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twostage_servo.cli.output import CommandError, ExitCode, Progress, print_json, print_line

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from twostage_servo.paper.claims import Claim
    from twostage_servo.paper.frames import FramesComparison
    from twostage_servo.paper.plots import Picture
    from twostage_servo.paper.studies import Comparison, Curve, Studies


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verb."""
    paper = verbs.add_parser(
        "paper",
        help="run both examples of the paper with every method; write a report",
        description="Run both examples of the paper with every method, check what the paper claims, and write one "
        "self-contained HTML report with its figures, their data and every correction to the print. Needs no hardware.",
    )
    paper.add_argument(
        "--out", type=Path, default=Path("paper-report"), metavar="DIR", help="folder to write (default paper-report)"
    )
    paper.add_argument("--json", action="store_true", help="print one JSON object")
    paper.set_defaults(run=_paper)


def _paper(options: argparse.Namespace) -> ExitCode:
    from twostage_servo.paper.claims import check_claims
    from twostage_servo.paper.studies import run_all

    _make_folder(options.out)  # a folder that cannot be written is told before the work
    progress = Progress(quiet=options.json)
    try:
        studies = run_all(progress.show)
        progress.show("the law behind CAN frames, in simulated time")
        frames = _run_frames()
        claims = check_claims(studies, frames)
        result = _result(studies, claims, frames)
        progress.show("figures and report")
        files = _write_report(options.out, studies, claims, frames, result)
    finally:
        progress.end()
    if options.json:
        print_json({**result, "report": str(options.out / "report.html"), "files": files})
    else:
        print_line(_as_text(studies, claims, options.out / "report.html", len(files)))
    return ExitCode.DONE if all(claim.holds for claim in claims) else ExitCode.FAILED


def _run_frames() -> "dict[str, FramesComparison]":
    from twostage_servo.cli.behind_frames import compare_with_frames
    from twostage_servo.paper.examples import EXAMPLES
    from twostage_servo.service.log import open_log

    writer = open_log("critical")
    try:
        return {example.name: compare_with_frames(example) for example in EXAMPLES}
    finally:
        writer.close()


def _result(studies: "Studies", claims: "Sequence[Claim]", frames: "Mapping[str, FramesComparison]") -> dict[str, Any]:
    from dataclasses import asdict

    from twostage_servo.paper.examples import EXAMPLES
    from twostage_servo.paper.experiment import SEED
    from twostage_servo.paper.studies import LOAD, steady_error

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


def _scores(comparison: "Comparison") -> dict[str, Any]:
    return {name: scores.as_json() for name, scores in comparison.scores.items()}


def _by_example(curves: "Sequence[Sequence[Curve]]") -> dict[str, Any]:
    from twostage_servo.paper.examples import EXAMPLES

    return {
        example.name: {
            curve.name: {"set_points": list(curve.set_points), "overshoots": list(curve.overshoots)} for curve in group
        }
        for example, group in zip(EXAMPLES, curves, strict=True)
    }


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "report.html").open("a").close()
    except OSError as error:
        text = f"the report cannot be written into {folder}: {error.strerror}; name another folder with --out"
        raise CommandError(ExitCode.FAILED, "report", text) from error


def _write_report(
    folder: Path,
    studies: "Studies",
    claims: "Sequence[Claim]",
    frames: "Mapping[str, FramesComparison]",
    result: dict[str, Any],
) -> list[str]:
    """Write everything; return the names of the files."""
    from twostage_servo.paper.report import render

    pictures = _draw(studies)
    files: dict[str, bytes] = {}
    for picture in pictures:
        files[f"{picture.name}.svg"] = picture.svg
        files[f"{picture.name}.png"] = picture.png
    files["results.json"] = (json.dumps(result, indent=2, allow_nan=False) + "\n").encode()
    files["report.html"] = render(studies, claims, frames, pictures).encode()
    try:
        for name, content in files.items():
            (folder / name).write_bytes(content)
        for comparison in studies.comparisons:
            name = f"{comparison.example.name}.csv"
            _write_samples(folder / name, comparison)
            files[name] = b""
    except OSError as error:
        text = f"the report is not complete: {error.filename or folder}: {error.strerror}"
        raise CommandError(ExitCode.FAILED, "report", text) from error
    return sorted(files)


def _draw(studies: "Studies") -> "list[Picture]":
    from twostage_servo.paper import plots

    return [
        *plots.papers_figures(*studies.comparisons),
        plots.printed_speed_stage(studies.comparisons[1]),
        plots.disturbance(studies.under_load),
        plots.set_point_dependence(studies.by_set_point),
        plots.phase_dependence(studies.by_phase),
    ]


def _write_samples(path: Path, comparison: "Comparison") -> None:
    """Write every sample of every method's run, one row per tick; a run that ended early leaves its cells empty."""
    from itertools import zip_longest

    columns: dict[str, list[float]] = {}
    for name, run in comparison.runs.items():
        if len(run.time_s) > len(columns.get("time_s", ())):
            columns["time_s"] = run.time_s
        for quantity in ("position", "velocity", "law_velocity", "effort"):
            columns[f"{name}.{quantity}"] = getattr(run, quantity)
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([list(columns), *zip_longest(*columns.values())])


_HEADS = (
    ("", "over-", "", "speed", "velocity", "velocity", "effort", "final"),
    ("", "shoot", "settling", "overshoot", "noise", "error", "step", "error"),
    ("", "mm", "s", "mm/s", "mm/s", "mm/s", "V", "mm"),
)
"""Heads of the table, three lines, in the order of the report's columns."""


def _as_text(studies: "Studies", claims: "Sequence[Claim]", report: Path, files: int) -> str:
    from twostage_servo.paper.methods import METHODS
    from twostage_servo.paper.report import COLUMNS, score_text

    lines = []
    for comparison in studies.comparisons:
        example, gains = comparison.example, comparison.example.gains
        lines += [
            example.title,
            f"  f11 {gains.f11:.4g}  f12 {gains.f12:.4g}  f22 {gains.f22:.4g}  p {example.changeover_distance:.4g} mm",
            *(_line(*heads) for heads in _HEADS),
        ]
        for name, scores in comparison.scores.items():
            lines.append(_line(METHODS[name].title, *(score_text(scores, column) for column, _ in COLUMNS)))
        lines.append("")
    for claim in claims:
        lines += [f"{'holds' if claim.holds else 'DOES NOT HOLD'}: {claim.claim}", f"       {claim.measured}"]
    lines += ["", f"{files} files written; start with {report}"]
    return "\n".join(lines)


def _line(title: str, *cells: str) -> str:
    return f"  {title:28}" + "".join(f"{cell:>10}" for cell in cells)
