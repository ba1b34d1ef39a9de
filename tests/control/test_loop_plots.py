"""The plots of a design: what is drawn is what was computed, and nothing of it is left out."""

from typing import Any

import numpy as np
import pytest

from twostage_servo.app.assembly import design
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.loader import load
from twostage_servo.control.loop_analysis import LoopAnalysis
from twostage_servo.control.loop_plots import design_figure

MOVES = {
    "nominal": [(0.0, 10.0, 0.0, 3.0), (0.1, 6.0, 40.0, 1.0), (0.2, 0.04, 20.0, -2.0), (0.3, 0.0, 0.0, 0.5)],
    "weak": [(0.0, 10.0, 0.0, 4.0), (0.1, 8.0, 30.0, 2.0), (0.2, 1.0, 25.0, -1.0), (0.3, 0.0, 0.0, 0.6)],
}


@pytest.fixture(scope="module")
def loops() -> dict[str, LoopAnalysis]:
    made = design(load(shipped_configuration("demo.toml"), ["axis.law.type=paper"]))
    controllers = {name: loop.controller for name, loop in made.law.loops().items()}
    return {name: LoopAnalysis(made.plant, one) for name, one in controllers.items() if one is not None}


def line(pane: Any, index: int) -> tuple[list[float], list[float]]:
    drawn = pane.lines[index]
    return list(drawn.get_xdata()), list(drawn.get_ydata())


@pytest.mark.parametrize("with_loops", [False, True])
def test_each_move_is_drawn_with_its_velocity_its_effort_and_its_error(
    with_loops: bool, loops: dict[str, LoopAnalysis]
) -> None:
    figure = design_figure(loops if with_loops else {}, MOVES, "mm", "a title")
    velocity, effort, error = figure.axes[-3:]
    for index, ticks in enumerate(MOVES.values()):
        times, errors, velocities, efforts = (list(column) for column in zip(*ticks, strict=True))
        assert line(velocity, index) == (times, velocities)
        assert line(effort, index) == (times, efforts)
        assert line(error, index) == (times, errors)
        colours = {pane.lines[index].get_color() for pane in (velocity, effort, error)}
        assert len(colours) == 1
    assert velocity.get_legend_handles_labels()[1] == list(MOVES)
    assert velocity.get_legend() is not None
    assert [pane.get_ylabel() for pane in (velocity, effort, error)] == ["velocity (mm/s)", "effort", "error (mm)"]
    assert velocity.get_xlim() == pytest.approx((0.0, 1.1 * 0.2))  # the last tick that is not within 10 µm of 10 mm
    assert error.get_xlim() == pytest.approx((0.2, 1.1 * 0.2 + 0.03), abs=0.03)  # from where a hundredth is left
    assert error.get_ylim() == pytest.approx((-0.02, 0.02))
    assert figure.get_suptitle() == "a title"
    assert len(figure.axes) == (5 if with_loops else 3)


def test_each_loop_is_drawn_with_its_margin_and_its_step(loops: dict[str, LoopAnalysis]) -> None:
    figure = design_figure(loops, MOVES, "mm", "")
    nyquist, step = figure.axes[:2]
    for index, loop in enumerate(loops.values()):
        _, response = loop.response()
        assert line(nyquist, 2 * index) == (list(response.real), list(response.imag))
        around = np.hypot(np.add(line(nyquist, 2 * index + 1)[0], 1.0), line(nyquist, 2 * index + 1)[1])
        assert around == pytest.approx(np.full(len(around), np.min(np.abs(1.0 + response))))
    assert line(nyquist, 2 * len(loops)) == ([-1.0], [0.0])
    assert nyquist.get_xlim() == (-2.5, 1.0)
    assert nyquist.get_ylim() == (-2.0, 1.5)
    following = {name: loop for name, loop in loops.items() if loop.law.follows}
    assert set(following) == {"speed", "position"}
    for index, (name, loop) in enumerate(following.items()):
        times, answer = loop.step_response(3.0)
        assert line(step, index) == (list(times), list(answer))
        assert step.lines[index].get_label() == f"{name}: {loop.law.follows}"
    assert line(step, len(following))[1] == [1.0, 1.0]
    assert step.lines[len(following)].get_color() == "black"
    assert [nyquist.get_xlabel(), nyquist.get_ylabel()] == ["real part of the loop gain", "imaginary part"]
    assert [step.get_xlabel(), step.get_ylabel()] == ["time (s)", "answer to a unit step, without limits"]


def test_where_nothing_follows_there_is_no_step(loops: dict[str, LoopAnalysis]) -> None:
    figure = design_figure({"brake": loops["brake"]}, MOVES, "mm", "")
    assert len(figure.axes) == 4


def test_lines_are_thin_enough_to_tell_apart_and_the_critical_point_is_not_to_be_missed(
    loops: dict[str, LoopAnalysis],
) -> None:
    figure = design_figure(loops, MOVES, "mm", "")
    nyquist, step, *panes = figure.axes
    for axes in figure.axes:
        for grid in (axes.xaxis.get_gridlines()[0], axes.yaxis.get_gridlines()[0]):
            assert grid.get_visible()
            assert 0.0 < grid.get_linewidth() < 0.5
    assert all(0.0 < drawn.get_linewidth() < 1.0 for pane in panes for drawn in pane.lines)
    circles, responses = nyquist.lines[1 : 2 * len(loops) : 2], nyquist.lines[0 : 2 * len(loops) : 2]
    for circle, response in zip(circles, responses, strict=True):
        assert 0.0 < circle.get_linewidth() < response.get_linewidth()
        assert circle.get_color() == response.get_color()
        assert circle.get_linestyle() == ":"
    critical, one = nyquist.lines[2 * len(loops)], step.lines[-1]
    assert critical.get_markersize() > 8.0
    assert (critical.get_color(), one.get_color()) == ("black", "black")
    assert 0.0 < one.get_linewidth() < 1.0


def test_a_move_that_is_there_from_the_start_is_drawn_beside_one_that_is_not() -> None:
    moves = {"far": MOVES["weak"], "there": [(0.0, 0.0, 0.0, 0.0), (0.1, 0.0, 0.0, 0.0)]}
    velocity, _, error = design_figure({}, moves, "mm", "").axes
    assert velocity.get_xlim() == pytest.approx((0.0, 1.1 * 0.2))
    assert error.get_xlim()[0] == 0.0
