"""`paper`: both examples of the paper with every method, as a table, as JSON, and as a report with figures."""

import argparse
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from twostage_servo.cli.extras import require
from twostage_servo.cli.output import CommandError, ExitCode, Progress, print_json, print_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from twostage_servo.paper.claims import Claim
    from twostage_servo.paper.frames import FramesComparison
    from twostage_servo.paper.studies import Studies


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
        "of the same names are replaced (default: paper-report in the current folder)",
    )
    paper.add_argument("--json", action="store_true", help="print one JSON object")
    paper.set_defaults(run=_paper)


def _folder(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("a folder is needed, such as paper-report")
    return Path(text)


def _paper(options: argparse.Namespace) -> ExitCode:
    import logging

    require("paper", "the report of the paper")
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # its remarks on its cache are nobody's concern here
    from twostage_servo.paper.claims import check_claims
    from twostage_servo.paper.publication import report_files, results
    from twostage_servo.paper.studies import run_all

    progress = Progress(quiet=options.json)
    try:
        with _staged(options.out) as staging:  # a folder that cannot be written is told before the work
            studies = run_all(progress.show)
            progress.show("the law behind CAN frames, in simulated time")
            frames = _run_frames()
            claims = check_claims(studies, frames)
            result = results(studies, claims, frames)
            progress.show("figures and report")
            files = report_files(studies, claims, frames, result)
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
    """Give a folder to write into; its files take their places in `folder` when all are written, report.html last."""
    from tempfile import TemporaryDirectory

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
    from twostage_servo.app.behind_frames import compare_with_frames
    from twostage_servo.paper.examples import EXAMPLES
    from twostage_servo.service.log import open_log

    writer = open_log("critical")
    try:
        return {example.name: compare_with_frames(example) for example in EXAMPLES}
    finally:
        writer.close()


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
    from textwrap import wrap

    from twostage_servo.paper.methods import METHODS
    from twostage_servo.paper.report_tables import score_text

    lines = []
    for comparison in studies.comparisons:
        example, gains = comparison.example, comparison.example.gains
        lines += [
            example.title,
            f"  f11 {gains.f11:.4g}  f12 {gains.f12:.4g}  f22 {gains.f22:.4g}  p {example.changeover_distance:.4g} mm",
            *(_line(*heads) for heads in _HEADS),
        ]
        for name, scores in comparison.scores.items():
            lines.append(
                _line(METHODS[name].label, *(score_text(scores.as_json(), column, digits=3) for column in _SHOWN))
            )
        lines.append("")
    for claim in claims:
        lines += wrap(f"{'holds' if claim.holds else 'DOES NOT HOLD'}: {claim.claim}", 78, subsequent_indent="       ")
        lines += wrap(claim.measured, 78, initial_indent="       ", subsequent_indent="       ")
    lines += ["", f"{files} files written; start with {report}"]
    return "\n".join(lines)


def _line(title: str, *cells: str) -> str:
    return f"  {title:21}" + "".join(f"{cell:>8}" for cell in cells)
