"""An axis whose law has no type keeps the paper's, and is told of the other one, in one line."""

import re
from pathlib import Path

import pytest

from tests.demo_file import DEMO, LAW_OF_THE_DEMO
from twostage_servo.cli.main import main
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.loader import load
from twostage_servo.config.machine import load_machine

FORMER = DEMO.replace(LAW_OF_THE_DEMO, "[axis.law]\n")
TEXT = (
    'is not set, so the axis keeps the law "paper"; type = "adaptive" settles sooner and overshoots less '
    '(docs/adaptive-law.md), and type = "paper" ends this note'
)
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def former(tmp_path: Path) -> Path:
    path = tmp_path / "axis.toml"
    path.write_text(FORMER, encoding="utf-8")
    return path


def test_it_is_told_with_the_place_of_the_table(former: Path) -> None:
    loaded = load(former)
    line = FORMER.splitlines().index("[axis.law]") + 1
    assert [(one.file, one.line, one.key, one.message) for one in loaded.notes] == [
        (str(former), line, "axis.law.type", TEXT)
    ]
    assert loaded.config.axis.law.type == "paper"


def test_a_file_without_the_table_is_told_as_well(tmp_path: Path) -> None:
    path = tmp_path / "axis.toml"
    text = re.sub(r"\[axis\.law\]\n.*\n\n", "", FORMER)
    assert "axis.law" not in text
    path.write_text(text, encoding="utf-8")
    (note,) = load(path).notes
    assert (note.key, note.message) == ("axis.law.type", TEXT)


@pytest.mark.parametrize("law", ["paper", "adaptive"])
def test_whoever_names_a_law_is_told_nothing(former: Path, law: str) -> None:
    assert load(former, [f"axis.law.type={law}"]).notes == ()


def test_each_shipped_file_and_example_names_its_law() -> None:
    files = [*shipped_configuration("").glob("*.toml"), *EXAMPLES.rglob("axis*.toml")]
    assert len(files) >= 12
    assert {path.name: load_machine(path).notes for path in files if load_machine(path).notes} == {}


def test_each_verb_that_reads_the_file_says_so_on_stderr(former: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--config", str(former), "--json"]) == 0
    shown = capsys.readouterr()
    assert shown.err.count("axis.law.type: is not set") == 1
    assert TEXT not in shown.out
