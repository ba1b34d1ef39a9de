"""The campaign itself: what it injects is met, and what it reports can fail."""

import asyncio
import dataclasses
import json
import re
import resource
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any, cast

import pytest

from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.requests import Requests
from twostage_servo.axis.supervision import Supervision
from twostage_servo.axis.trip_latch import TripLatch
from twostage_servo.axis.trips import TripCode
from twostage_servo.cli.main import main
from twostage_servo.config.loader import load
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.faults.campaign import Campaign
from twostage_servo.faults.cell import Cell, NotApplicable
from twostage_servo.faults.configuration import ConfigurationFaults
from twostage_servo.faults.phase import Phase
from twostage_servo.faults.report import as_json, as_markdown, as_page, as_text
from twostage_servo.faults.runner import Result
from twostage_servo.faults.table import MEANINGS, TABLE, Fault
from twostage_servo.faults.world import World
from twostage_servo.service.ending_signals import EndingSignals
from twostage_servo.service.log import open_log
from twostage_servo.service.socket_file import SocketFile
from twostage_servo.telemetry.trip_files import TripFiles

pytestmark = pytest.mark.long

SHARE = [
    (1, Phase.CRUISING), (2, Phase.CHANGEOVER), (3, Phase.HOLDING), (7, Phase.ACCELERATING), (8, Phase.CRUISING),
    (10, Phase.SETTLING), (11, Phase.CRUISING), (13, Phase.IDLE), (15, Phase.CRUISING), (16, Phase.ACCELERATING),
    (17, Phase.CRUISING), (18, Phase.SETTLING), (19, Phase.CRUISING), (20, Phase.SETTLING), (21, Phase.HOLDING),
    (22, Phase.IDLE), (24, Phase.CRUISING), (27, Phase.HOLDING), (28, Phase.CRUISING), (29, Phase.ACCELERATING),
    (30, Phase.SETTLING), (31, Phase.HOLDING), (33, Phase.CRUISING), (34, Phase.HOLDING), (35, Phase.CRUISING),
    (36, Phase.CRUISING), (36, Phase.HOMING), (26, Phase.JOGGING),
    (40, Phase.CRUISING), (41, Phase.CRUISING), (43, Phase.CRUISING), (44, Phase.CHANGEOVER),
    (45, Phase.HOLDING), (46, Phase.CRUISING), (49, Phase.SETTLING), (51, Phase.CRUISING), (52, Phase.CRUISING),
    (53, Phase.CRUISING), (12, Phase.HOLDING),
    (55, Phase.IDLE), (55, Phase.CRUISING), (56, Phase.HOLDING), (57, Phase.JOGGING),
    (61, Phase.CRUISING), (61, Phase.HOLDING), (62, Phase.CRUISING), (63, Phase.IDLE), (63, Phase.CRUISING),
    (64, Phase.JOGGING), (65, Phase.HOLDING),
    (58, Phase.CRUISING), (58, Phase.IDLE), (59, Phase.CRUISING), (60, Phase.SETTLING), (66, Phase.IDLE),
    (66, Phase.HOLDING),
]  # fmt: skip
"""One or two cells of each kind of fault; continuous integration runs them all."""


@pytest.fixture(autouse=True)
def _quiet(tmp_path: Path) -> Iterator[None]:
    with (tmp_path / "log").open("w") as nowhere:
        writer = open_log("critical", nowhere)
        yield
        writer.close()


@pytest.fixture(scope="module")
def campaign() -> Campaign:
    return Campaign(load(None), seed=11)


@pytest.mark.parametrize(("number", "phase"), SHARE, ids=str)
def test_a_share_of_the_faults_is_met(campaign: Campaign, number: int, phase: Phase) -> None:
    for fault in TABLE:
        if fault.number == number:
            cell = campaign.run(fault, phase)
            assert cell.met, cell


@pytest.mark.parametrize("number", [12, 13, 14, 15])
def test_what_happens_on_a_bus_with_can_fd_is_met_as_well(number: int) -> None:
    """Those faults make frames of their own, which have to be of the kind that the bus carries."""
    campaign = Campaign(load(None, ["bus.fd=true"]), seed=11)
    cells = [campaign.run(fault, Phase.CRUISING) for fault in TABLE if fault.number == number]
    assert cells
    assert all(cell.met for cell in cells), cells


def test_the_table_holds_every_fault_that_needs_neither_processes_nor_a_configuration_of_its_own() -> None:
    assert {fault.number for fault in TABLE} >= set(range(1, 67)) - {37, 38, 39, 42, 47, 48, 54}
    assert {phase for fault in TABLE for phase in fault.phases} == set(Phase)
    names = [(fault.number, fault.name) for fault in TABLE]
    assert len(set(names)) == len(names)


def test_the_same_seed_gives_the_same_cell_and_another_one_does_not(campaign: Campaign) -> None:
    fault = next(fault for fault in TABLE if fault.number == 19)
    first, again = (Campaign(load(None), seed=3).run(fault, Phase.CRUISING) for _ in range(2))
    assert first == again
    assert Campaign(load(None), seed=4).run(fault, Phase.CRUISING).travel != first.travel


def test_the_verdict_can_fail(campaign: Campaign) -> None:
    fault = next(fault for fault in TABLE if fault.number == 2)
    tolerant = dataclasses.replace(fault, expected="T", idle="T")
    assert not campaign.run(tolerant, Phase.CRUISING).met
    tight = dataclasses.replace(fault, bound=lambda _: 1e-3)
    cell = campaign.run(tight, Phase.CRUISING)
    assert cell.observed == cell.expected == "Q"
    assert not cell.met

    async def complain(_: World) -> str:
        return "something else"

    unhappy = dataclasses.replace(fault, check=complain)
    assert campaign.run(unhappy, Phase.CRUISING).wrong == "something else"


def test_what_is_injected_depends_on_the_limits_of_the_axis() -> None:
    """With a limit of 60 ms, six frames lost in a row trip, and the bound grows by what three ticks travel."""
    fault = next(fault for fault in TABLE if fault.number == 2)
    usual = Campaign(load(None, ["axis.law.type=paper"]), seed=1).run(fault, Phase.CRUISING)
    limits = ["axis.law.type=paper", "axis.limits.stale_feedback_ms=60"]
    patient = Campaign(load(None, limits), seed=1).run(fault, Phase.CRUISING)
    assert patient.met
    assert patient.travel - usual.travel == pytest.approx(3.0, abs=0.2)  # 100 mm/s for 30 ms
    assert patient.bound - usual.bound == pytest.approx(3.0, abs=0.2)


def test_a_gentler_quick_stop_travels_farther_and_is_allowed_to() -> None:
    fault = next(fault for fault in TABLE if fault.number == 19)
    hard = Campaign(load(None), seed=1).run(fault, Phase.CRUISING)
    gentle_limits = ["axis.limits.acceleration=400", "axis.limits.quick_stop_deceleration=400"]
    gentle = Campaign(load(None, gentle_limits), seed=1).run(fault, Phase.CRUISING)
    assert hard.met
    assert gentle.met
    # v^2 / 2a is 1.25 mm with 4000 mm/s2, and 12.5 mm with 400: friction alone would stop it after 7.1 mm.
    assert gentle.travel - hard.travel == pytest.approx(11.0, abs=2.0)


def test_the_policy_for_a_lost_holder_is_the_configurations() -> None:
    fault = next(fault for fault in TABLE if fault.number == 46)
    for policy, letter in (("continue", "T"), ("stop", "H"), ("disarm", "H")):
        cell = Campaign(load(None, [f"service.holder_lost={policy}"]), seed=2).run(fault, Phase.CRUISING)
        assert (cell.met, cell.observed) == (True, letter)


def test_faults_that_a_drive_cannot_have_are_left_out() -> None:
    without = [
        f"protocol.feedback.{role}=false"
        for role in ("safe_torque_off", "positive_limit", "negative_limit", "home_switch")
    ]
    numbers = {fault.number for fault, _ in Campaign(load(None, without), seed=1).cells()}
    assert not numbers & {33, 34}
    assert {2, 20, 35} <= numbers


def test_configuration_faults_are_refused_with_the_key() -> None:
    cells = list(ConfigurationFaults(None, ()).cells())
    assert [cell.fault for cell in cells] == [47, 47, 47, 47, 48, 48]
    assert all(cell.met for cell in cells), cells


def cell(**changes: object) -> Cell:
    usual = Cell(2, "frames <lost>", "cruising", "Q", "Q", "stale_feedback", 5.4321, 12.8, "")
    return dataclasses.replace(usual, **changes)  # type: ignore[arg-type]


def test_the_report_shows_each_cell_and_each_miss() -> None:
    cells = [cell(), cell(phase="holding", observed="T", trip="", travel=0.01)]
    campaign = Result(cells, [NotApplicable(33, "safe torque off", "cruising", "no such signal", "x")], {"x": "mm"})
    result = as_json(campaign, 7)
    assert (result["met"], result["missed"], result["seed"]) == (1, 1, 7)
    keys = {"axis", "fault", "name", "phase", "expected", "observed", "travel", "bound", "met", "limit"}
    assert all(keys <= set(one) for one in result["cells"])
    missing = {"axis": "x", "fault": 33, "name": "safe torque off", "phase": "cruising", "reason": "no such signal"}
    assert result["not_applicable"] == [missing]
    text = as_text(campaign)
    assert "NOT APPLICABLE 33 safe torque off, cruising: no such signal" in text
    assert "Q 5.43/12.8" in text
    assert "MISSED 2 frames <lost>, holding: expected Q, observed T, travel 0.010 of 12.800 mm" in text
    assert all(meaning in text for meaning in MEANINGS.values())
    assert text.splitlines()[0].split() == ["fault", "cruising", "holding"]  # the phases that were run
    assert "| 2 | frames <lost> | Q 6 / 13 | Q 0.01 / 13 **missed** |" in as_markdown(campaign)
    assert "- 33 safe torque off, cruising: no such signal." in as_markdown(campaign)
    page = as_page(campaign, 7, "Axis x")
    assert "frames &lt;lost&gt;" in page
    assert "frames <lost>" not in page
    assert "1 cells met, 1 missed" in page
    assert page.count('class="missed"') == 1


def test_a_stated_limit_is_met_within_its_bound_only() -> None:
    stated = cell(observed="T", limit="one encoder cannot tell", travel=5.0)
    assert stated.met
    assert not dataclasses.replace(stated, travel=13.0).met
    assert not dataclasses.replace(stated, limit="").met
    assert not dataclasses.replace(stated, wrong="something else").met
    text = as_markdown(Result([stated], [], {"x": "mm"}))
    assert "- 2 frames <lost>, cruising: one encoder cannot tell." in text
    assert "| T limit, 5 / 13 |" in text


def test_a_machine_has_a_matrix_for_each_axis() -> None:
    cells = [cell(axis="x"), cell(axis="y", travel=14.0)]
    campaign = Result(cells, [], {"x": "mm", "y": "m"})
    assert [one["axis"] for one in as_json(campaign, 1)["cells"]] == ["x", "y"]
    assert as_json(campaign, 1)["units"] == {"x": "mm", "y": "m"}
    text = as_text(campaign)
    assert "Axis y, in m" in text
    assert (
        "MISSED y: 2 frames <lost>, cruising: expected Q, observed Q (stale_feedback), travel 14.000 of 12.800 m"
        in text
    )
    assert as_markdown(campaign).count("| | fault |") == 2
    assert "<h2>Axis y</h2>" in as_page(campaign, 1, "both")


def test_the_command_gives_the_json_of_the_contract(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    page = tmp_path / "faults.html"
    arguments = ["faults", "--fault", "19", "--fault", "47", "--phase", "cruising", "--phase", "idle", "--json"]
    assert main([*arguments, "--seed", "5", "--simulated", "--html", str(page)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["seed"], result["missed"], result["unit"]) == (5, 0, "mm")
    assert result["met"] == len(result["cells"]) == 6
    assert [(one["fault"], one["phase"]) for one in result["cells"]][:2] == [(19, "idle"), (19, "cruising")]
    assert all(one["travel"] <= one["bound"] for one in result["cells"])
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")


def test_a_miss_is_an_exit_code_and_unknown_faults_are_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    # A load that pushes on, and no brake: the disabled axis does not come to rest.
    pushed = ["--set", "simulation.load=-3", "--set", "simulation.load_at_s=1"]
    assert main(["faults", "--fault", "26", "--phase", "cruising", "--simulated", "--json", *pushed]) == 3
    assert json.loads(capsys.readouterr().out)["missed"] == 1
    # A plant that answers four times as strongly as its model says does not even move without a fault.
    wild = ["--set", "simulation.gain=720"]
    assert main(["faults", "--fault", "26", "--phase", "cruising", "--simulated", "--json", *wild]) == 3
    assert "without a fault" in json.loads(capsys.readouterr().out)["error"]["message"]
    assert main(["faults", "--fault", "99", "--simulated", "--json"]) == 2


def test_a_fault_expects_a_refusal_to_arm_where_it_would_disable() -> None:
    by_number: dict[int, Fault] = {fault.number: fault for fault in TABLE}
    config = load(None).config
    assert by_number[33].expectation(Phase.IDLE, config) == "R"
    assert by_number[1].expectation(Phase.IDLE, config) == "T"
    assert by_number[34].expectation(Phase.HOLDING, config) == "R"
    assert by_number[34].expectation(Phase.CRUISING, config) == "Q"


def run(number: int, phase: Phase, name: str = "", seed: int = 1) -> Cell:
    fault = next(fault for fault in TABLE if fault.number == number and name in fault.name)
    return Campaign(load(None, ["axis.law.type=paper"]), seed).run(fault, phase)


def test_a_run_without_ticks_to_compare_is_wrong(campaign: Campaign) -> None:
    def look_away(world: World, _: object) -> None:
        world.keep_no_samples()

    fault = next(fault for fault in TABLE if fault.number == 41)
    cell = campaign.run(dataclasses.replace(fault, inject=look_away), Phase.HOLDING)
    assert not cell.met
    assert "ticks can be compared" in cell.wrong


def test_a_busy_host_is_compared_between_the_ticks() -> None:
    """Late ticks meet none of the undisturbed run's, and yet the two are not the same."""
    fault = next(fault for fault in TABLE if fault.number == 41)
    cell = Campaign(load(None, ["axis.law.type=paper"]), seed=11).run(fault, Phase.HOLDING)
    assert cell.met
    assert 0.05 < cell.travel < cell.bound < 5.0


def test_a_bump_at_a_new_set_point_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    set_target = TwoStageLaw.set_target

    def forget_the_sum(law: TwoStageLaw, target: float, velocity: float) -> None:
        set_target(law, target, velocity)
        law._sum = 0.0

    monkeypatch.setattr(TwoStageLaw, "set_target", forget_the_sum)
    assert "at once" in run(44, Phase.CRUISING).wrong


def test_a_stall_that_is_noticed_by_its_consequences_only_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    for watch in ("_stall", "_frozen"):
        monkeypatch.setattr(Supervision, watch, lambda _: iter(()))
    cell = run(30, Phase.IDLE)
    assert cell.observed == cell.expected
    assert "the stall was noticed after" in cell.wrong


@pytest.mark.parametrize("phase", [Phase.IDLE, Phase.HOLDING])
def test_a_speed_that_is_told_too_late_to_be_unreachable_is_seen(monkeypatch: pytest.MonkeyPatch, phase: Phase) -> None:
    start = Supervision.start

    def with_patience(supervision: Supervision) -> None:
        start(supervision)
        supervision._saturation_ticks = 53

    monkeypatch.setattr(Supervision, "start", with_patience)
    cell = run(29, phase)
    assert cell.observed == cell.expected
    assert re.fullmatch("the effort was at its limit for 5[12] ticks, 50 are allowed", cell.wrong)


def test_a_switch_that_nobody_gets_off_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    move_to = Requests.move_to

    def move_if_reset(requests: Requests, target: float, velocity: float) -> object:
        if requests._drive.positive_limit or requests._drive.negative_limit:
            raise Refused(RefusalCode.LIMIT_SWITCH, "no way is free")
        return move_to(requests, target, velocity)

    monkeypatch.setattr(Requests, "move_to", move_if_reset)
    assert "off the switch was refused" in run(34, Phase.CRUISING).wrong


def cell_of(number: int, phase: Phase = Phase.CRUISING) -> Cell:
    fault = next(fault for fault in TABLE if fault.number == number)
    return Campaign(load(None), seed=11).run(fault, phase)


def test_a_service_that_goes_on_after_a_signal_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(EndingSignals, "_begin_to_end", lambda *_: None)
    cell = cell_of(61)
    assert not cell.met
    assert cell.wrong.endswith("the service continues")


def test_a_second_signal_that_cuts_the_braking_short_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    catch = EndingSignals._catch

    def impatient(signals: EndingSignals, number: int, frame: FrameType | None) -> None:
        if signals.received is not None and signals._end is not None:
            service = cast("Any", signals._end).__self__
            asyncio.get_running_loop().call_soon(service.ticks.stop)
        catch(signals, number, frame)

    monkeypatch.setattr(EndingSignals, "_catch", impatient)
    assert not cell_of(61).met


def test_a_trip_that_needs_a_thread_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TripFiles, "start", lambda _: None)
    cell = cell_of(63)
    assert not cell.met
    assert "can't start new thread" in cell.wrong


def test_a_trip_for_which_there_is_no_memory_and_no_word_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TripFiles, "fail", lambda *_: None)
    assert "of the trip file: nothing" in cell_of(64).wrong
    assert "of the trip file: nothing" in cell_of(62).wrong


def test_a_socket_that_is_not_made_again_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SocketFile, "_bind_again", lambda _: None)
    assert "a new client is not served: no service answers" in cell_of(65).wrong


def test_the_process_gets_back_what_a_fault_has_taken_from_it() -> None:
    before = threading.Thread.start, resource.getrlimit(resource.RLIMIT_NOFILE), signal.getsignal(signal.SIGHUP)
    for number in range(61, 66):
        assert cell_of(number).met
    after = threading.Thread.start, resource.getrlimit(resource.RLIMIT_NOFILE), signal.getsignal(signal.SIGHUP)
    assert before == after


def test_the_more_severe_trip_gives_the_letter(monkeypatch: pytest.MonkeyPatch) -> None:
    cell = run(36, Phase.CRUISING, "500 ms")
    assert (cell.met, cell.observed, cell.trip) == (True, "Z", "missed_ticks+drive_fault")
    raise_trip = TripLatch.raise_trip

    def first_trip_only(latch: TripLatch, code: TripCode, cause: str) -> None:
        if latch.trip is None:
            raise_trip(latch, code, cause)

    monkeypatch.setattr(TripLatch, "raise_trip", first_trip_only)
    cell = run(36, Phase.CRUISING, "500 ms")
    assert (cell.met, cell.observed, cell.trip) == (False, "Q", "missed_ticks")


def test_the_reaction_to_a_suspended_host_follows_from_the_limits() -> None:
    suspension = next(fault for fault in TABLE if "50 ms" in fault.name and fault.number == 36)
    letters = {
        override: suspension.expectation(Phase.CRUISING, load(None, [override]).config)
        for override in (
            "axis.limits.missed_ticks=2",
            "axis.limits.missed_ticks=5",
            "simulation.command_timeout_ms=50",
        )
    }
    assert list(letters.values()) == ["Q", "T", "Z"]


def test_an_axis_searches_if_it_can_and_is_left_alone_if_not() -> None:
    def phases(*overrides: str) -> set[Phase]:
        return {phase for _, phase in Campaign(load(None, overrides), seed=1).cells()}

    assert phases() == set(Phase)
    assert phases("protocol.feedback.home_switch=false") == set(Phase) - {Phase.HOMING}


def test_what_is_printed_is_one_json_object_and_nothing_else(capfd: pytest.CaptureFixture[str]) -> None:
    """Also with the fault whose service has a log of its own, within the log of the campaign."""
    assert main(["faults", "--fault", "52", "--phase", "holding", "--simulated", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["met"] == 1
