"""`paper`: the contract's JSON, the files, and a report that needs nothing beside it and names every correction."""

import contextlib
import csv
import io
import json
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.image as mpl_image
import numpy as np
import pytest

from twostage_servo.cli.main import main
from twostage_servo.paper.errata import ERRATA
from twostage_servo.paper.methods import METHODS

pytestmark = pytest.mark.long

FIGURES = {
    "overshoot",
    "settling_time_s",
    "speed_overshoot",
    "velocity_noise_rms",
    "velocity_error_rms",
    "changeover_effort_step",
    "final_error",
}
PICTURES = {
    "fig2a", "fig2b", "fig3a", "fig3b", "fig3c", "printed_speed_stage", "disturbance", "set_points", "phase", "loops",
}  # fmt: skip
VOID = {"meta", "img", "br", "link", "hr", "input"}


@dataclass(frozen=True)
class Outcome:
    """One run of the verb: exit code, what it printed, and the folder that it wrote."""

    exit_code: int
    out: str
    err: str
    folder: Path


def run(capsys: pytest.CaptureFixture[str], folder: Path, *arguments: str) -> Outcome:
    exit_code = main(["paper", "--out", str(folder), *arguments])
    captured = capsys.readouterr()
    return Outcome(exit_code, captured.out, captured.err, folder)


class Reader(HTMLParser):
    """Collects text and addresses of a page, and checks that every tag is closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.addresses: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in {"src", "href"}]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("paper") / "new" / "report"


@pytest.fixture(scope="module")
def outcome(folder: Path) -> Outcome:
    """The one run that most tests look at, with --json."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        exit_code = main(["paper", "--json", "--out", str(folder)])
    return Outcome(exit_code, out.getvalue(), err.getvalue(), folder)


@pytest.fixture(scope="module")
def result(outcome: Outcome) -> dict[str, Any]:
    (line,) = outcome.out.splitlines()
    parsed: dict[str, Any] = json.loads(line)
    return parsed


def test_the_contract(outcome: Outcome, result: dict[str, Any]) -> None:
    assert outcome.exit_code == 0
    assert outcome.err == ""
    assert isinstance(result["seed"], int)
    for example in ("example1", "example2"):
        gains = result["gains"][example]
        assert set(gains) == {"f11", "f12", "f22", "changeover_distance", "kalman_gain"}
        assert len(gains["kalman_gain"]) == 3
        assert set(result[example]) == set(METHODS)
        for figures in result[example].values():
            assert set(figures) >= FIGURES
            assert all(isinstance(figures[name], float) for name in FIGURES)


def test_the_digits_that_the_paper_prints(result: dict[str, Any]) -> None:
    first, second = result["gains"]["example1"], result["gains"]["example2"]
    assert (f"{first['f11']:.2e}", f"{first['f12']:.2e}", f"{first['f22']:.1e}") == ("3.78e-01", "2.32e-02", "6.9e-03")
    assert f"{first['changeover_distance']:.1f}" == "54.5"
    assert (f"{second['f11']:.3f}", f"{second['f12']:.4f}", f"{second['f22']:.4f}") == ("1.430", "0.0689", "0.0663")
    assert f"{second['changeover_distance']:.1f}" == "21.6"


def test_every_claim_holds_and_says_what_was_measured(result: dict[str, Any]) -> None:
    assert len(result["claims"]) >= 15
    for claim in result["claims"]:
        assert claim["holds"] is True, claim
        assert any(character.isdigit() for character in claim["measured"])


def test_frames_change_nothing_but_the_rounding(result: dict[str, Any]) -> None:
    for example in ("example1", "example2"):
        frames = result["frames"][example]
        assert frames["position_quantum"] == pytest.approx(0.001)
        # Rounding to a quantum moves a sample by half of it; what the loop makes of that stays of its size.
        assert 0.0 < frames["position_difference"] < 5.0 * frames["position_quantum"]
        assert 0.0 < frames["effort_difference"] < 5.0 * frames["effort_quantum"]
        assert frames["effort_difference_unexplained"] < 1e-9
        assert frames["frames"]["overshoot"] == pytest.approx(result[example]["proposed"]["overshoot"], rel=0.02)
        assert frames["delayed"]["overshoot"] != frames["frames"]["overshoot"]


def test_the_files_are_those_that_are_listed(outcome: Outcome, result: dict[str, Any]) -> None:
    assert sorted(path.name for path in outcome.folder.iterdir()) == result["files"]
    assert result["report"] == str(outcome.folder / "report.html")
    stored = json.loads((outcome.folder / "results.json").read_text("utf-8"))
    assert stored == {key: value for key, value in result.items() if key not in {"report", "files"}}


def test_every_figure_is_drawn_in_both_forms(outcome: Outcome) -> None:
    for name in PICTURES:
        pixels = mpl_image.imread(outcome.folder / f"{name}.png")
        assert min(pixels.shape[:2]) > 300
        assert float(np.std(pixels[..., :3])) > 0.02, f"{name} is blank"
        assert ET.parse(outcome.folder / f"{name}.svg").getroot().tag.endswith("svg")  # noqa: S314 - our own file


def test_the_samples_give_the_same_figures(outcome: Outcome, result: dict[str, Any]) -> None:
    for example in ("example1", "example2"):
        with (outcome.folder / f"{example}.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        times = [float(row["time_s"]) for row in rows]
        assert times == pytest.approx([0.01 * k for k in range(len(rows))])
        cruise = slice(150, 300)
        for method in METHODS:
            positions = np.array([float(row[f"{method}.position"]) for row in rows])
            used = np.array([float(row[f"{method}.law_velocity"]) for row in rows])
            figures = result[example][method]
            assert max(0.0, positions.max() - 400.0) == pytest.approx(figures["overshoot"], abs=1e-9)
            assert used[cruise].std() == pytest.approx(figures["velocity_noise_rms"], abs=1e-9)
            inside = np.abs(positions - 400.0) <= 0.4
            settled = times[len(inside) - int(np.argmin(inside[::-1]))]
            assert settled == pytest.approx(figures["settling_time_s"])


def test_the_report_needs_nothing_beside_it(outcome: Outcome) -> None:
    page = (outcome.folder / "report.html").read_text("utf-8")
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    assert "script" not in reader.tags
    assert "link" not in reader.tags
    assert reader.tags.count("img") == len(PICTURES)
    assert "$" not in "".join(reader.text)
    for address in reader.addresses:
        assert address.startswith(("data:image/svg+xml;base64,", "#"))
        if address.startswith("#"):
            assert f'id="{address[1:]}"' in page


def test_a_reader_of_the_report_alone_can_name_every_correction(outcome: Outcome) -> None:
    reader = Reader()
    reader.feed((outcome.folder / "report.html").read_text("utf-8"))
    text = "".join(reader.text)
    for erratum in ERRATA:
        for part in (erratum.where, erratum.printed, erratum.read_as, erratum.why, erratum.effect):
            assert part.replace("_", "") in text.replace("_", "")  # x_o1 is set as x with an index
        if erratum.as_printed is not None:
            assert f"slip {erratum.number}Example 1" in text
    for equation in ("(11), errata 1, 3", "(25), errata 5, 8", "(28), erratum 7", "(32), erratum 12"):
        assert equation in text
    assert "oscillates" in text
    assert "math" in reader.tags


def test_in_text_it_prints_the_tables_and_writes_the_same_bytes_again_whatever_lies_around(
    outcome: Outcome, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "example2.toml").write_text("this = 'is another file'", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "report"
    with mpl.rc_context({"font.size": 20.0, "axes.facecolor": "red"}):  # the user's matplotlibrc
        again = run(capsys, folder)
    assert again.exit_code == 0
    assert "Example 1: white noise on the output" in again.out
    for method in METHODS.values():
        assert len(re.findall(rf"^  {re.escape(method.label)} +\d", again.out, re.MULTILINE)) == 2
    assert again.out.count("holds: ") == len(json.loads(outcome.out)["claims"])
    assert str(folder / "report.html") in again.out
    assert max(map(len, again.out.splitlines()[:-1])) <= 80  # the last one holds the path
    for path in outcome.folder.iterdir():
        assert (folder / path.name).read_bytes() == path.read_bytes(), path.name


def test_a_folder_that_cannot_be_written_is_told_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "taken").write_text("a file", encoding="utf-8")
    outcome = run(capsys, tmp_path / "taken", "--json")
    error = json.loads(outcome.out)["error"]
    assert outcome.exit_code == 3
    assert error["code"] == "report"
    assert str(tmp_path / "taken") in error["message"]
    assert "--out" in error["message"]


def test_a_disk_that_fills_up_is_an_error_that_names_the_file(
    outcome: Outcome, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    written = {name: (outcome.folder / name).read_bytes() for name in json.loads(outcome.out)["files"]}
    monkeypatch.setattr("twostage_servo.paper.studies.run_all", lambda _: None)
    monkeypatch.setattr("twostage_servo.cli.paper._run_frames", dict)
    monkeypatch.setattr("twostage_servo.paper.claims.check_claims", lambda *_: [])
    monkeypatch.setattr("twostage_servo.paper.publication.results", lambda *_: {})
    monkeypatch.setattr("twostage_servo.paper.publication.report_files", lambda *_: written)

    def full(path: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device")  # as a write gives it: without a name

    monkeypatch.setattr(Path, "write_bytes", full)
    outcome = run(capsys, tmp_path / "report", "--json")
    assert outcome.exit_code == 3
    message = json.loads(outcome.out)["error"]["message"]
    assert "No space left on device" in message
    assert str(tmp_path / "report" / next(iter(written))) in message
    assert not (tmp_path / "report").exists()


def test_an_interrupted_run_leaves_the_report_before_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "report.html").write_text("the last one", encoding="utf-8")

    def interrupt(progress: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("twostage_servo.paper.studies.run_all", interrupt)
    assert main(["paper", "--out", str(tmp_path)]) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == "the last one"
