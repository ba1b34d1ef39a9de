"""What would trip an armed axis keeps a disarmed one from being armed or reset: by a refusal of the same name."""

import inspect
import re

import pytest

from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.axis.hazards import Hazards
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.trips import TripCode

ONLY_WHILE_ARMED = {"STALE_FEEDBACK", "DRIVE_DROPPED_OUT"}
"""Without fresh feedback the refusal is `no_feedback`, and a drive that is off has not dropped out."""


def codes_in(*functions: object) -> list[str]:
    found = {name for one in functions for name in re.findall(r"TripCode\.(\w+)", inspect.getsource(one))}  # type: ignore[arg-type]
    return sorted(found - ONLY_WHILE_ARMED)


def test_there_are_such_trips() -> None:
    assert {"DRIVE_FAULT", "DRIVE_NOT_DISABLED"} <= set(codes_in(DriveReport.troubles, Hazards))


@pytest.mark.parametrize("name", codes_in(DriveReport.troubles, Hazards))
def test_each_has_a_refusal_of_the_same_name(name: str) -> None:
    assert RefusalCode(TripCode[name].value).value == TripCode[name].value
