"""The campaign on axes of another unit, tick and drive, and on a machine of several axes."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from twostage_servo.axis.trip_latch import TripLatch
from twostage_servo.config.loader import Config, LoadedConfig, load
from twostage_servo.config.machine import load_machine
from twostage_servo.faults.campaign import Campaign
from twostage_servo.faults.cell import Cell
from twostage_servo.faults.limits import Motion
from twostage_servo.faults.phase import BRAKED, Phase
from twostage_servo.faults.table import TABLE
from twostage_servo.faults.world import World
from twostage_servo.service.axis_group import AxisGroup
from twostage_servo.service.log import open_log

pytestmark = pytest.mark.long

CONFIGURATIONS = Path("config")
OTHERS = sorted(path.stem for path in CONFIGURATIONS.glob("*.toml") if path.stem != "demo")
SHARE = [(1, Phase.CRUISING), (2, Phase.SETTLING), (26, Phase.JOGGING), (30, Phase.IDLE), (36, Phase.HOLDING)]


@pytest.fixture(autouse=True)
def _quiet(tmp_path: Path) -> Iterator[None]:
    with (tmp_path / "log").open("w") as nowhere:
        writer = open_log("critical", nowhere)
        yield
        writer.close()


def cells(campaign: Campaign, number: int, phase: Phase) -> list[Cell]:
    return [campaign.run(fault, phase) for fault in TABLE if fault.number == number and phase in fault.phases]


def configuration(name: str) -> Path:
    return CONFIGURATIONS / f"{name}.toml"


@pytest.mark.parametrize("name", ["free_running", "metres", "plain_drive", "rotary_table"])
@pytest.mark.parametrize(("number", "phase"), SHARE)
def test_a_share_of_the_faults_is_met_elsewhere(name: str, number: int, phase: Phase) -> None:
    for cell in cells(Campaign(load(configuration(name)), seed=3), number, phase):
        assert cell.met, cell


@pytest.mark.parametrize(
    ("name", "number", "phase"),
    [
        ("example2", 20, Phase.IDLE),  # an effort that grows against an encoder that stands still from rest on
        ("example2", 20, Phase.HOLDING),
        ("free_running", 21, Phase.HOMING),  # slow, and in the middle of a period
        ("free_running", 22, Phase.HOMING),
    ],
)
def test_an_encoder_that_fails_from_rest_or_at_a_low_speed_is_told_in_time(
    name: str, number: int, phase: Phase
) -> None:
    for cell in cells(Campaign(load(configuration(name)), seed=1), number, phase):
        assert cell.met, cell
        assert not cell.limit


def test_each_shipped_configuration_has_its_matrix_in_the_docs() -> None:
    page = Path("docs/faults-of-other-configurations.md").read_text("utf-8")
    assert re.findall(r"<!-- faults (\w+): begin -->", page) == OTHERS
    assert "<!-- faults demo: begin -->" in Path("docs/faults.md").read_text("utf-8")


# Units and ticks -----------------------------------------------------------------------------------------------------


def in_metres() -> LoadedConfig[Config]:
    """Return the demo's axis, counted in m: the same machine."""
    loaded = load(None)
    axis = loaded.config.axis
    lengths = {"position_minimum", "position_maximum", "position_overrun", "velocity", "overspeed", "acceleration"}
    lengths |= {"quick_stop_deceleration", "following_error_minimum", "innovation_gate"}
    overrides = [f"axis.limits.{name}={1e-3 * getattr(axis.limits, name)!r}" for name in lengths]
    overrides += [
        'axis.unit="m"', "axis.cruise_velocity=0.1", "axis.plant.gain=0.18", "axis.window.position=0.00005",
        "axis.law.performance_index_ratio=50.0", "axis.observer.position_variance=1e-7",
        "axis.observer.velocity_variance=1e-7", "axis.observer.measurement_variance=1e-8",
        "axis.homing.velocity=0.02", "axis.homing.slow_velocity=0.005", "axis.homing.travel=1.0",
        "axis.approach.distance=0.001", "protocol.feedback.position_scale=0.001", "simulation.gain=0.18",
        "simulation.quantum=1e-6",
    ]  # fmt: skip
    return load(None, overrides)


@pytest.mark.parametrize(
    ("number", "phase"),
    [
        (2, Phase.CRUISING),
        (19, Phase.JOGGING),
        (21, Phase.ACCELERATING),
        (30, Phase.IDLE),
        (31, Phase.HOLDING),
        (34, Phase.CRUISING),
        (36, Phase.CHANGEOVER),
        (43, Phase.IDLE),
    ],
)
def test_the_same_axis_in_metres_goes_the_same_way(number: int, phase: Phase) -> None:
    millimetres, metres = Campaign(load(None), seed=1), Campaign(in_metres(), seed=1)
    for ours, theirs in zip(cells(millimetres, number, phase), cells(metres, number, phase), strict=True):
        assert theirs.met, theirs
        assert (theirs.observed, theirs.trip) == (ours.observed, ours.trip)
        assert theirs.travel == pytest.approx(1e-3 * ours.travel, abs=5e-6)
        assert theirs.bound == pytest.approx(1e-3 * ours.bound, rel=1e-6)


@pytest.mark.parametrize(
    ("tick_ms", "overrides"),
    [
        (
            1.0,
            [
                "axis.limits.stale_feedback_ms=3",
                "simulation.feedback_period_ms=2",
                "simulation.command_timeout_ms=30",
                "axis.observer.measurement_variance=3e-4",
            ],
        ),
        (
            50.0,
            [
                "axis.limits.stale_feedback_ms=150",
                "simulation.feedback_period_ms=100",
                "axis.limits.innovation_gate=2",
                "axis.limits.undetected_travel=50",
                "simulation.command_timeout_ms=500",
                "axis.limits.stall_time_ms=250",
                "axis.limits.missed_ticks=1",
            ],
        ),
    ],
)
@pytest.mark.parametrize(("number", "phase"), [(2, Phase.CRUISING), (23, Phase.HOLDING), (26, Phase.CRUISING)])
def test_any_tick_will_do(tick_ms: float, overrides: list[str], number: int, phase: Phase) -> None:
    campaign = Campaign(load(None, [f"service.tick_ms={tick_ms}", *overrides]), seed=1)
    for cell in cells(campaign, number, phase):
        assert cell.met, cell


# What cannot be ------------------------------------------------------------------------------------------------------


def test_what_a_drive_cannot_have_is_not_applicable_and_says_why() -> None:
    campaign = Campaign(load(configuration("plain_drive")), seed=1)
    reasons = {(one.fault, one.phase): one.reason for one in campaign.not_applicable()}
    assert "no counter" in reasons[5, "cruising"]
    assert "no heartbeat" in reasons[35, "holding"]
    assert "no home switch" in reasons[2, "homing"]
    ran = {(fault.name, phase.value) for fault, phase in campaign.cells()}
    everything = {(fault.name, phase.value) for fault in TABLE for phase in fault.phases}
    assert ran | {(one.name, one.phase) for one in campaign.not_applicable()} == everything
    assert not ran & {(one.name, one.phase) for one in campaign.not_applicable()}
    assert all(reason for reason in reasons.values())


@pytest.mark.parametrize(("name", "states"), [("demo", False), ("metres", False), ("example2", True)])
def test_a_halved_scale_is_a_stated_limit_only_where_it_hides_what_the_model_is_off_by(name: str, states: bool) -> None:
    halved = next(fault for fault in TABLE if fault.name == "scale halved")
    campaign = Campaign(load(configuration(name)), seed=1)
    config = campaign.loaded.config
    assert bool(halved.limit(Motion(config, campaign.design, config.axis.cruise_velocity))) is states
    assert len(halved.phases) <= 10


def test_the_travel_of_a_stated_limit_is_bounded_by_twice_the_way() -> None:
    halved = next(fault for fault in TABLE if fault.name == "scale halved")
    cell = Campaign(load(configuration("example2")), seed=1).run(halved, Phase.HOLDING)
    assert (cell.met, cell.expected, cell.observed) == (True, "Q", "T")
    assert "one encoder cannot tell" in cell.limit
    assert 100.0 < cell.travel < cell.bound < 300.0


# Stopping ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", BRAKED)
def test_a_fault_in_a_stop_begins_while_the_axis_brakes(phase: Phase) -> None:
    jump = next(fault for fault in TABLE if fault.number == 19)
    seen: list[tuple[str, float]] = []

    def look(world: World, random: Random) -> None:
        seen.append((world.axis.state, world.drive.velocity))
        jump.inject(world, random)

    fault = dataclasses.replace(jump, inject=look)
    assert Campaign(load(None, ["axis.limits.acceleration=400"]), seed=1).run(fault, phase).observed != "T"
    ((state, velocity),) = seen
    assert state == ("stopping" if phase is Phase.STOPPING else "quick_stopping")
    assert abs(velocity) > 5.0


# Several axes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policy", "axis"), [("continue", "x"), ("stop", "x"), ("quick_stop", "x"), ("disarm", "x"), ("stop", "y")]
)
def test_the_others_do_what_the_machine_says(policy: str, axis: str) -> None:
    machine = load_machine(configuration("two_axes"), [f"machine.fault_reaction={policy}"])
    campaign = Campaign(machine, 1, axis)
    for number, phase in ((26, Phase.CRUISING), (2, Phase.HOLDING), (1, Phase.CRUISING), (16, Phase.CRUISING)):
        for cell in cells(campaign, number, phase):
            assert cell.met, cell
            assert cell.axis == axis


def test_an_axis_that_goes_on_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AxisGroup, "react", lambda *_: None)
    (cell,) = cells(Campaign(load_machine(configuration("two_axes")), 1, "x"), 26, Phase.CRUISING)
    assert (cell.met, cell.wrong) == (False, "axis y is jogging, not holding")


def test_an_axis_that_trips_with_another_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def trip_both(latch: TripLatch, code: object, cause: str) -> None:
        raise_trip(latch, code, cause)  # type: ignore[arg-type]
        for other in latches:
            if other is not latch:
                raise_trip(other, code, cause)  # type: ignore[arg-type]

    latches: list[TripLatch] = []
    make = TripLatch.__init__

    def remember(latch: TripLatch, *given: object, **named: object) -> None:
        make(latch, *given, **named)  # type: ignore[arg-type]
        latches.append(latch)

    raise_trip = TripLatch.raise_trip
    campaign = Campaign(load_machine(configuration("two_axes")), 1, "x")
    fault = next(fault for fault in TABLE if fault.number == 26)
    campaign._reference(Phase.CRUISING, fault)
    monkeypatch.setattr(TripLatch, "__init__", remember)
    monkeypatch.setattr(TripLatch, "raise_trip", trip_both)
    assert "axis y tripped as well" in campaign.run(fault, Phase.CRUISING).wrong


def test_a_search_slower_than_a_change_shows_is_a_stated_limit_and_a_faster_motion_is_none() -> None:
    """On a tick of 1 ms `check` says 31 mm/s; the search goes 20 mm/s and a little more, the cruise 100 mm/s."""
    campaign = Campaign(load(None, ["axis.law.type=paper", "service.tick_ms=1"]), seed=1)
    halved = next(fault for fault in TABLE if fault.name == "scale halved")
    cell = campaign.run(halved, Phase.HOMING)
    assert (cell.met, cell.expected, cell.observed) == (True, "Q", "T")
    assert "certain_from_velocity" in cell.limit
    for fault in (fault for fault in TABLE if fault.number in {21, 22}):
        assert fault.limit(Motion(campaign.loaded.config, campaign.design, 100.0)) == ""
        assert fault.limit(Motion(campaign.loaded.config, campaign.design, 20.0))


@pytest.mark.parametrize("phase", [Phase.STOPPING, Phase.QUICK_STOPPING])
@pytest.mark.parametrize("seed", [2, 4])
@pytest.mark.parametrize("plant", [(126.0, 18.2), (126.0, 14.0), (234.0, 9.8)])
def test_a_sign_that_turns_as_a_stop_begins_is_told_on_a_plant_off_its_model_behind_a_wide_gate(
    plant: tuple[float, float], seed: int, phase: Phase
) -> None:
    """What plant it is, nothing has told by then; the axis ran away against its stop, by up to 160 mm."""
    gain, pole = plant
    overrides = [f"simulation.gain={gain}", f"simulation.pole={pole}", "axis.limits.innovation_gate=5"]
    (cell,) = cells(Campaign(load(None, overrides), seed), 21, phase)
    assert cell.met, cell
    assert cell.trip in {"sign_reversed", "model_mismatch"}
    assert cell.travel < 12.0


@pytest.mark.parametrize(
    ("name", "seed", "number", "phase"),
    [
        ("example2", 2, 21, Phase.STOPPING),
        ("example2", 3, 21, Phase.QUICK_STOPPING),
        ("example2", 3, 31, Phase.ACCELERATING),  # a load that helps, while the axis begins to move
        ("metres", 2, 28, Phase.ACCELERATING),  # a controlled stop that nothing follows
        ("example1", 3, 36, Phase.IDLE),  # after a suspension two noisy samples look like a speed
    ],
)
def test_what_other_seeds_have_found_is_met(name: str, seed: int, number: int, phase: Phase) -> None:
    for cell in cells(Campaign(load(configuration(name)), seed), number, phase):
        assert cell.met, cell


def test_an_encoder_that_turns_round_as_an_axis_settles_is_told_within_ten_gates() -> None:
    """With the adaptive law and seed 4 it took 5.3 mm of 5: the error grew slowly, as behind a load."""
    campaign = Campaign(load(None, ["axis.law.type=adaptive"]), seed=4)
    reversed_encoder = next(fault for fault in TABLE if fault.number == 21)
    cell = campaign.run(reversed_encoder, Phase.SETTLING)
    assert (cell.met, cell.trip) == (True, "sign_reversed")
    assert cell.travel < 5.0
