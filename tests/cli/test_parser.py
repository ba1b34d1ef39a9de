"""The parser of one verb, and that of the whole command line."""

import argparse

import pytest

from twostage_servo.cli.main import LONG_RUNNING, build_parser
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
