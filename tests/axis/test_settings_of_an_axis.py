"""Defaults and bounds of `[axis]`, each against a table by hand, and which settings do not fit together."""

import pickle
from typing import Any

import pytest
from pydantic import ValidationError

from tests.axis.rig import DEMO
from twostage_servo.axis.law_settings import LawSettings, choose_law
from twostage_servo.axis.settings import (
    ApproachSettings,
    AxisSettings,
    HomingSettings,
    LimitSettings,
    ObserverSettings,
    PlantSettings,
    WindowSettings,
)
from twostage_servo.control.laws.paper_type import PaperSettings
from twostage_servo.control.laws.registry import LAWS
from twostage_servo.settings.base import Settings

NUMBERS: dict[type[Settings], str] = {
    PlantSettings: """
        gain                                 >= -1e9  <= 1e9
        pole                                 >= 0.001 <= 10000""",
    PaperSettings: """
        performance_index_ratio    = 0.00005 >= 1e-12 <= 1e6""",
    ObserverSettings: """
        position_variance          = 0.1     >= 0     <= 1e9
        velocity_variance          = 0.1     >= 0     <= 1e9
        disturbance_variance       = 0.1     >= 1e-12 <= 1e9
        measurement_variance       = 0.01    >= 1e-12 <= 1e9
        disturbance_memory         = 1       >= 0     <= 1""",
    LimitSettings: """
        position_minimum                     >= -1e9  <= 1e9
        position_maximum                     >= -1e9  <= 1e9
        position_overrun                     > 0      <= 1e9
        velocity                             > 0      <= 1e9
        overspeed                            > 0      <= 1e9
        acceleration                         > 0      <= 1e12
        quick_stop_deceleration              > 0      <= 1e12
        effort                               > 0      <= 1e9
        effort_rate                          > 0      <= 1e12
        effort_saturation_ms                 > 0      <= 60000
        following_error_minimum              > 0      <= 1e9
        following_error_time_s               >= 0     <= 60
        innovation_gate                      > 0      <= 1e9
        innovation_time_ms                   >= 0     <= 100
        stall_effort                         > 0      <= 1e9
        stall_time_ms                          > 0      <= 60000
        stale_feedback_ms                    > 0      <= 10000
        feedback_errors                      >= 1     <= 100
        heartbeat_ms                         > 0      <= 60000
        missed_ticks                         >= 0     <= 1000""",
    WindowSettings: """
        position                             > 0      <= 1e9
        time_ms                              >= 0     <= 60000""",
    HomingSettings: """
        position                   = 0       >= -1e9  <= 1e9
        velocity                   = 20      > 0      <= 1e9
        slow_velocity              = 5       > 0      <= 1e9
        effort                     = 5       > 0      <= 1e9
        stop_time_ms               = 200     > 0      <= 60000
        back_off                   = 0       >= 0     <= 1e9
        travel                     = 1000    > 0      <= 1e9""",
    ApproachSettings: """
        distance                   = 1       > 0      <= 1e9""",
    AxisSettings: """
        cruise_velocity                      > 0      <= 1e9
        arming_timeout_ms          = 500     > 0      <= 60000
        jog_timeout_ms             = 300     > 0      <= 2000""",
}
"""Each number of each table: its default, where it has one, and its bounds."""

SCHEMA_WORDS = {"=": "default", ">": "exclusiveMinimum", ">=": "minimum", "<=": "maximum"}


@pytest.mark.parametrize("table", NUMBERS)
def test_every_number_has_its_default_and_its_bounds(table: type[Settings]) -> None:
    schema = table.model_json_schema()["properties"]
    declared = {
        name: {word: field[word] for word in SCHEMA_WORDS.values() if word in field}
        for name, field in schema.items()
        if field.get("type") in {"number", "integer"}
    }
    rows = [line.split() for line in NUMBERS[table].split("\n") if line.strip()]
    expected = {
        name: {SCHEMA_WORDS[word]: float(number) for word, number in zip(row[::2], row[1::2], strict=True)}
        for name, *row in rows
    }
    assert declared == expected


def test_what_is_no_number_has_its_default_and_its_bounds() -> None:
    homing, approach = HomingSettings(), ApproachSettings()
    assert (homing.required, homing.method, homing.direction) == (False, "set_here", "negative")
    assert approach.direction == "either"
    assert AxisSettings.model_validate({key: DEMO[key] for key in DEMO if key != "name"}).name == "axis"
    for key, longest in (("name", 64), ("unit", 16), ("effort_unit", 16)):
        assert not refused({key: "x"})
        assert not refused({key: "x" * longest})
        assert refused({key: "x" * (longest + 1)})
        assert refused({key: ""})


@pytest.mark.parametrize("name", ["a\nb", "\x1b[31m", "\x00", "a\x7f"])
def test_a_name_is_one_line_of_what_can_be_shown(name: str) -> None:
    assert refused({"name": name})
    assert not refused({"name": "Achse ü=1 / links"})


def refused(changes: dict[str, Any]) -> str:
    """Return what the demo's axis with these changes is refused with, or nothing."""
    tables = {key: DEMO.get(key, {}) | value if isinstance(value, dict) else value for key, value in changes.items()}
    try:
        AxisSettings.model_validate(DEMO | tables)
    except ValidationError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"plant": {"gain": 1e-9}}, ""),
        ({"plant": {"gain": -1e-9}}, ""),
        ({"plant": {"gain": 0.99e-9}}, "gain"),
        ({"plant": {"gain": -0.99e-9}}, "gain"),
        ({"plant": {"gain": 0.0}}, "gain"),
        ({"limits": {"position_minimum": 2499.9}}, ""),
        ({"limits": {"position_minimum": 2500.0}}, "position_minimum"),
        ({"limits": {"position_minimum": 2500.1}}, "position_minimum"),
        ({"limits": {"quick_stop_deceleration": 2000.0}}, ""),
        ({"limits": {"quick_stop_deceleration": 1999.9}}, "quick_stop_deceleration"),
        ({"limits": {"overspeed": 250.1}}, ""),
        ({"limits": {"overspeed": 250.0}}, "overspeed"),
        ({"limits": {"overspeed": 249.9}}, "overspeed"),
        ({"limits": {"stall_effort": 24.0}}, ""),
        ({"limits": {"stall_effort": 24.1}}, "stall_effort"),
        ({"cruise_velocity": 250.0}, ""),
        ({"cruise_velocity": 250.1}, "cruise_velocity"),
        ({"homing": {"velocity": 250.0, "slow_velocity": 250.0}}, ""),
        ({"homing": {"velocity": 250.1}}, "homing.velocity"),
        ({"homing": {"slow_velocity": 250.1}}, "homing.slow_velocity"),
        ({"homing": {"effort": 24.0}}, ""),
        ({"homing": {"effort": 24.1}}, "homing.effort"),
    ],
)
def test_what_does_not_fit_together_is_refused_by_name_and_what_just_fits_is_not(
    changes: dict[str, Any], word: str
) -> None:
    message = refused(changes)
    assert bool(message) is bool(word)
    assert word in message


@pytest.mark.parametrize(
    ("homing", "refused"),
    [
        ({"position": 2519.0}, False), ({"position": 2521.0}, True), ({"position": -3000.0}, True),
        ({"position": 1e9}, True), ({"method": "switch", "position": 3000.0}, True),
        ({"method": "index", "position": -2520.5}, True), ({"method": "index", "position": -2519.5}, False),
        # A hard stop may lie outside: where the axis is when it has left it counts.
        ({"method": "hard_stop", "position": -2530.0, "back_off": 40.0}, False),
        ({"method": "hard_stop", "position": -2530.0}, True),
        ({"method": "hard_stop", "position": 2530.0, "back_off": 40.0}, True),
        ({"method": "hard_stop", "position": 2530.0, "back_off": 40.0, "direction": "positive"}, False),
    ],
)  # fmt: skip
def test_a_reference_where_the_axis_would_trip_is_refused(homing: dict[str, Any], *, refused: bool) -> None:
    if not refused:
        AxisSettings.model_validate(DEMO | {"homing": homing})
        return
    with pytest.raises(ValidationError, match=r"homing.position = .* outside limits.position_minimum = -2500 to .* 20"):
        AxisSettings.model_validate(DEMO | {"homing": homing})


def test_a_reference_that_is_not_given_need_not_lie_within_the_limits() -> None:
    """The axis may have an absolute encoder, or be homed by `home --here POSITION` alone."""
    for homing in ({}, {"required": True}):
        AxisSettings.model_validate(DEMO | {"homing": homing, "limits": DEMO["limits"] | {"position_minimum": 100.0}})
    with pytest.raises(ValidationError, match=r"homing\.position = 0"):
        AxisSettings.model_validate(
            DEMO | {"homing": {"method": "switch"}, "limits": DEMO["limits"] | {"position_minimum": 100.0}}
        )


# The law --------------------------------------------------------------------------------------------------------------


def test_the_keys_of_a_law_are_those_of_each_that_is_installed() -> None:
    fields = LawSettings.all_fields()
    assert fields["adaptive"].annotation is LAWS.get("adaptive").settings
    assert fields["paper"] is LawSettings.model_fields["paper"]


@pytest.mark.parametrize("value", [{"typo": 3}, {"memory": "none"}, {"paper": {}}, {"type": "paper"}, "adaptive"])
def test_no_law_is_looked_for_that_is_not_named(value: object) -> None:
    """What is wrong there is told with everything else that is, later."""
    assert choose_law(value) is value


def test_the_keys_of_a_law_that_nobody_has_named_are_its_defaults() -> None:
    law = LAWS.get("adaptive")
    assert LawSettings.all_fields()["adaptive"].default == law.settings()


def test_the_name_of_a_law_has_64_characters_at_most() -> None:
    for length, words in ((64, "no law is called"), (65, "at most 64 characters")):
        with pytest.raises(ValidationError, match=words):
            LawSettings(type="x" * length)


@pytest.mark.parametrize("given", [{}, {"type": "paper"}, {"type": "adaptive"}, {"memory": "none"}])
def test_a_law_without_a_type_is_told_and_one_with_a_type_is_not(given: dict[str, Any]) -> None:
    told = AxisSettings.model_validate(DEMO | {"law": given}).law.unnamed
    assert ('keeps the law "paper"; type = "adaptive" settles sooner' in told) is ("type" not in given)
    assert bool(told) is ("type" not in given)


@pytest.mark.parametrize("law", [{"type": "paper"}, {"type": "adaptive", "adaptive": {"encoder_noise": 0.5}}])
def test_settings_go_to_another_process_and_back(law: dict[str, Any]) -> None:
    there = AxisSettings.model_validate(DEMO | {"law": law})
    back = pickle.loads(pickle.dumps(there))  # noqa: S301 - our own
    assert back == there
    assert back.law.keys == there.law.keys
