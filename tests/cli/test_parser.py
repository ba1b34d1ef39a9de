"""The parser of one verb, and that of the whole command line."""

import argparse
import json

import pytest

from twostage_servo.cli.main import LONG_RUNNING, build_parser, main
from twostage_servo.cli.operate import VERBS


def of_verbs(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    (choices,) = [action.choices for action in parser._actions if action.dest == "verb"]
    return dict(choices)  # type: ignore[arg-type]


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_that_is_declared_alone_takes_what_it_takes_among_all(verb: str) -> None:
    alone = of_verbs(build_parser(verb))
    assert list(alone) == [verb]
    assert alone[verb].format_help() == of_verbs(build_parser())[verb].format_help()


@pytest.mark.parametrize("verb", LONG_RUNNING)
def test_one_that_runs_for_long_is_declared_without_those_of_other_modules(verb: str) -> None:
    declared = of_verbs(build_parser(verb))
    assert tuple(declared) == LONG_RUNNING
    assert declared[verb].format_help() == of_verbs(build_parser())[verb].format_help()


@pytest.mark.parametrize("given", [None, "demo", "nonsense", "--help"])
def test_with_any_other_every_verb_is_declared(given: str | None) -> None:
    declared = of_verbs(build_parser(given))
    assert {*VERBS, *LONG_RUNNING} < set(declared)
    assert {"demo", "run", "check", "faults", "paper", "install-service"} <= set(declared)


@pytest.mark.parametrize(
    ("typed", "why"),
    [
        (["jog", "x", "--json"], "'x' is not a number"),
        (["jog", "--js"], "velocity"),
        (["check", "--json", "--nonsense"], "--nonsense"),
        (["nonsense", "--json"], "nonsense"),
        (["--json"], "VERB"),
    ],
)
def test_bad_usage_is_told_in_json_where_that_is_asked_for(
    typed: list[str], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(typed)
    told = json.loads(capsys.readouterr().out)
    assert ended.value.code == 2
    assert (told["ok"], told["error"]["code"]) == (False, "usage")
    assert why in told["error"]["message"]


@pytest.mark.parametrize(
    ("typed", "why"),
    [
        (["status", "--socket", ""], "--socket: the path is empty: name a file, or leave the option out"),
        (["status", "--recording", ""], "--recording: the path is empty"),
        (["check", "--config", ""], "--config: the path is empty"),
        (["status", "--socket", "s", "--config", "c"], "not allowed with"),
        (["status", "--axis", "\udce4"], r"'\udce4' is not UTF-8"),
        (["move", "\udce4=1"], r"'\udce4' is not UTF-8"),
    ],
)
def test_names_that_cannot_be_meant_are_bad_usage(
    typed: list[str], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        build_parser().parse_args(typed)
    assert why in capsys.readouterr().err


def test_a_name_is_read_as_utf_8_where_the_locale_knows_ascii_alone() -> None:
    ascii_only = "µ".encode().decode("ascii", "surrogateescape")
    parser = build_parser()
    assert parser.parse_args(["arm", "--axis", ascii_only]).axis == "µ"
    assert parser.parse_args(["move", f"{ascii_only}=1"]).position == [("µ", 1.0)]
    assert parser.parse_args(["check", "--set", f"axis.unit={ascii_only}m"]).overrides == ["axis.unit=µm"]
