"""The verb `design`: gains, margins and the response to be expected, without anything that moves."""

import argparse
import io
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twostage_servo.cli.configuration import add_options, configuration_problems, load_configuration
from twostage_servo.cli.expected_moves import (
    check_uncertainty,
    expectation_as_json,
    response_as_json,
    response_lines,
)
from twostage_servo.cli.output import CommandError, ExitCode, note, print_json, print_line
from twostage_servo.cli.result_file import write_result
from twostage_servo.cli.typed_numbers import decimal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from twostage_servo.app.expected_response import Expectation, PlannedMove
    from twostage_servo.axis.design import AxisDesign
    from twostage_servo.axis.messages import DriveTraits
    from twostage_servo.control.laws.law import Loop
    from twostage_servo.control.loop_analysis import LoopAnalysis

_PLOTS = (".png", ".svg")
_UNCERTAINTY = 30.0
"""Percent by which an accepted plant may be off its model."""


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verb."""
    design = verbs.add_parser(
        "design",
        help="show gains, margins, and what a move will be like",
        description="Show the design that follows from plant, law and limits: gains, change-over distance, margins, "
        "and the response to be expected on the plant of the model and on those that are off it. The bus is not "
        "touched.",
    )
    add_options(design, required=False)
    design.add_argument(
        "--velocity", type=decimal, help="velocity of the move and its change-over (default: the cruise velocity)"
    )
    design.add_argument(
        "--distance", type=decimal, help="length of the move (default: four seconds of cruise, within the limits)"
    )
    design.add_argument(
        "--uncertainty",
        type=decimal,
        default=_UNCERTAINTY,
        metavar="PERCENT",
        help="by how much gain and pole may be off the model, for the worst response (default: %(default)g)",
    )
    design.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="plot each stage's Nyquist curve and step response, and the move; the name's ending selects PNG or SVG",
    )
    design.set_defaults(run=_design)


def _design(options: argparse.Namespace) -> ExitCode:
    from twostage_servo.app.assembly import build_drive, design
    from twostage_servo.app.expected_response import corner_moves, expect
    from twostage_servo.control.loop_analysis import LoopAnalysis

    if options.plot is not None and options.plot.suffix not in _PLOTS:
        text = f"--plot {options.plot}: the name must end in {' or '.join(_PLOTS)}"
        raise CommandError(ExitCode.USAGE, "usage", text)
    check_uncertainty(options.uncertainty)
    loaded = load_configuration(options)
    with configuration_problems():
        traits = build_drive(loaded).traits
        axis_design = design(loaded, traits=traits)
    move = _asked_move(options, axis_design)
    loops = axis_design.law.loops()
    analyses = {
        name: LoopAnalysis(axis_design.plant, loop.controller)
        for name, loop in loops.items()
        if loop.controller is not None
    }
    share = options.uncertainty / 100.0
    expected = expect(axis_design, traits, move, share)
    corners = [
        expected if corner == move else expect(axis_design, traits, corner, share)
        for corner in corner_moves(loaded.config.axis)
    ]
    report = _report(axis_design, loops, analyses, expected, corners) | {"uncertainty": options.uncertainty}
    if options.plot is not None:
        _plot(options.plot, axis_design, analyses, loaded.source, traits, move, share)
    if options.json:
        print_json(report)
    else:
        print_line(_as_text(report, axis_design, expected, corners))
    return ExitCode.DONE


def _asked_move(options: argparse.Namespace, design: "AxisDesign") -> "PlannedMove":
    """Return the move that the options ask for.

    Raises
    ------
    CommandError
        If the axis takes no such move.
    """
    from twostage_servo.app.expected_response import PlannedMove, configured_move
    from twostage_servo.axis.refusals import RefusalCode

    axis = design.settings
    velocity = axis.cruise_velocity if options.velocity is None else options.velocity
    if not 0.0 < velocity <= axis.limits.velocity:
        text = f"--velocity {velocity:g}: it must be greater than 0 and at most {axis.limits.velocity:g} {axis.unit}/s"
        raise CommandError(ExitCode.USAGE, RefusalCode.VELOCITY_LIMIT, text)
    travel = axis.limits.position_maximum - axis.limits.position_minimum
    distance = configured_move(axis, velocity).distance if options.distance is None else options.distance
    if not axis.window.position < distance <= travel:
        text = (
            f"--distance {distance:g}: it must be greater than the position window, {axis.window.position:g}, and at "
            f"most the {travel:g} {axis.unit} between the position limits"
        )
        raise CommandError(ExitCode.USAGE, RefusalCode.POSITION_LIMIT, text)
    return PlannedMove(distance, velocity)


def _plot(
    path: Path,
    design: "AxisDesign",
    analyses: "Mapping[str, LoopAnalysis]",
    source: str,
    traits: "DriveTraits",
    move: "PlannedMove",
    uncertainty: float,
) -> None:
    from twostage_servo.app.expected_response import traces
    from twostage_servo.control.loop_plots import design_figure

    known = {f"{name} stage": analysis for name, analysis in analyses.items()}
    title = f"Axis {design.settings.name} of {source}, a tick of {1e3 * design.period_s:g} ms"
    figure = design_figure(known, traces(design, traits, move, uncertainty), design.settings.unit, title)
    content = io.BytesIO()
    figure.savefig(content, format=path.suffix.removeprefix("."))
    write_result(path, content.getvalue(), "plot")
    note(f"plot written to {path}")


def _report(
    design: "AxisDesign",
    loops: "Mapping[str, Loop]",
    analyses: "Mapping[str, LoopAnalysis]",
    expected: "Expectation",
    corners: "list[Expectation]",
) -> dict[str, Any]:
    velocity = expected.move.velocity
    return {
        "period_ms": 1e3 * design.period_s,
        "plant": {name: getattr(design.plant, name) for name in ("a12", "a22", "b1", "b2")},
        "gains": dict(design.law.gains()),
        "velocity": velocity,
        "changeover_distance": design.changeover_distance(velocity),
        "kalman_gain": {"predictor": design.kalman.predictor, "current": design.kalman.current},
        "stages": {name: _stage(loop, analyses.get(name)) for name, loop in loops.items()},
        "margins": _margins(design, analyses.get("position")),
        "response": {"nominal": response_as_json(expected.nominal), "worst": response_as_json(expected.worst)},
        "distance": expected.move.distance,
        "bound_s": expected.bound_s,
        "corners": [expectation_as_json(corner) for corner in corners],
    }


def _margins(design: "AxisDesign", position: "LoopAnalysis | None") -> dict[str, Any] | None:
    """Return the margins of the linear position stage; None where the law does not describe it."""
    if position is None:
        return None
    margins = position.margins()
    return {
        "peak_sensitivity": 1.0 / margins.modulus_margin,
        "delay_margin_ticks": _finite(margins.delay_margin_s / design.period_s),
        "gain_margin": _finite(margins.gain_margin),
        "load_step_peak": _finite(position.load_step_peak()),
    }


def _stage(loop: "Loop", analysis: "LoopAnalysis | None") -> dict[str, Any]:
    """Return the margins of a loop by python-control; those that the law says where it tells no more of itself."""
    margins = loop if analysis is None else analysis.margins()
    return {
        "gain_margin": _finite(margins.gain_margin),
        "gain_reduction_margin": margins.gain_reduction_margin,
        "phase_margin_deg": _finite(margins.phase_margin_deg),
        "delay_margin_ms": _finite(1e3 * margins.delay_margin_s),
        "modulus_margin": margins.modulus_margin,
        "poles": [[pole.real, pole.imag] for pole in loop.poles],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _as_text(
    report: dict[str, Any], design: "AxisDesign", expected: "Expectation", corners: "list[Expectation]"
) -> str:
    axis = design.settings
    gains = ", ".join(f"{name} {value:.4g}" for name, value in report["gains"].items())
    origin, kalman = design.law.origin(), report["kalman_gain"]["predictor"]
    lines = [
        f"plant      {axis.plant.gain:g} / (s (s + {axis.plant.pole:g})), sampled every {report['period_ms']:g} ms",
        f"gains      {gains}" + (f"   ({origin})" if origin else ""),
        (
            f"changeover {report['changeover_distance']:.4g} {axis.unit} before the set-point at "
            f"{report['velocity']:g} {axis.unit}/s"
        ),
        f"observer   predictor gain {kalman[0]:.4g}, {kalman[1]:.4g}, {kalman[2]:.4g}",
    ]
    for name, stage in report["stages"].items():
        radius = math.hypot(*stage["poles"][0])
        lines.append(
            f"{name + ' stage':14} gain margin {_or_none(stage['gain_margin'])}, phase margin "
            f"{_or_none(stage['phase_margin_deg'])}°, delay margin {_or_none(stage['delay_margin_ms'])} ms, "
            f"modulus margin {stage['modulus_margin']:.3g}; slowest pole {radius:.4f} "
            f"(time constant {-report['period_ms'] / math.log(radius):.4g} ms)"
        )
    if (margins := report["margins"]) is not None:
        lines.append(
            f"load       a step of 1 {axis.effort_unit} moves the axis by {_or_none(margins['load_step_peak'])} "
            f"{axis.unit} at most; peak sensitivity {margins['peak_sensitivity']:.3g}, delay margin "
            f"{_or_none(margins['delay_margin_ticks'])} ticks"
        )
    lines += response_lines([expected, *corners], design, report["uncertainty"])
    return "\n".join(lines)


def _or_none(value: float | None) -> str:
    return "unlimited" if value is None else f"{value:.3g}"
