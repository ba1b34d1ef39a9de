"""How a set-point is typed: of the only axis, relative, or of several axes by their names."""

from typing import Any

import pytest

from twostage_servo.cli import operate
from twostage_servo.cli.main import build_parser
from twostage_servo.cli.output import CommandError


@pytest.mark.parametrize(
    ("typed", "wanted"),
    [
        (["-12.5"], {"position": -12.5}),
        (["--by", "-1e1"], {"by": -10.0}),
        (["x=4"], {"positions": {"x": 4.0}}),
        (["x=4", "y-2=-5.5"], {"positions": {"x": 4.0, "y-2": -5.5}}),
    ],
)
def test_it_becomes_what_the_service_is_asked_for(typed: list[str], wanted: dict[str, Any]) -> None:
    assert operate._wanted(build_parser().parse_args(["move", *typed])) == wanted


@pytest.mark.parametrize("typed", [[], ["1", "2"], ["1", "x=2"], ["x=1", "x=2"], ["1", "--by", "2"]])
def test_anything_else_is_explained(typed: list[str]) -> None:
    with pytest.raises(CommandError, match="NAME=POSITION"):
        operate._wanted(build_parser().parse_args(["move", *typed]))


def test_a_number_that_is_none_is_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        build_parser().parse_args(["move", "x=far"])
    assert "x=far" in capsys.readouterr().err
