"""`paper`: both examples of the paper with every method, as a table, as JSON, and as a report with figures."""

import argparse
import csv
import json
from contextlib import contextmanager
from io import StringIO
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from twostage_servo.cli.output import CommandError, ExitCode, Progress, print_json, print_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

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
        "self-contained HTML report with its figures, their data and every correction to the print. Needs no hardware. "
        "Exit code 3: a claim does not hold, or the report cannot be written.",
    )
    paper.add_argument(
        "--out",
        type=_folder,
        default=Path("paper-report"),
        metavar="DIR",
        help="folder to write: report.html, its figures as SVG and PNG, every sample as CSV, and results.json; files "
        "of the same names are replaced (default: paper-report in the present folder)",
    )
    paper.add_argument("--json", action="store_true", help="print one JSON object")
    paper.set_defaults(run=_paper)


def _folder(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("a folder is needed, such as paper-report")
    return Path(text)


def _paper(options: argparse.Namespace) -> ExitCode:
    import logging

    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # its remarks on its cache are nobody's concern here
    from twostage_servo.paper.claims import check_claims
    from twostage_servo.paper.studies import run_all

    progress = Progress(quiet=options.json)
    try:
        with _staged(options.out) as staging:  # a folder that cannot be written is told before the work
            studies = run_all(progress.show)
            progress.show("the law behind CAN frames, in simulated time")
            frames = _run_frames()
            claims = check_claims(studies, frames)
            result = _result(studies, claims, frames)
            progress.show("figures and report")
            files = _contents(studies, claims, frames, result)
            for name, content in files.items():
                _write(staging / name, content, options.out)
    finally:
        progress.end()
    if options.json:
        print_json({**result, "report": str(options.out / "report.html"), "files": sorted(files)})
    else:
        print_line(_as_text(studies, claims, options.out / "report.html", len(files)))
    return ExitCode.DONE if all(claim.holds for claim in claims) else ExitCode.FAILED


@contextmanager
def _staged(folder: Path) -> "Iterator[Path]":
    """Give a folder to write into; its files take their places in `folder` together, at the end, or not at all."""
    created = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        staging = TemporaryDirectory(dir=folder, prefix=".unfinished-")
    except OSError as error:
        raise _unwritable(folder, error) from error
    try:
        with staging as name:
            yield Path(name)
            for path in sorted(Path(name).iterdir(), key=lambda path: path.name == "report.html"):
                try:
                    path.replace(folder / path.name)
                except OSError as error:
                    raise _unwritable(folder / path.name, error) from error
    finally:
        if created and not any(folder.iterdir()):
            folder.rmdir()


def _write(path: Path, content: bytes, folder: Path) -> None:
    try:
        path.write_bytes(content)
    except OSError as error:
        raise _unwritable(folder / path.name, error) from error


def _unwritable(path: Path, error: OSError) -> CommandError:
    text = f"the report cannot be written: {path}: {error.strerror}; make room there or name another folder with --out"
    return CommandError(ExitCode.FAILED, "report", text)


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


def _contents(
    studies: "Studies", claims: "Sequence[Claim]", frames: "Mapping[str, FramesComparison]", result: dict[str, Any]
) -> dict[str, bytes]:
    """Return every file by its name."""
    from twostage_servo.paper.report import render

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


def _draw(studies: "Studies") -> "list[Picture]":
    from twostage_servo.paper import plots

    with plots.our_style():
        return [
            *plots.papers_figures(*studies.comparisons),
            plots.printed_speed_stage(studies.comparisons[1]),
            plots.disturbance(studies.under_load),
            plots.set_point_dependence(studies.by_set_point),
            plots.phase_dependence(studies.by_phase),
        ]


def _samples(comparison: "Comparison") -> str:
    """Return every sample of every method's run as CSV, one row per tick; a run that ended early leaves cells empty."""
    columns: dict[str, list[float]] = {"time_s": []}
    for name, run in comparison.runs.items():
        columns["time_s"] = max(columns["time_s"], run.time_s, key=len)
        for quantity in ("position", "velocity", "law_velocity", "effort"):
            columns[f"{name}.{quantity}"] = getattr(run, quantity)
    text = StringIO(newline="")
    csv.writer(text).writerows([list(columns), *zip_longest(*columns.values())])
    return text.getvalue()


_HEADS = (
    ("", "over-", "sett-", "speed", "veloc.", "veloc.", "effort", "final"),
    ("", "shoot", "ling", "over", "noise", "error", "step", "error"),
    ("", "mm", "s", "mm/s", "mm/s", "mm/s", "V", "mm"),
)
"""Heads of the table, three lines."""
_SHOWN = (
    "overshoot",
    "settling_time_s",
    "speed_overshoot",
    "velocity_noise_rms",
    "velocity_error_rms",
    "changeover_effort_step",
    "final_error",
)
"""Its columns: those that fit into 80 characters."""


def _as_text(studies: "Studies", claims: "Sequence[Claim]", report: Path, files: int) -> str:
    from twostage_servo.paper.methods import METHODS
    from twostage_servo.paper.report import score_text

    lines = []
    for comparison in studies.comparisons:
        example, gains = comparison.example, comparison.example.gains
        lines += [
            example.title,
            f"  f11 {gains.f11:.4g}  f12 {gains.f12:.4g}  f22 {gains.f22:.4g}  p {example.changeover_distance:.4g} mm",
            *(_line(*heads) for heads in _HEADS),
        ]
        for name, scores in comparison.scores.items():
            lines.append(_line(METHODS[name].label, *(score_text(scores, column, digits=3) for column in _SHOWN)))
        lines.append("")
    for claim in claims:
        lines += wrap(f"{'holds' if claim.holds else 'DOES NOT HOLD'}: {claim.claim}", 78, subsequent_indent="       ")
        lines += wrap(claim.measured, 78, initial_indent="       ", subsequent_indent="       ")
    lines += ["", f"{files} files written; start with {report}"]
    return "\n".join(lines)


def _line(title: str, *cells: str) -> str:
    return f"  {title:21}" + "".join(f"{cell:>8}" for cell in cells)
