"""What is wrong with a drive at this moment, case by case; the drive, its state and what watches it stand in."""

from types import SimpleNamespace
from typing import Any

import pytest

from tests.axis.rig import axis_settings
from twostage_servo.axis.hazards import Hazards
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode


class Foreign(SimpleNamespace):
    """Somebody else's commands."""

    def __str__(self) -> str:
        return "0x12 twice"


def hazards(
    state: State = State.DISARMED,
    *,
    lasts: bool = False,
    came: bool = False,
    enables: bool | None = None,
    enabled: bool | None = False,
    **watched: Any,
) -> Hazards:
    foreign = Foreign(lasts=lasts, came_within=lambda told_ms: came and told_ms == 40.0)
    foreign.latest = SimpleNamespace(enables=enables)
    drive: Any = SimpleNamespace(states=SimpleNamespace(contradiction=""), foreign=foreign, enabled=enabled)
    seen = {
        "not_disabled": False, "silent_while_enabled": False, "seen_enabled": False, "moved": None, "told_ms": 40.0,
        "enabled_ms": 30.0, "silent_ms": 20.0,
    }  # fmt: skip
    disabled: Any = SimpleNamespace(**(seen | watched))
    machine: Any = SimpleNamespace(state=state)
    return Hazards(axis_settings(), machine, drive, disabled)


def codes(found: Hazards) -> tuple[list[TripCode], list[TripCode]]:
    return [one.code for one in found.present(7)], [one.code for one in found.lasting(7)]


FOREIGN = TripCode.FOREIGN_COMMAND


@pytest.mark.parametrize(
    ("state", "lasts", "seen_enabled", "enabled", "enables", "trips", "told"),
    [
        (State.DISARMED, True, True, True, None, True, True),
        (State.DISARMED, True, False, False, True, False, True),  # the drive says that it is off
        (State.DISARMED, True, False, None, True, True, True),  # it says nothing, and has been told to enable
        (State.DISARMED, True, False, None, None, True, True),
        (State.DISARMED, True, False, None, False, False, True),
        (State.DISARMED, False, True, True, True, False, False),
        (State.HOLDING, True, True, True, True, False, True),  # it is to be enabled: another check trips
    ],
)
def test_another_node_that_commands_the_drive(
    state: State, lasts: bool, seen_enabled: bool, enabled: bool | None, enables: bool | None, trips: bool, told: bool
) -> None:
    found = hazards(state, lasts=lasts, seen_enabled=seen_enabled, enabled=enabled, enables=enables)
    assert codes(found) == ([FOREIGN] * trips, [FOREIGN] * told)


@pytest.mark.parametrize("came", [True, False])
@pytest.mark.parametrize("moved", [None, -3.25])
def test_a_drive_that_stays_enabled_is_told_with_what_happened_since(came: bool, moved: float | None) -> None:
    (trip,) = hazards(came=came, moved=moved, not_disabled=True).present(7)
    assert (trip.code, trip.tick) == (TripCode.DRIVE_NOT_DISABLED, 7)
    assert "was told to disable 40 ms ago, and has since reported for 30 ms that it is enabled" in trip.cause
    assert ("; another node on the bus has commanded it: 0x12 twice" in trip.cause) is came
    assert ("; the axis has moved by -3.25 mm meanwhile" in trip.cause) is (moved is not None)


def test_a_drive_that_has_fallen_silent_is_told_and_trips_nothing() -> None:
    found = hazards(silent_while_enabled=True)
    assert codes(found) == ([], [TripCode.STALE_FEEDBACK])
    assert "has been silent for 20 ms" in found.lasting(7)[0].cause
