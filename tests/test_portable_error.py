"""Errors that processes tell each other."""

import importlib
import inspect
import pickle
import pkgutil

import pytest

import twostage_servo
from twostage_servo.app.axes_preparation import Failure
from twostage_servo.app.reloading import ReadingError
from twostage_servo.app.start_error import StartError
from twostage_servo.axis.design import DesignError
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.config.errors import ConfigError, Problem
from twostage_servo.control.laws.law import DesignError as LawDesignError
from twostage_servo.drives.protocol_error import ProtocolError
from twostage_servo.portable_error import PortableError

ERRORS = [
    Refused(RefusalCode.BUSY, "it moves"),
    DesignError(("limits", "effort"), "too small"),
    LawDesignError(("encoder_noise",), "fragile"),
    ProtocolError(("protocol", "command"), "no such message"),
    ReadingError(Failure("it ended", "all of its log")),
    StartError("bus", "it does not open", is_usage=True),
    ConfigError([Problem("a.toml", 3, "axis.unit", '"furlong"', "unknown")]),
]
_AT_HOME = (
    "twostage_servo.cli.",
    "twostage_servo.client.",
    "twostage_servo.drives.frame",
    "twostage_servo.drives.dbc.signal_codec",
)
"""Those that no other process is told of: what becomes of a command or of a frame."""


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_another_process_is_told_all_of_an_error(error: PortableError) -> None:
    """A refusal in a worker of the fault campaign was taken for the worker's death (example1.toml, seed 2)."""
    told = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
    assert type(told) is type(error)
    assert str(told) == str(error)
    assert vars(told) == vars(error)


def test_every_error_that_takes_more_than_a_text_can_be_told() -> None:
    named = []
    for module in pkgutil.walk_packages(twostage_servo.__path__, "twostage_servo."):
        if module.name.endswith("__main__") or ".baselines" in module.name or module.name.startswith(_AT_HOME):
            continue
        for name, found in vars(importlib.import_module(module.name)).items():
            is_own = inspect.isclass(found) and found.__module__ == module.name and issubclass(found, Exception)
            if is_own and "__init__" in vars(found):
                named.append(name)
                assert issubclass(found, PortableError), found
    assert len(named) >= len(ERRORS)
