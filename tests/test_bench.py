"""The benchmark's contract: the shape of its result, and its budgets. No figure is judged: the machine may be busy."""

import asyncio
import contextlib
import copy
import dataclasses
import importlib.util
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from tools.bench import (
    budgets,
    client_load,
    clients,
    control_step,
    frame_jitter,
    lateness,
    loops,
    packages,
    run,
    simulated_time,
    stop_latency,
    stop_load,
    summary,
    whole_tick,
)
from tools.bench.children import ChildError
from tools.bench.plan import FULL, QUICK
from twostage_servo.api.request_reading import parse_request
from twostage_servo.api.requests import BadRequestError
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.client.errors import Reason, Refused, Unreachable
from twostage_servo.timing.virtual_clock import run as simulate

if TYPE_CHECKING:
    from tools.bench.machine import Service

FIGURES = {"p50", "p90", "p99", "max"}


def result_of(**tables: Any) -> dict[str, Any]:
    """A result as the runner makes it, with these tables."""
    made = run.Run(QUICK, 0, lambda _: None)
    made.result |= tables
    return made.result


def test_percentiles_are_values_that_occurred() -> None:
    assert summary.summarise([3.0, 1.0, 2.0]) == {"p50": 2.0, "p90": 3.0, "p99": 3.0, "max": 3.0, "count": 3}
    assert summary.summarise_histogram({5: 98, 70: 2})["p50"] == 5.0
    assert summary.summarise_histogram({5: 98, 70: 2})["p99"] == 70.0


def test_the_control_step_is_compared_with_the_same_equations() -> None:
    told = control_step.compare(1, only=["c", "numpy"])
    measured, missing = told["control_step_us"], told["not_measured"]
    assert {"ours", "ours_position_stage", "numpy"} <= set(measured)
    assert "c" in set(measured) | set(missing)
    assert all(set(figures) >= FIGURES for figures in measured.values())


def test_a_compiler_that_fails_leaves_the_others_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control_step, "what_is_missing", lambda _: None)
    monkeypatch.setattr(control_step, "compile_c", lambda _: (_ for _ in ()).throw(OSError("no linker")))
    told = control_step.compare(1, only=["c", "numpy"])
    assert set(told["control_step_us"]) == {"ours", "ours_position_stage", "numpy"}
    assert told["not_measured"] == {"c": "the compiler does not do it: no linker"}


def test_other_equations_are_noticed() -> None:
    samples, efforts = control_step.record(1e9)
    with pytest.raises(ValueError, match="different one does not compute the same effort"):
        control_step.check("different one", lambda: control_step.ours(1.0), samples, efforts)


def test_a_whole_tick_and_its_phases() -> None:
    told = whole_tick.time_ticks(1, 20, real=False)
    assert set(told["tick_us"]) >= FIGURES
    assert told["tick_us"]["count"] >= 20
    assert list(told["phase_share"]) == list(whole_tick.PHASES)
    assert sum(told["phase_share"].values()) == pytest.approx(1.0, abs=1e-3)


def test_the_line_through_whole_ticks_and_how_straight_they_lie() -> None:
    straight = whole_tick.fit({axes: 7.0 + 45.0 * axes for axes in whole_tick.AXES})
    assert straight == {
        "whole_tick_of_no_axis_us": 7.0, "whole_tick_per_axis_us": 45.0, "marginal_cost_growth": 1.0,
    }  # fmt: skip
    bent = whole_tick.fit({axes: 45.0 * axes + (20.0 * (axes - 32) if axes > 32 else 0.0) for axes in whole_tick.AXES})
    assert bent["marginal_cost_growth"] == pytest.approx(65.0 / 45.0, abs=1e-4)
    assert whole_tick.fit({1: 50.0, 2: 90.0}) == {}


def test_lateness_comes_from_the_recording_and_a_missed_deadline_is_met_late() -> None:
    class Told:
        def ask(self, **_: object) -> dict[str, object]:
            return {
                "fields": ["tick", "missed", "state", "lateness_us"],
                "records": [[7, 0, "holding", 1.0], [8, 0, "holding", 2.5], [11, 2, "holding", 30.0]],
            }

    lateness_us = clients._lateness_us(cast("Service", Told()), {"count": 5, "missed": 2}, 0.01)
    assert lateness_us == [2.5, 20_030.0]


@pytest.mark.parametrize("kind", sorted(client_load.KINDS))
def test_clients_make_work_until_they_are_ended(kind: str, tmp_path: Path) -> None:
    """In simulated time, against a server that answers each line."""
    asked: list[bytes] = []
    connections: list[object] = []

    async def main() -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            connections.append(writer)
            with contextlib.closing(writer):
                while line := await reader.readline():
                    asked.append(line)
                    writer.write(b"{}\n")

        server = await asyncio.start_unix_server(serve, tmp_path / "s")
        load = asyncio.ensure_future(client_load.KINDS[kind](tmp_path / "s"))
        # A flood leaves the simulated clock no idle moment to go on in, so passes of the loop are counted.
        for _ in range(200):
            await asyncio.sleep(0.0 if kind in {"flooding_client", "connecting_client"} else 0.01)
        load.cancel()
        await asyncio.gather(load, return_exceptions=True)
        server.close()
        await asyncio.sleep(0.01)

    simulate(main())
    wanted = {"never_reading_watcher": 1, "flooding_client": 100, "fifty_clients": 300, "connecting_client": 0}
    assert len(asked) >= wanted[kind]
    assert len(connections) >= {"fifty_clients": 50, "connecting_client": 20}.get(kind, 1)
    assert all(json.loads(line)["op"] in {"watch", "status", "move", "recording"} for line in asked)


@pytest.mark.parametrize("kind", sorted(stop_load.KINDS))
def test_clients_that_try_to_prevent_a_stop_make_work(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In simulated time, against a server that refuses each line and ends each connection after ten of them."""
    monkeypatch.setattr("time.sleep", lambda _: None)
    asked: list[bytes] = []
    connections: list[int] = []

    async def main() -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            connections.append(len(connections))
            # Who leaves with refusals unread resets the connection.
            with contextlib.closing(writer), contextlib.suppress(ConnectionResetError):
                for _ in range(10):
                    if not (line := await reader.readline()):
                        return
                    asked.append(line)
                    writer.write(b"{}\n")

        server = await asyncio.start_unix_server(serve, tmp_path / "s")
        load = stop_load.KINDS[kind](tmp_path / "s")
        for _ in range(200):
            next(load)
            for _ in range(3):
                await asyncio.sleep(0)
        load.close()
        server.close()
        await asyncio.sleep(0.01)

    simulate(main())
    assert len(connections) >= {"readers": 65, "connectors": 65, "half_closed": 57, "heavy_lines": 56}[kind]
    if kind == "connectors":
        assert not asked
    elif kind == "heavy_lines":
        assert {len(line) for line in asked} <= set(range(4000, 4097))
        assert all(b'"stop"' in line for line in asked)
        with pytest.raises(BadRequestError):
            parse_request(asked[0].rstrip())
    else:
        assert {json.loads(line)["op"] for line in asked} == {"status"}


class _Client:
    """A service that loses every second stop, and refuses the others, since the axis is at rest."""

    stops = 0

    def __init__(self, path: Path, *, timeout_s: float) -> None:
        self.reconnected = 1
        self.closed = False
        if path.name == "nowhere":
            raise Unreachable(Reason.NO_SERVICE, "no service answers")

    def stop(self, *, wait: bool) -> None:
        assert not wait
        _Client.stops += 1
        raise Unreachable(Reason.NO_ANSWER, "so it is") if _Client.stops % 2 else Refused(RefusalCode.BUSY, "so it is")

    def close(self) -> None:
        assert not self.closed
        self.closed = True


def test_a_stop_without_an_answer_is_lost_and_a_refusal_is_an_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_latency, "connect", _Client)
    monkeypatch.setattr("time.sleep", lambda _: None)
    monkeypatch.setattr(_Client, "stops", 0)
    told = stop_latency.ask(Path("there"), 9)
    assert (len(told["us"]), told["lost"], told["repeated"]) == (5, 5, 10)
    assert stop_latency.ask(Path("nowhere"), 9) == {"us": [], "lost": 10, "repeated": 0}


def test_each_load_has_its_figures_or_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    loads: list[tuple[str, int]] = []

    class Machine:
        control_socket = Path("/nowhere")
        priority = 40

        def __init__(self, axes: int) -> None:
            self.axes = axes

        @contextlib.contextmanager
        def service(self, *overrides: str) -> Iterator[None]:
            assert overrides == ("service.tick_ms=1",)
            yield

        def send_afar(self, _: object) -> None:
            """Nobody moves."""

    @contextlib.contextmanager
    def load(name: str, machine: Machine) -> Iterator[None]:
        loads.append((name, machine.axes))
        if name == "hogs":
            raise ChildError("no hogs")
        yield

    def asked(command: list[str], *_: object) -> dict[str, Any]:
        assert command[command.index("--count") + 1] == "7"
        name = loads[-1][0]
        return {"us": [] if name == "readers" else [1.0, 3.0], "lost": 7 if name == "readers" else 0, "repeated": 2}

    monkeypatch.setattr(stop_latency, "_load", load)
    monkeypatch.setattr(stop_latency, "json_of", asked)
    monkeypatch.setattr("time.sleep", lambda _: None)
    plan = dataclasses.replace(QUICK, stops=7)
    one, many = cast("Any", Machine(1)), cast("Any", Machine(8))
    figures, missing = stop_latency.measure(one, many, plan, lambda _: None, tick_ms=1.0)
    assert [name for name, _ in loads] == list(stop_latency.CONTENDERS)
    assert {name for name, axes in loads if axes == 8} == {"eight_axes", "everything"}
    assert missing == {"hogs": "no hogs", "readers": "all 7 were lost"}
    assert set(figures) == set(stop_latency.CONTENDERS) - set(missing)
    assert figures["everything"] == {
        "p50": 1.0,
        "p90": 3.0,
        "p99": 3.0,
        "max": 3.0,
        "count": 2,
        "lost": 0,
        "repeated": 2,
    }


def test_each_pass_of_a_loop_has_a_lateness() -> None:
    assert {name: len(values) for name, values in loops.ours(3).items()} == {"ours": 3}
    assert {name: len(values) for name, values in loops.asyncio_sleep(3).items()} == {"asyncio_sleep": 3}


@pytest.mark.parametrize(
    ("contender", "line"),
    [
        ("soft_realtime_loop", "pip install NeuroLocoMiddleware"),
        ("canopen_sync", "pip install canopen"),
        ("filterpy", "pip install filterpy"),
        ("cyclictest", "apt install rt-tests"),
        ("c", "apt install gcc"),
    ],
)
def test_what_is_missing_is_named_with_the_line_that_installs_it(
    contender: str, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    monkeypatch.setenv("PATH", "")
    reason = packages.what_is_missing(contender)
    assert reason is not None
    assert reason.endswith(line)


def test_a_run_without_any_contender_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lateness, "what_is_missing", lambda name: f"no {name}")
    made = run.Run(QUICK, 0, lambda _: None)
    made.do("lateness")
    made.finish()
    assert made.result["tick_lateness_us"] == made.result["tick_lateness_us_loaded"] == {}
    assert made.result["not_measured"]["tick_lateness_us.cyclictest"] == "no cyclictest"
    assert {goal["state"] for goal in made.result["goals"]} == {"not measured"}
    assert "not measured: tick_lateness_us_loaded.ours: no ours" in run.as_text(made.result)


def test_a_defect_in_one_part_costs_none_of_the_others(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = {"p50": 0.9, "p90": 1.0, "p99": 1.0, "max": 1.0}
    monkeypatch.setattr(control_step, "measure", lambda *_: ({"ours": figures}, {}))
    monkeypatch.setattr(simulated_time, "measure", lambda *_: summary.summarise([]))
    monkeypatch.setattr(sys, "argv", ["run.py", "--quick", "--json", "--only", "step", "simulation"])
    assert run.main() == 1
    told = capsys.readouterr()
    assert "IndexError" in told.err
    result = json.loads(told.out)
    assert result["control_step_us"]["ours"]["p50"] == 0.9
    assert result["not_measured"] == {"simulation": "a defect of the benchmark: IndexError: list index out of range"}


def test_clients_beside_which_the_axis_trips_have_no_lateness(monkeypatch: pytest.MonkeyPatch) -> None:
    class Service:
        process = SimpleNamespace(pid=1)

        def ask(self, **request: str) -> dict[str, Any]:
            fields = ["tick", "missed", "lateness_us"]
            return {
                "status": {"ticks": {"count": 5, "missed": 0}, "trip": {"code": "stall", "cause": "it stands still"}},
                "recording": {"fields": fields, "records": [[5, 0, 0.1]]},  # none since
            }[request["op"]]

    class Machine:
        control_socket = Path("/nowhere")

        @contextlib.contextmanager
        def service(self, *_: str) -> Iterator[Service]:
            yield Service()

        def send_afar(self, _: Service) -> None:
            """Nobody moves."""

    monkeypatch.setattr(clients, "CONTENDERS", ("none",))
    monkeypatch.setattr(clients, "cpu_share", lambda *_: 0.05)
    monkeypatch.setattr("time.sleep", lambda _: None)
    plan = dataclasses.replace(QUICK, client_rounds=1)
    figures, shares, missing = clients.measure(Machine(), plan, lambda _: None)  # type: ignore[arg-type]
    assert not figures
    assert not shares
    assert missing == {"none": "the axis has tripped: stall, it stands still"}


@pytest.mark.parametrize("measured", [lateness, frame_jitter])
def test_the_contenders_take_turns_in_both_orders(measured: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measured, "what_is_missing", lambda _: None)
    order: list[str] = []

    def heard(name: str, *_: object) -> list[float]:
        order.append(name)
        return [float(len(order))]

    monkeypatch.setattr(frame_jitter, "_ours", heard)
    monkeypatch.setattr(frame_jitter, "_other", heard)
    monkeypatch.setattr(lateness, "json_of", lambda command, *_: {command[4]: heard(command[4])})
    cyclictest = {"histogram": {"50": 1}, "cycles": 1, "avg": 50.0, "max": 50}
    monkeypatch.setattr(lateness, "_cyclictest", lambda *_: dict(cyclictest, max=heard("cyclictest")[0]))
    plan = dataclasses.replace(QUICK, lateness_rounds=2, frame_rounds=2)
    names = list(measured.CONTENDERS)
    for backwards, wanted in ((False, names + names[::-1]), (True, names[::-1] + names)):
        order.clear()
        arguments = (plan, 0) if measured is lateness else (None, None, plan)
        figures, missing = measured.measure(*arguments, lambda _: None, backwards=backwards)
        assert order == wanted
        assert list(figures) == names
        assert missing == {}
    assert FULL.lateness_rounds % 2 == FULL.frame_rounds % 2 == FULL.client_rounds % 2 == 0


FIGURES_OF_A_RUN = {
    "tick_lateness_us": {
        "ours": {"p50": 20.0, "p90": 30.0},
        "cyclictest": {"p50": 55.0, "avg": 60.0},
        "asyncio_sleep": {"p50": 4e5},
        "soft_realtime_loop": {"p50": 15.0},
    },
    "control_step_us": {"ours": {"p50": 0.9}, "c": {"p50": 0.025}, "numpy": {"p50": 5.0}, "filterpy": {"p50": 60.0}},
    "whole_tick_us": {"1": {"p50": 50.0}},
    "simulated_tick_cpu_us": 300.0,
    "memory_growth_mb": 0.1,
    "cpu_share": 0.05,
}


class ToldRun(run.Run):
    """A run whose steps have been measured: what they are the next times is told."""

    def __init__(self, *steps_us: float) -> None:
        super().__init__(QUICK, 0, lambda _: None)
        self.result |= copy.deepcopy(FIGURES_OF_A_RUN)
        self.steps_us = list(steps_us)
        self.done: list[str] = []

    def do(self, part: str) -> None:
        self.done.append(part)
        if part == "step":
            self.result["control_step_us"]["ours"]["p50"] = self.steps_us.pop(0)


def test_a_kept_budget() -> None:
    made = ToldRun()
    assert run.check(made)
    assert made.done == []
    assert {budget["state"] for budget in made.result["budgets"]} == {"kept", "not measured"}


def test_a_broken_budget_is_measured_anew_before_it_counts(capsys: pytest.CaptureFixture[str]) -> None:
    made = ToldRun(7.0, 7.0, 0.9, 0.9)
    made.do("step")
    assert run.check(made)
    complaint = capsys.readouterr().err
    assert "control_step_us.ours.p50 = 7, wanted is at most 80 x control_step_us.c.p50 = 80 x 0.025 = 2" in complaint
    assert "control_step_us.filterpy.p50 = 60, wanted is at least 12 x control_step_us.ours.p50" in complaint
    assert made.done == ["step"] * 3

    made = ToldRun(7.0, 7.0, 7.0, 0.9)
    made.do("step")
    assert not run.check(made)
    assert made.done == ["step"] * 3
    assert {budget["state"] for budget in made.result["budgets"]} == {"kept", "broken", "not measured"}


def test_a_figure_of_ours_that_could_not_be_measured_is_no_kept_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    made = run.Run(QUICK, 0, lambda _: None)
    steps = {"ours": {"p50": 0.9}, "c": {"p50": 0.1}, "numpy": {"p50": 8.0}, "filterpy": {"p50": 40.0}}
    monkeypatch.setattr(control_step, "measure", lambda *_: (steps, {}))  # which is measured anew with it
    monkeypatch.setattr(simulated_time, "measure", lambda *_: (_ for _ in ()).throw(ChildError("it fell over")))
    made.do("simulation")
    assert made.result["not_measured"] == {"simulation": "it fell over"}
    assert not run.check(made)

    monkeypatch.setattr(simulated_time, "measure", lambda *_: {"simulated_tick_cpu_us": 300.0})
    made.do("simulation")
    assert made.result["not_measured"] == {}
    assert not run.check(made)

    measured = {"simulated_tick_cpu_us": 300.0, "memory_growth_mb": 0.1}
    monkeypatch.setattr(simulated_time, "measure", lambda *_: measured)
    assert run.check(made)


def test_what_is_left_out_breaks_no_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    made = run.Run(QUICK, 0, lambda _: None)
    made.do("clients")
    made.do("millisecond")
    steps = {"ours": {"p50": 0.9}, "c": {"p50": 0.1}, "numpy": {"p50": 8.0}}
    monkeypatch.setattr(control_step, "measure", lambda *_: (steps, {"filterpy": "no filterpy"}))
    made.do("step")
    assert run.check(made)


def test_what_is_added_to_a_bound_is_told() -> None:
    budget = budgets.Budget("x", "a", at_most=True, factor=1.2, of="b", plus=1.0)
    assert budgets.judge(budget, {"a": 1.05, "b": 0.05}).state == "kept"
    verdict = budgets.judge(budget, {"a": 1.07, "b": 0.05})
    assert verdict.state == "broken"
    assert verdict.text == "a = 1.07, wanted is at most 1.2 x b + 1 = 1.2 x 0.05 + 1 = 1.06"


def test_every_budget_and_goal_names_figures_that_a_run_has() -> None:
    tables = {"frame_jitter_us", "frame_jitter_us_loaded", "tick_lateness_us_loaded", "whole_tick_real_time_us",
              "startup_s", "status_s", "clients_lateness_us", "clients_cpu_share", "millisecond_missed_share",
              "marginal_cost_growth", "stop_us", *FIGURES_OF_A_RUN}  # fmt: skip
    for kind in ("budget", "goal"):
        entries = budgets.read(kind, {})
        assert len(entries) > 5
        for entry in entries:
            for path in filter(None, (entry.figure, entry.of)):
                table = path.split(".", maxsplit=1)[0]
                assert table in tables, path
                assert kind == "goal" or run._PART_OF[table] in run.PARTS


def test_the_best_of_the_others_is_the_one_to_beat() -> None:
    result = result_of(frame_jitter_us={"ours": {"p50": 3.0}, "a": {"p50": 4.0}, "b": {"p50": 2.0}})
    first = next(goal for goal in budgets.read("goal", result) if goal.figure == "frame_jitter_us.ours.p50")
    assert first.of == "frame_jitter_us.b.p50"
    assert budgets.judge(first, result).state == "broken"


@pytest.mark.parametrize(
    "entry",
    [
        'name = "x"\nfigure = "a"\nlimit = "at most"',
        'name = "x"\nfigure = "a"\nlimit = "under"\nbound = 1',
        'name = "x"\nfigure = "a"\nlimit = "at most"\nof = "b"',
        'name = "x"\nlimit = "at most"\nbound = 1',
        'name = "x"\nfigure = "a"\nlimit = "at most"\nbound = 1\nbond = 1',
    ],
)
def test_an_entry_that_says_too_little_is_refused(entry: str, tmp_path: Path) -> None:
    file = tmp_path / "budgets.toml"
    file.write_text(f"[[budget]]\n{entry}\n", encoding="utf-8")
    with pytest.raises(budgets.BudgetError, match="x: "):
        budgets.read("budget", {}, file)
