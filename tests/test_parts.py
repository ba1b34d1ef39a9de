"""The parts that CI divides the tests into."""

import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.conftest import part_of

TREE = Path(__file__).parents[1]
_EXAMPLE = "tests/control/test_plant.py"


def test_every_test_is_in_one_part_with_all_of_its_parameters() -> None:
    names = [f"tests/room/test_{number}.py::test_{number % 7}_of_it" for number in range(1000)]
    assert {part_of(f"{name}[{value}]", 2) == part_of(name, 2) for name in names for value in (1, "a-b")} == {True}
    sizes = Counter(part_of(name, 2) for name in names)
    assert set(sizes) == {0, 1}
    assert min(sizes.values()) > 400


@pytest.mark.long
def test_a_part_leaves_the_others_out() -> None:
    collected = []
    for part in ([], ["--part", "0/2"], ["--part", "1/2"]):
        command = [sys.executable, "-m", "pytest", "--collect-only", "-p", "no:cacheprovider", *part, _EXAMPLE]
        done = subprocess.run(command, cwd=TREE, capture_output=True, text=True, check=True)  # noqa: S603 - our own program
        collected.append({line.strip() for line in done.stdout.splitlines() if "::" in line})
    whole, first, second = collected
    assert first
    assert second
    assert whole == first | second
    assert not first & second
