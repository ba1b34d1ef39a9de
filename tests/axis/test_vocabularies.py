"""The vocabularies of an axis: complete, described, and light enough for every client."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.trips import RULES, TripCode

ROOT = Path(__file__).parents[2]


def test_the_documentation_explains_each_refusal_and_no_other() -> None:
    text = (ROOT / "docs" / "control-socket.md").read_text(encoding="utf-8")
    table = text.split("\n## Refusals\n")[1].split("\n## ")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert sorted(re.findall(r"`(\w+)`", " ".join(rows))) == sorted(RefusalCode)


def test_each_trip_has_a_rule() -> None:
    assert set(RULES) == set(TripCode)


@pytest.mark.parametrize("module", ["state", "trips", "refusals", "moves"])
def test_a_vocabulary_loads_nothing_but_the_standard_library(module: str) -> None:
    script = f"""
import sys
before = set(sys.modules)
import twostage_servo.axis.{module}
print(sorted({{name.partition(".")[0] for name in set(sys.modules) - before}} - set(sys.stdlib_module_names)))
"""
    loaded = subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60
    )
    assert loaded.stdout.strip() == "['twostage_servo']"
