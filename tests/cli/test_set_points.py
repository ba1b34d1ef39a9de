"""How a set-point is typed: of the only axis, relative, or of several axes by their names."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twostage_servo.cli import operator_verbs
from twostage_servo.cli.main import build_parser, main
from twostage_servo.cli.output import CommandError
from twostage_servo.cli.typed_numbers import decimal


@pytest.mark.parametrize(
    ("typed", "wanted"),
    [
        (["-12.5"], -12.5),
        (["0"], 0.0),
        (["--by", "-1e1"], None),
        (["x=4"], {"x": 4.0}),
        (["x=4", "y-2=-5.5"], {"x": 4.0, "y-2": -5.5}),
    ],
)
def test_it_becomes_what_the_service_is_asked_for(typed: list[str], wanted: float | dict[str, float] | None) -> None:
    assert operator_verbs._wanted(build_parser().parse_args(["move", *typed])) == wanted


@pytest.mark.parametrize("typed", [[], ["1", "2"], ["1", "x=2"], ["1", "--by", "2"]])
def test_anything_else_is_explained(typed: list[str]) -> None:
    with pytest.raises(CommandError, match="NAME=POSITION"):
        operator_verbs._wanted(build_parser().parse_args(["move", *typed]))


@pytest.mark.parametrize(
    ("typed", "why"),
    [
        (["x=1", "y=3", "x=2"], "x is given twice"),
        (["x=1", "--axis", "y"], "the set-points name their axes (x): leave --axis y out"),
        (["x=1", "--axis", "x"], "the set-points name their axes (x): leave --axis x out"),
    ],
)
def test_axes_that_contradict_each_other_are_named(
    typed: list[str], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["move", *typed, "--socket", "/nowhere"]) == 2  # and not 4: nobody is asked
    assert why in capsys.readouterr().err


@pytest.mark.parametrize(
    "slip", ["1_0", "\u0661\u0662", "\uff11\uff12", "1e1_0", "0x10", "1,5", "- 5", "", "1 0", "x=1_0", "x="]
)
@pytest.mark.parametrize(
    "verb", [["move"], ["move", "--by"], ["move", "1", "--velocity"], ["jog"], ["override"], ["home", "--here"]]
)
def test_what_looks_like_a_slip_is_no_number(verb: list[str], slip: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        build_parser().parse_args([*verb, slip])
    assert ended.value.code == 2
    assert "not a number such as 400" in capsys.readouterr().err or slip.startswith("- ")


@pytest.mark.parametrize("slip", ["1_0", "\u0661", "1.0", "1e1", "9" * 5000])
def test_a_whole_number_is_one_of_plain_digits(slip: str) -> None:
    with pytest.raises(SystemExit):
        build_parser().parse_args(["watch", "--every", slip])


@given(value=st.floats(allow_nan=False))
def test_every_number_can_be_typed_as_python_writes_it(value: float) -> None:
    assert decimal(repr(value)) == value == decimal(f" {value!r} ")


def test_a_number_that_is_none_is_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        build_parser().parse_args(["move", "x=far"])
    assert "x=far" in capsys.readouterr().err
