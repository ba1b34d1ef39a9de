"""The parser of one verb, and that of the whole command line."""

import argparse

import pytest

from twostage_servo.cli.main import build_parser
from twostage_servo.cli.operate import VERBS


def of_verbs(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    (choices,) = [action.choices for action in parser._actions if action.dest == "verb"]
    return dict(choices)  # type: ignore[arg-type]


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_that_is_declared_alone_takes_what_it_takes_among_all(verb: str) -> None:
    alone = of_verbs(build_parser(verb))
    assert list(alone) == [verb]
    assert alone[verb].format_help() == of_verbs(build_parser())[verb].format_help()


@pytest.mark.parametrize("given", [None, "demo", "nonsense", "--help"])
def test_without_one_of_the_operators_every_verb_is_declared(given: str | None) -> None:
    declared = of_verbs(build_parser(given))
    assert set(VERBS) < set(declared)
    assert {"demo", "run", "check", "faults", "paper", "install-service"} <= set(declared)
