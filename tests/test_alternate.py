"""The comparison of two trees: what becomes of the figures of its rounds."""

import sys
from pathlib import Path

import pytest

from tools.bench.alternate import compare, compile_modules


def test_both_trees_have_bytecode_before_a_start_is_timed(tmp_path: Path) -> None:
    """Where none may be written, the tree that had been started before it came to be so would win."""
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "python").symlink_to(sys.executable)
    for folder in ("twostage_servo", "tools"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "module.py").write_text("ONE = 1\n", encoding="utf-8")
    compile_modules(tmp_path)
    assert len(list(tmp_path.glob("*/__pycache__/module.*.pyc"))) == 2


def test_a_machine_that_slows_down_does_not_change_the_ratio() -> None:
    before = [1.0 + 0.1 * round_number for round_number in range(30)]
    result = compare(before, [1.1 * figure for figure in before])
    assert result["before"] == pytest.approx(2.45)
    assert result["after"] == pytest.approx(2.695)
    assert [result[name] for name in ("ratio", "from", "to")] == pytest.approx([1.1, 1.1, 1.1])


def test_the_interval_holds_what_rounds_differ_by() -> None:
    after = [0.9, 1.0, 1.0, 1.0, 1.5, 1.0, 0.8, 1.0, 1.2, 1.0]
    result = compare([1.0] * 10, after)
    assert result["ratio"] == 1.0
    assert 0.8 <= result["from"] <= 1.0 <= result["to"] <= 1.2


def test_one_slow_round_does_not_move_the_median() -> None:
    assert compare([1.0] * 9, [1.0] * 8 + [50.0])["to"] < 2.0
