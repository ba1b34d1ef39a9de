"""The matrices in the docs: which share of them a change has to pass, and how it is compared."""

from pathlib import Path

import pytest

from tools.faults.matrix import SHARE, Matrix, compare, is_in_share, run, written
from twostage_servo.faults.cell import Cell
from twostage_servo.faults.report import as_markdown, rounded
from twostage_servo.faults.runner import Result

CELLS = [
    Cell(2, "frames lost", "cruising", "Q", "Q", "stale_feedback", 5.4, 12.8, axis="x"),
    Cell(2, "frames lost", "homing", "Q", "Q", "stale_feedback", 1.4, 2.8, axis="x"),
    Cell(22, "scale doubled", "stopping", "Q", "T", "", 1.4, 2.8, axis="y", limit="one encoder cannot tell"),
]


def page(cells: list[Cell]) -> str:
    text = as_markdown(Result(cells, [], {"x": "mm", "y": "mm"}))
    return f"before\n<!-- faults two: begin -->\n{text}\n<!-- faults two: end -->\nafter\n"


def matrix(cells: list[Cell]) -> Matrix:
    return Matrix("", {(cell.axis, str(cell.fault), cell.name, cell.phase): rounded(cell) for cell in cells})


def test_what_is_written_can_be_read_again() -> None:
    assert written(page(CELLS), "faults two") == matrix(CELLS).cells
    assert compare(page(CELLS), "faults two", matrix(CELLS[1:])) == []


def test_a_cell_that_is_another_or_not_there_is_told() -> None:
    assert len(compare(page(CELLS[1:]), "faults two", matrix(CELLS))) == 1
    worse = Cell(2, "frames lost", "cruising", "Q", "Q", "stale_feedback", 6.4, 12.8, axis="x")
    (line,) = compare(page(CELLS), "faults two", matrix([worse]))
    assert line == "x 2 frames lost cruising is 'Q 7 / 13', the page has 'Q 6 / 13':"


def test_a_share_is_the_same_again_and_another_with_another_text() -> None:
    cells = [(f"fault {number}", phase) for number in range(60) for phase in ("idle", "cruising", "homing")]

    def share(text: str) -> set[tuple[str, str]]:
        return {cell for cell in cells if is_in_share(text, "metres", "x", *cell)}

    assert share("a1b2") == share("a1b2")
    assert share("a1b2") != share("c3d4")
    assert 0.4 * SHARE < len(share("a1b2")) / len(cells) < 2.0 * SHARE
    together = set().union(*(share(f"commit {number}") for number in range(200)))
    assert together == set(cells)


@pytest.mark.long
def test_a_share_runs_those_cells_and_no_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tools.faults.matrix.SHARE", 0.01)
    ran = run(Path("config/socketcan.toml"), "a1b2")
    assert 0 < len(ran.cells) < 20
    assert all(is_in_share("a1b2", "socketcan", "x", name, phase) for _, _, name, phase in ran.cells)
    assert not ran.missed
