"""The bench of control quality: its plant, its bound, its outcomes, its margins, and the contract of its result."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tools.bench.control_quality import __main__ as command
from tools.bench.control_quality import (
    axes,
    contestants,
    jobs,
    margins,
    measure,
    over_frames,
    scenarios,
    suite,
    tuning,
)
from tools.bench.control_quality.suite import PERIOD_S, Case, LoadStep, Outcome, Rig, SuiteLaw, cases, quickest_move
from tools.bench.control_quality.true_plant import TrueAxis, TruePlant
from twostage_servo.control.loop_analysis import LoopAnalysis
from twostage_servo.control.plant import Plant

FRICTION = TrueAxis(180.0, 14.0, friction=0.4, load=0.3, quantum=0.0)


def integrated(axis: TrueAxis, efforts: list[float]) -> list[float]:
    """Positions after each tick by a general solver; friction as a very steep line through zero speed."""
    state, found = [0.0, 0.0], []
    for effort in efforts:

        def slope(_: float, now: Any, u: float = effort) -> list[float]:
            friction = axis.friction * math.tanh(now[1] / 1e-3)
            return [now[1], axis.gain * (u - axis.load - friction) - axis.pole * now[1]]

        state = solve_ivp(slope, (0.0, PERIOD_S), state, method="LSODA", rtol=1e-8, atol=1e-10).y[:, -1].tolist()
        found.append(state[0])
    return found


def test_the_true_plant_is_what_a_solver_integrates() -> None:
    efforts = [5.0] * 10 + [-3.0] * 12 + [0.5] * 10 + [2.0, -2.0] * 4  # it stops, sticks and turns within ticks
    plant, found = TruePlant(FRICTION, PERIOD_S, 1), []
    for effort in efforts:
        plant.advance(effort)
        found.append(plant.position)
    assert found == pytest.approx(integrated(FRICTION, efforts), abs=2e-3)


def test_an_effort_below_the_friction_moves_nothing() -> None:
    plant = TruePlant(FRICTION, PERIOD_S, 1)
    plant.advance(0.69)
    assert (plant.position, plant.velocity) == (0.0, 0.0)
    plant.advance(0.71)
    assert plant.velocity > 0.0


def test_a_late_axis_does_the_same_a_tick_later() -> None:
    prompt, late = (TruePlant(replace(FRICTION, delay_ticks=ticks), PERIOD_S, 1) for ticks in (0, 1))
    positions: list[float] = []
    for effort in (5.0, 8.0, -3.0):
        late.advance(effort)
        assert late.position == (positions[-1] if positions else 0.0)
        prompt.advance(effort)
        positions.append(prompt.position)


def test_a_sample_is_noisy_and_has_a_quantum() -> None:
    noisy = TruePlant(TrueAxis(180.0, 14.0, quantum=0.0, noise=0.05), PERIOD_S, 5)
    samples = [noisy.sample() for _ in range(4000)]
    assert np.std(samples) == pytest.approx(0.05, rel=0.05)
    coarse = TruePlant(TrueAxis(180.0, 14.0, quantum=0.01), PERIOD_S, 5)
    coarse.advance(3.0)
    assert coarse.sample() / 0.01 == pytest.approx(round(coarse.position / 0.01))


def quickest_by_trial(axis: TrueAxis, way: float, velocity: float) -> float:
    """When the best of many moves enters the band: full effort, cruise, full braking, tried for each way of braking."""
    step, position, speed, time = 1e-5, 0.0, 0.0, 0.0
    braked = braking_way(axis, velocity, step)
    while way + suite.BAND - position > braked[min(len(braked) - 1, round(speed / velocity * (len(braked) - 1)))]:
        speed = min(velocity, speed + step * (axis.gain * (10.0 - axis.load - axis.friction) - axis.pole * speed))
        position, time = position + step * speed, time + step
    while position < way - suite.BAND:
        speed -= step * (axis.gain * (10.0 + axis.load + axis.friction) + axis.pole * speed)
        position, time = position + step * speed, time + step
    return time


def braking_way(axis: TrueAxis, velocity: float, step: float) -> list[float]:
    """The way of a braking from each of 20,001 speeds up to the velocity, by adding it up backwards in time."""
    count, speeds, ways = 20_000, [0.0], [0.0]
    while speeds[-1] < velocity:
        acceleration = axis.gain * (10.0 + axis.load + axis.friction) + axis.pole * speeds[-1]
        speeds.append(speeds[-1] + step * acceleration)
        ways.append(ways[-1] + step * speeds[-1])
    return [float(way) for way in np.interp(np.linspace(0.0, velocity, count + 1), speeds, ways)]


@pytest.mark.parametrize(("way", "velocity"), [(20.0, 60.0), (2.0, 60.0)])
def test_the_bound_is_that_of_the_quickest_move(way: float, velocity: float) -> None:
    found = quickest_move(FRICTION, FRICTION.load, way, velocity)
    assert found.bound_s == pytest.approx(quickest_by_trial(FRICTION, way, velocity), abs=2e-4)
    assert (found.cruising_s > 0.0) == (way == 20.0)


def test_the_bound_of_an_axis_without_damping_can_be_worked_out_by_hand() -> None:
    """1000 mm/s² both ways: 0.1 s up to 100 mm/s, and 0.1 s down; 0.2 mm before the end it lacks 20 ms."""
    axis = TrueAxis(100.0, 1e-3, quantum=0.0)
    found = quickest_move(axis, 0.0, 99.9, 100.0)
    assert found.accelerating_s == pytest.approx(0.1, rel=2e-4)
    assert found.cruising_s == pytest.approx(0.9, rel=2e-4)
    assert found.in_band_s == pytest.approx(0.02, rel=2e-4)
    assert found.bound_s == pytest.approx(1.08, rel=2e-4)


class Scripted(SuiteLaw):
    """Gives some efforts, and then none."""

    def __init__(self, *efforts: float) -> None:
        self._efforts = list(efforts)
        self.asked: list[tuple[float, float]] = []

    def set_target(self, target: float, velocity: float) -> None:
        self.asked.append((target, velocity))

    def step(self, sample: float) -> float:
        return self._efforts.pop(0) if self._efforts else 0.0


def test_an_outcome_is_what_the_axis_did() -> None:
    axis = TrueAxis(180.0, 14.0, quantum=0.0)
    plant = TruePlant(axis, PERIOD_S, 1)
    efforts, positions, speeds = [10.0] * 8 + [-5.0] * 3, [], []
    for effort in (*efforts, *[0.0] * 200):
        plant.advance(effort)
        positions.append(plant.position)
        speeds.append(plant.velocity)
    target = positions[-1] - 0.05  # it ends within the band, beyond the target
    outcome = Rig(Scripted(*efforts), Case(axis, target, 50.0, 1)).move(target, 50.0, 1.7)
    assert outcome.overshoot == pytest.approx(max(positions) - target)
    assert outcome.peak_velocity == pytest.approx(max(map(abs, speeds)) / 50.0)
    inside = [abs(position - target) <= suite.BAND for position in positions]
    entered = max(tick for tick, is_inside in enumerate(inside) if not is_inside) + 1
    assert entered * PERIOD_S <= outcome.settling_s <= (entered + 1) * PERIOD_S
    assert outcome.excess_s == pytest.approx(outcome.settling_s - quickest_move(axis, 0.0, target, 50.0).bound_s)


def test_a_move_that_does_not_settle_counts_as_the_longest() -> None:
    case = Case(TrueAxis(180.0, 14.0), 50.0, 50.0, 1)
    outcome = Rig(Scripted(), case).move(50.0, 50.0, 1.0)
    assert (outcome.excess_s, outcome.settling_s) == (suite.LONGEST_EXCESS_S, math.inf)


def test_the_load_steps_at_its_time_in_the_first_move() -> None:
    law = Scripted()
    suite.run(law, Case(TrueAxis(180.0, 14.0), 5.0, 100.0, 1, LoadStep(2.0, 0.1)), 3, watched_s=0.2, rest_s=0.1)
    assert law.asked == [(5.0, 100.0), (0.0, 100.0), (5.0, 100.0)]
    rig = Rig(Scripted(), Case(TrueAxis(180.0, 14.0), 50.0, 100.0, 1))
    rig.move(50.0, 100.0, 0.2, LoadStep(2.0, 0.1))
    assert rig.plant.load == 2.0
    assert rig.plant.position < 0.0


def test_cases_are_the_same_each_time_and_as_they_are_said_to_be() -> None:
    found = cases(200, 0.0316, 42)
    assert found == cases(100, 0.0316, 42) + cases(100, 0.0316, 142)
    for index, case in enumerate(found):
        gain, pole = case.axis.gain / suite.GAIN - 1.0, case.axis.pole / suite.POLE - 1.0
        assert max(abs(gain), abs(pole)) <= 0.3 + 1e-9
        if index % 2 == 0:
            assert (abs(gain), abs(pole)) == pytest.approx((0.3, 0.3))
        assert 5.0 <= abs(case.distance) <= 2000.0
        assert 20.0 <= case.velocity <= 200.0
    assert {case.axis.delay_ticks for case in found} == {0, 1}
    assert {case.axis.effort_limit for case in found} == {10.0, 24.0}


def test_training_and_suite_have_no_case_in_common() -> None:
    trained = {case.seed for case in tuning.training_cases(0.0)}
    assert max(trained) < measure.FIRST_SEED


PLANT = Plant(suite.GAIN, suite.POLE).discretise(PERIOD_S)
NAMES = [*contestants.project_laws(), *contestants.baselines()]


@pytest.mark.parametrize("name", NAMES)
def test_the_margins_are_those_of_a_loop_built_in_another_way(name: str) -> None:
    """By transfer functions, and the delay margin by adding whole ticks of delay until it is unstable."""
    law = contestants.controller_of(name, suite.nominal())
    found = margins.loop_figures(PLANT, law)
    plant = control.c2d(control.tf([suite.GAIN], [1.0, suite.POLE, 0.0]), PERIOD_S, "zoh")
    law_model = control.ss(law.a, law.b, law.c, 0.0, PERIOD_S)
    angles = np.geomspace(1e-3, math.pi, 4000)
    z = np.exp(1j * angles)
    loop = -plant(z) * law_model(z)
    assert found.peak_sensitivity == pytest.approx(float(np.max(1.0 / np.abs(1.0 + loop))), rel=2e-3)
    whole = math.floor(found.delay_margin_ticks)
    assert largest_pole(law, whole) < 1.0 <= largest_pole(law, whole + 1)
    peak, delay = margins.quick_margins(PLANT, law)
    assert peak == pytest.approx(found.peak_sensitivity, rel=0.01)
    assert delay == pytest.approx(found.delay_margin_ticks, rel=0.01)


def largest_pole(law: Any, delay_ticks: int) -> float:
    """Of the closed loop of the model with some ticks of delay, by powers of a shift register."""
    size = len(law.a)
    total = 2 + size + delay_ticks
    closed = np.zeros((total, total))
    closed[:2, :2] = [[1.0, PLANT.a12], [0.0, PLANT.a22]]
    closed[2 : 2 + size, 2 : 2 + size] = law.a
    closed[2 : 2 + size, 0] = np.array(law.b)[:, 0]
    effort = np.zeros(total)
    effort[2 : 2 + size] = np.array(law.c)[0]
    for tick in range(delay_ticks):
        closed[2 + size + tick] = effort
        effort = np.zeros(total)
        effort[2 + size + tick] = 1.0
    closed[:2] += np.outer([PLANT.b1, PLANT.b2], effort)
    return float(np.max(np.abs(np.linalg.eigvals(closed))))


@pytest.mark.parametrize("name", NAMES)
def test_the_load_peak_is_that_of_a_run(name: str) -> None:
    """The axis itself under a load of 1 V, as the law drives it: without quantum, friction or limits."""
    axis = replace(suite.nominal().axis, quantum=0.0, effort_limit=24.0, effort_rate=1e9)
    case = Case(axis, 10.0, 100.0, 1)
    rig = Rig(contestants.law_for(name, case), case)
    rig.move(10.0, 100.0, 8.0)
    before, rig.plant.load, peak = rig.plant.position, 0.1, 0.0
    for _ in range(200):
        rig.tick()
        peak = max(peak, abs(rig.plant.position - before))
    found = LoopAnalysis(PLANT, contestants.controller_of(name, case)).load_step_peak()
    assert 10.0 * peak == pytest.approx(found, rel=0.02)


def test_an_unstable_loop_has_no_margins() -> None:
    law = contestants.controller_of("ptos", suite.nominal())
    wild = replace(law, c=tuple(tuple(50.0 * value for value in row) for row in law.c))
    assert LoopAnalysis(PLANT, wild).load_step_peak() == math.inf
    assert margins.quick_margins(PLANT, wild) == (math.inf, 0.0)


def test_each_case_is_in_one_job_and_chunks_change_nothing() -> None:
    made = measure.jobs_for(["a", "b"], 120, 7)
    seeds = [
        (job.law, job.noise, job.first_seed + index) for job in made for index in range(job.count)
    ]  # fmt: skip
    assert len(seeds) == len(set(seeds)) == 2 * 2 * 120
    whole = measure.outcomes_of(measure.Job("ptos", 0.0, 7, 4))
    parts = [measure.outcomes_of(measure.Job("ptos", 0.0, 7 + begin, 2)) for begin in (0, 2)]
    assert whole == parts[0] + parts[1]


def test_percentiles_are_values_that_occurred() -> None:
    values = [float(value) for value in range(100, 0, -1)]
    assert [measure.quantile(values, share) for share in (0.5, 0.95, 0.99, 1.0)] == [50.0, 95.0, 99.0, 100.0]
    outcomes = [Outcome(0.001 * value, 1.0, 0.01 * value, 1.0) for value in values]
    assert measure.figures_of(outcomes) == {
        "excess_ms": {"median": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0},
        "overshoot": {"p95": 0.95, "max": 1.0},
    }


def test_the_command_prints_its_contract(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    arguments = ["--json", "--quick", "--plants", "2", "--law", "paper", "--law", "ptos", "--workers", "1"]
    arguments += ["--outcomes", str(tmp_path / "moves.csv")]
    monkeypatch.setattr(sys, "argv", ["control_quality", *arguments])
    assert command.main() == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert "jobs" in printed.err
    assert set(result) == {"laws", "suite", "seed", "budget"}
    assert set(result["laws"]) == {"paper", "ptos"}
    for law in result["laws"].values():
        assert set(law) == {
            "nominal_s", "nominal_overshoot", "peak_sensitivity", "delay_margin_ticks", "load_step_peak", "noise"
        }  # fmt: skip
        assert set(law["noise"]) == {"0", "0.0316"}
        for moves in law["noise"].values():
            assert set(moves) == {"first", "third"}
            for figures in moves.values():
                assert set(figures) == {"excess_ms", "overshoot"}
                assert set(figures["excess_ms"]) == {"median", "p95", "p99", "max"}
                assert set(figures["overshoot"]) == {"p95", "max"}
    assert result["laws"]["paper"]["nominal_overshoot"] == pytest.approx(3.26, abs=0.01)
    assert result["laws"]["paper"]["delay_margin_ticks"] == pytest.approx(21.0, abs=0.1)
    assert (result["seed"], result["suite"]["plants"]) == (measure.FIRST_SEED, 2)
    moves_written = (tmp_path / "moves.csv").read_text("utf-8").splitlines()
    assert len(moves_written) == 1 + 2 * 2 * 2 * 3
    assert moves_written[1].startswith(f"paper,0.0,{measure.FIRST_SEED},1,")


def test_without_json_the_command_prints_a_table_a_level_and_move(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["control_quality", "--plants", "2", "--law", "ptos", "--workers", "1"])
    assert command.main() == 0
    shown = capsys.readouterr().out
    assert shown.count("\nptos ") == shown.count("\nlaw ") == 4
    assert "noise 0.0316 mm, third move on each of 2 plants" in shown


def test_the_command_refuses_a_law_that_there_is_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["control_quality", "--law", "magic"])
    with pytest.raises(SystemExit):
        command.main()
    assert "no law is called magic; there are: " in capsys.readouterr().err


def test_the_optimiser_finds_the_same_again_and_something_better(monkeypatch: pytest.MonkeyPatch) -> None:
    training = tuning.training_cases(0.0, 2)
    monkeypatch.setattr(tuning, "training_cases", lambda _: training)
    job = tuning.TuningJob("ptos", 0.0, budget=52, seed=1)
    found = tuning.tune(job)
    assert found == tuning.tune(job)
    assert found["cost"] < found["start_cost"]
    law_type = contestants.baseline("ptos")
    assert tuning.target_of(law_type, found["values"], training) == pytest.approx(found["cost"], abs=1e-4)


def test_what_misses_the_margins_costs_more() -> None:
    law_type = contestants.baseline("trapezoid")
    soft = {**law_type.start(), "feedback_frequency": 10.0, "observer_single": 20.0, "observer_frequency": 20.0}
    quick = {**soft, "feedback_frequency": 60.0, "observer_single": 200.0, "observer_frequency": 120.0}
    assert tuning.target_of(law_type, soft, tuning.training_cases(0.0, 1)) < 10.0
    assert tuning.target_of(law_type, quick, tuning.training_cases(0.0, 1)) > 10.0


def test_jobs_keep_their_order_in_processes_of_their_own() -> None:
    assert jobs.run_jobs(math.sqrt, [4.0, 9.0, 16.0], workers=2, show=False) == [2.0, 3.0, 4.0]


def test_a_law_that_is_new_to_the_suite_moves() -> None:
    for name in NAMES:
        outcome = suite.run(contestants.law_for(name, suite.nominal()), suite.nominal(), 1)[0]
        assert outcome.overshoot < 5.0


@pytest.mark.parametrize("scenario", [scenarios.SUITE, *scenarios.SCENARIOS])
def test_a_scenario_changes_one_thing(scenario: str) -> None:
    changed = scenarios.scenario_cases(scenario, 20, 0.0, 42)
    for case, same in zip(changed, cases(20, 0.0, 42), strict=True):
        if scenario == "two ticks of delay":
            assert case == replace(same, axis=replace(same.axis, delay_ticks=2))
        elif scenario.startswith("load step"):
            assert case.step is not None
            assert case == replace(same, step=case.step)
            assert -1.0 <= same.axis.load + case.step.size <= 1.0
            found = quickest_move(same.axis, same.axis.load, same.distance, same.velocity)
            begins = {"accelerating": 0.0, "cruise": found.accelerating_s}.get(
                scenario.rsplit(maxsplit=1)[-1], found.accelerating_s + found.cruising_s
            )
            assert begins <= case.step.at_s <= found.bound_s + found.in_band_s
        elif scenario == scenarios.SUITE:
            assert case == same
        else:
            assert (case.axis.gain / suite.GAIN - 1.0) == pytest.approx((same.axis.gain / suite.GAIN - 1.0) * 5.0 / 3.0)


def test_there_are_no_other_scenarios() -> None:
    with pytest.raises(ValueError, match="there is no scenario 'rain'; there are: suite, load step while acc"):
        scenarios.scenario_cases("rain", 1, 0.0, 1)


def test_other_axes_are_the_suites_in_other_units() -> None:
    for index in range(5):
        for case in axes.axis_cases(index, 6):
            model, axis = case.model, case.axis
            unit = model.gain * axis.effort_limit * model.period_s**2
            assert 0.5 <= model.gain <= 5000.0
            assert 0.001 <= model.period_s <= 0.02
            assert axis.quantum / unit == pytest.approx(1.0 / 18.0)
            assert case.band == pytest.approx(10.0 * axis.quantum)
            assert 0.69 <= axis.gain / model.gain <= 1.31
            # It reaches its velocity against load and friction, and the effort may reverse within two ticks.
            assert axis.gain * (axis.effort_limit - 1.5) > axis.pole * case.velocity
            assert axis.effort_rate * model.period_s == pytest.approx(axis.effort_limit)


def test_an_axis_that_a_law_refuses_is_counted() -> None:
    found = axes.measure_axes(["paper"], 2, workers=1, show=False)["paper"]
    assert found.refused + len(found.excess_ticks) == 2
    assert axes.rows_of({"x": axes.AxesFigures(2, (), ())}) == [("x", "2", "-", "-", "-", "-")]


def test_the_docs_get_their_tables_and_pictures(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "control-quality.md"
    marks = [f"noise {noise}, {move}" for noise in ("0", "0.0316") for move in ("first", "third")]
    marks += ["nominal", "scenarios", "axes", "frames"]
    page.write_text("".join(f"<!-- {mark}: begin -->\n<!-- {mark}: end -->\n" for mark in marks), "utf-8")
    (tmp_path / "pictures").mkdir()
    monkeypatch.setattr(command, "_PAGE", page)
    monkeypatch.setattr(axes, "AXES", 1)
    arguments = ["--plants", "4", "--law", "ptos", "--law", "cnf", "--workers", "1", "--docs"]
    monkeypatch.setattr(sys, "argv", ["control_quality", *arguments])
    assert command.main() == 0
    written = page.read_text("utf-8")
    assert sum(line.startswith("| ptos | ") for line in written.splitlines()) == 5
    assert "| two ticks of delay | ptos | " in written
    assert sorted(path.name for path in (tmp_path / "pictures").iterdir()) == [
        f"control-quality-{name}.svg" for name in ("end", "excess", "margins")
    ]
    assert capsys.readouterr().err.count(" written\n") == 4


def test_what_was_tuned_belongs_to_the_laws_as_they_are() -> None:
    if not contestants.TUNED.exists():
        pytest.skip("nothing has been tuned")
    found = json.loads(contestants.TUNED.read_text("utf-8"))
    assert (found["seed"], found["budget"]) == (tuning.SEED, tuning.BUDGET)
    for name in contestants.baselines():
        parameters = contestants.baseline(name).parameters
        for noise in suite.NOISES:
            values = found["laws"][name][contestants.level(noise)]["values"]
            assert set(values) == set(parameters)
            for key, value in values.items():
                assert 0.999 * parameters[key].low <= value <= 1.001 * parameters[key].high


def test_over_frames_an_axis_moves_as_by_the_law_alone() -> None:
    sample = over_frames.valid_cases(3)
    assert all(case.velocity <= 0.9 * case.axis.effort_limit * suite.GAIN / suite.POLE for case in sample)
    found = [over_frames.outcome_of(over_frames.FramesJob("paper", case)) for case in sample]
    for outcome in found:
        assert outcome.trip == ""
        assert outcome.frames_overshoot == pytest.approx(outcome.alone_overshoot, abs=0.01)
        assert outcome.frames_s == pytest.approx(outcome.alone_s, abs=0.5 * PERIOD_S)
    assert over_frames.rows_of({"paper": found})[0][:3] == ("paper", "3", "0")


def test_a_trip_over_frames_is_a_figure() -> None:
    case = over_frames.valid_cases(6)[5]  # a healthy axis: gain and pole are 30 % off
    found = replace(over_frames.outcome_of(over_frames.FramesJob("paper", case)), trip="stall")
    assert over_frames.rows_of({"paper": [found, found]})[0][:3] == ("paper", "2", "2 (stall)")
