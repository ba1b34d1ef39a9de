"""A value keeps its kind from the first tick on: a number is never nothing, a flag is never a number or nothing."""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module

import pytest

from tests.control.baselines.rig import PERIOD_S, Axis
from tests.control.baselines.test_before_the_first_step import LAWS as PLAIN
from tests.control.baselines.test_tunable_laws import LAWS as TUNABLE
from tests.control.baselines.test_tunable_laws import drive, task_of
from tests.control.laws.adaptive.test_adaptive_law import law_of, task
from tests.control.laws.test_tracking import DESIGN
from tests.kinds import Kinds, assert_kinds, collect
from tools.bench.control_quality.true_plant import TrueAxis, TruePlant
from twostage_servo.control.laws.law import Law
from twostage_servo.control.laws.paper_design import design_paper
from twostage_servo.control.model_monitor.monitor import ModelMonitor
from twostage_servo.control.observer import DisturbanceObserver

TASK = task()


def paper() -> Law:
    return design_paper(5e-5, TASK).build(DisturbanceObserver(TASK.sampled, TASK.kalman.predictor))


LAWS: dict[str, Callable[[], Law]] = {
    "adaptive": lambda: law_of(TASK),
    "smooth": lambda: law_of(replace(TASK, jerk=20_000.0)),
    "not learning": lambda: law_of(TASK, learns=False),
    "paper": paper,
    "tracking": lambda: DESIGN.build(DisturbanceObserver(TASK.sampled, TASK.kalman.predictor)),
}
NOT_ALWAYS = {
    "Changeover._smoothing",
    "Course.braking",
    "Differentiator._before",
    "IdentifiedPlant._observer",
    "Learning._poor_fit",
    "Rules.fixed_gains",
    "SpeedStage._smoothing",
    "Trust.rejection",
}
"""What a law has in some moves or settings only: it is nothing, or of one kind."""


@pytest.mark.parametrize("name", LAWS)
def test_of_a_law_of_the_product_and_of_the_model_monitor(name: str) -> None:
    """In moves and changes of them, a stop, losses of samples, skipped ticks; behind friction and a delay."""
    law, kinds = LAWS[name](), Kinds()
    plant = TruePlant(TrueAxis(216.0, 12.0, friction=0.3, delay_ticks=1), PERIOD_S, 1)
    monitor, tick, sample = ModelMonitor(TASK.plant, PERIOD_S, TASK.noise), 0, plant.sample()
    monitor.start(law.observer)

    def run(ticks: int) -> None:
        nonlocal tick, sample
        for _ in range(ticks):
            tick += 1
            is_lost = tick % 17 == 0
            if is_lost:
                monitor.predict(law.effort)
            else:
                monitor.update(sample, law.effort, law.observer, 0.0)
            effort = law.step(None if is_lost else sample)
            sample = plant.sample()
            plant.advance(effort)
            collect((law, monitor), kinds)

    collect((law, monitor), kinds)
    run(20)
    for target, velocity, ticks in ((60.0, 100.0, 120), (0.0, 50.0, 40), (80.0, 100.0, 20), (-20.0, 200.0, 30)):
        law.set_target(target, velocity)
        run(ticks)
    law.stop(2000.0, gradual=True)
    run(5)
    law.resume_at(law.observer.velocity, 0.5)
    run(40)
    law.skip(2)
    law.shift(0.0)
    run(20)
    law.start(0.5)
    run(10)
    assert_kinds(kinds, NOT_ALWAYS)


@pytest.mark.parametrize("name", PLAIN)
def test_of_a_baseline_of_the_paper(name: str) -> None:
    law = PLAIN[name]()
    axis, kinds = Axis(), Kinds()
    collect(law, kinds)
    for target in (60.0, 0.0):
        law.set_target(target, 100.0)
        for _ in range(120):
            axis.drive(law, 1)
            collect(law, kinds)
    assert_kinds(kinds, NOT_ALWAYS)


@pytest.mark.parametrize("name", TUNABLE)
def test_of_a_baseline_with_parameters(name: str) -> None:
    if name == "jerk_limited":
        pytest.importorskip("ruckig")
    law_type = getattr(import_module(f"twostage_servo.control.baselines.{name}"), TUNABLE[name])
    law = law_type.build(task_of(), law_type.start())
    kinds = Kinds()
    collect(law, kinds)
    for target in (60.0, 0.0):
        law.set_target(target, 100.0)
        for _ in range(20):
            drive(law, 6)
            collect(law, kinds)
    assert_kinds(kinds, NOT_ALWAYS)
