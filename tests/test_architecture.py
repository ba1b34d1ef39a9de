"""The page on the architecture says what is there: its paths, its rooms, its picture."""

import re
import tomllib
from pathlib import Path

import pytest

from tools.rooms import draw

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text("utf-8")
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]


def section(title: str) -> str:
    return PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def rows(title: str) -> list[list[str]]:
    lines = [line for line in section(title).splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[1:]]


@pytest.mark.parametrize(
    "path", sorted(set(re.findall(r"`((?:twostage_servo|tools|tests|docs|config)/[\w./-]*)`", PAGE)))
)
def test_every_path_exists(path: str) -> None:
    assert (ROOT / path).exists()


def test_the_rooms_are_those_of_the_contract_in_their_order() -> None:
    (layers,) = [contract["layers"] for contract in CONTRACTS if contract["id"] == "rooms"]
    assert [cells[0].strip("`") for cells in rows("Rooms")] == [layer.strip("()") for layer in layers]


def test_the_small_modules_are_those_that_the_contract_leaves_out() -> None:
    (left_out,) = [contract["exhaustive_ignores"] for contract in CONTRACTS if contract["id"] == "rooms"]
    sentence = PAGE.partition("Beside the rooms stand small modules")[2].partition(". `import")[0]
    assert sorted(re.findall(r"`(\w+)`", sentence)) == sorted(left_out)


def test_each_group_of_verbs_is_held_apart_from_the_others() -> None:
    (modules,) = [contract["modules"] for contract in CONTRACTS if contract["id"] == "independent-verbs"]
    verbs = [
        path.stem for path in (ROOT / "twostage_servo" / "cli").glob("*.py") if "def add_verbs(" in path.read_text()
    ]
    assert sorted(modules) == sorted(f"twostage_servo.cli.{name}" for name in verbs)


def test_each_of_ten_changes_names_a_place() -> None:
    changes = rows("Where a change belongs")
    assert len(changes) == 10
    for change, begin, then in changes:
        assert re.search(r"`(twostage_servo|tools)/", begin), change
        assert then, change


def test_the_row_of_a_trip_names_each_place_where_one_is_detected() -> None:
    (row,) = [cells[2] for cells in rows("Where a change belongs") if cells[0] == "a trip"]
    detects = re.compile(r"(raise_trip\(|\byield|\bTrip\()[\s(]*TripCode\.")
    found = {
        path.relative_to(ROOT).as_posix()
        for room in ("axis", "service")
        for path in (ROOT / "twostage_servo" / room).glob("*.py")
        if detects.search(path.read_text("utf-8"))
    }
    assert len(found) > 8
    defects = {"twostage_servo/service/shutdown.py"}  # where this program's own become a trip
    assert {path for path in found if f"`{path}`" not in row} == defects


def test_an_arrow_that_follows_from_others_is_left_out() -> None:
    shown = draw.arrows(draw.rooms())
    assert ("config", "service") in shown
    assert ("cli", "settings") not in shown
    upper = {one for one, _ in shown}
    assert {"cli", "app", "service", "axis"} <= upper
