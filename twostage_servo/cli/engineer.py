"""The engineer's verbs, which touch no bus: `check` a configuration, and show the `design` that follows from it."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twostage_servo.cli.configuration import add_options, configuration_problems, load_configuration, load_machine
from twostage_servo.cli.output import CommandError, ExitCode, note, print_json, print_line
from twostage_servo.cli.typed_numbers import decimal

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from twostage_servo.axis.design import AxisDesign
    from twostage_servo.config.errors import ConfigError
    from twostage_servo.config.loader import Config, LoadedConfig
    from twostage_servo.config.machine import Machine
    from twostage_servo.control.laws.law import Loop
    from twostage_servo.service.axis_loop import AxisLoop

_PLOTS = (".png", ".svg")
_UNIT_WAITS_S = 15.0
"""TimeoutStopSec= of the unit that comes with the program."""


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verbs."""
    check = verbs.add_parser(
        "check",
        help="check a configuration",
        description="Check a configuration, its DBC and the design that follows from it. The bus is not touched.",
    )
    check.add_argument("file", nargs="?", help="the configuration, same as --config")
    check.add_argument("--explain", action="store_true", help="list every key with its unit, bounds and meaning")
    add_options(check, required=False)
    check.set_defaults(run=_check)
    design = verbs.add_parser(
        "design",
        help="show gains, change-over distance, poles and margins",
        description="Show the design that follows from plant, weights and noise. The bus is not touched.",
    )
    add_options(design, required=False)
    design.add_argument(
        "--velocity", type=decimal, help="velocity for the change-over distance (default: the cruise velocity)"
    )
    design.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="plot each stage's Nyquist curve and step response; the name's ending selects PNG or SVG",
    )
    design.set_defaults(run=_design)


def _check(options: argparse.Namespace) -> ExitCode:
    from twostage_servo.app.build import build_parts
    from twostage_servo.config.loader import Config, described
    from twostage_servo.config.machine import MachineConfig
    from twostage_servo.service.settings import longest_end_s
    from twostage_servo.settings.reference import describe

    if options.explain:
        rows = [
            *describe(described(Config, {})),
            *(row for row in describe(MachineConfig) if row.key.startswith("machine")),
        ]
        if options.json:
            print_json({"keys": [{name: getattr(row, name) for name in row.__slots__} for row in rows]})
        else:
            for row in rows:
                print_line(_explain(row))
        return ExitCode.DONE
    if options.file is not None and options.config is not None:
        raise CommandError(ExitCode.USAGE, "usage", "name one configuration, FILE or --config FILE")
    machine = load_machine(options, file=options.file)
    with configuration_problems():
        parts = build_parts(machine)
    summaries = [_summary(machine, loaded, parts.axis_loop(loaded.config.axis.name)) for loaded in machine.axes]
    arming_timeouts_ms = (loaded.config.axis.arming_timeout_ms for loaded in machine.axes)
    ends_within_s = longest_end_s(parts.shutdown.settings, arming_timeouts_ms)
    if options.json:
        several = {"axes": summaries} if len(summaries) > 1 else summaries[0]
        print_json({"config": machine.source, "valid": True, "longest_end_s": ends_within_s, **several})
    else:
        print_line(f"{machine.source}: valid. " + "\n".join(map(_sentence, summaries)))
        if ends_within_s > _UNIT_WAITS_S:
            print_line(
                f"The service may take {ends_within_s:.3g} s to end, including service.shutdown_timeout_ms to brake. "
                "It asks systemd for that time; any other manager must wait as long before it kills the service."
            )
    return ExitCode.DONE


def _summary(machine: "Machine", loaded: "LoadedConfig[Config]", axis_loop: "AxisLoop") -> dict[str, Any]:
    config, drive, axis = loaded.config, axis_loop.drive, axis_loop.axis
    return {
        "axis": config.axis.name,
        "bus": {"interface": config.bus.interface, "channel": config.bus.channel},
        "frames": {
            "command": drive.command_id.identifier,
            "feedback": drive.feedback_id.identifier,
            "effort_quantum": drive.traits.effort_quantum,
            "position_quantum": drive.traits.position_quantum,
        },
        "dead_host": drive.dead_host,
        "changeover_distance": axis.design.changeover_distance(config.axis.cruise_velocity),
        "unit": config.axis.unit,
        "cruise_velocity": config.axis.cruise_velocity,
        "detection": _detection(axis.design),
        "notes": list(_notes(config, axis.design.period_s)),
        "warnings": [*_warnings(loaded, axis_loop), *_warnings_of_the_end(machine, axis_loop)],
    }


def _warnings(loaded: "LoadedConfig[Config]", axis_loop: "AxisLoop") -> "Iterator[dict[str, Any]]":
    """Yield the limits that protect from nothing, with the place where each is set."""
    from twostage_servo.axis.weak_limits import weak_limits

    traits = axis_loop.drive.traits
    for weak in weak_limits(axis_loop.axis.design, traits.position_quantum, heartbeat=traits.has_heartbeat):
        yield _warning(loaded.problem(("axis", *weak.key), weak.disables), weak.value, weak.do)


def _warnings_of_the_end(machine: "Machine", axis_loop: "AxisLoop") -> "Iterator[dict[str, Any]]":
    """Yield the shut-down time-out, where the file states one in which the axis does not come to rest."""
    from twostage_servo.service.settings import stop_ms

    settings, axis = machine.service, axis_loop.axis
    needed_ms, speed = stop_ms(axis.design), axis.settings.limits.velocity
    if "shutdown_timeout_ms" in settings.model_fields_set and settings.shutdown_timeout_ms < needed_ms:
        disables = (
            f"the braking at the end of the service: axis {axis_loop.name} takes {needed_ms:.0f} ms to stop from "
            f"{speed:g} {axis.settings.unit}/s, but its drive is disabled earlier, so the axis coasts"
        )
        problem = machine.problem(("service", "shutdown_timeout_ms"), disables)
        yield _warning(problem, settings.shutdown_timeout_ms, f"remove it, or set at least {needed_ms:.0f}")


def _warning(problem: "ConfigError", value: float, do: str) -> dict[str, Any]:
    (one,) = problem.problems
    return {"file": one.file, "line": one.line, "key": one.key, "value": value, "disables": one.message, "do": do}


def _detection(design: "AxisDesign") -> dict[str, Any]:
    """Return how far the axis goes until a turned or rescaled encoder is certain."""
    from twostage_servo.axis.detection import allowed_travel, detections, slowest_certain_velocity

    found = detections(design)
    slowest = slowest_certain_velocity(design)
    return {
        "travel": max(one.travel for one in found),
        "allowed": allowed_travel(design),
        "certain_from_velocity": slowest if math.isfinite(slowest) else None,
        "cases": [{name: getattr(one, name) for name in one.__slots__} for one in found],
    }


def _notes(config: "Config", period_s: float) -> "Iterator[str]":
    """Yield what is valid, and yet not as it should be."""
    most, carried = config.bus.max_frames_per_tick, config.bus.frames_carried(period_s)
    if most is not None and most < carried:
        rate = "1 Mbit/s" if config.bus.bitrate is None else f"{config.bus.bitrate / 1e3:g} kbit/s"
        yield (
            f"bus.max_frames_per_tick is {most}, and a bus of {rate} can carry {carried} frames in a tick of "
            f"{1e3 * period_s:g} ms: when it does, feedback is read late and axis {config.axis.name} trips "
            "(stale_feedback); remove the key: its default follows from the tick and the bit rate"
        )


def _sentence(summary: dict[str, Any]) -> str:
    bus, frames, unit, detection = summary["bus"], summary["frames"], summary["unit"], summary["detection"]
    speed = detection["certain_from_velocity"]
    slowest = "not in a cruise" if speed is None else f"in a cruise at {speed:.3g} {unit}/s or more"
    return (
        f"Axis {summary['axis']} on {bus['interface']} {bus['channel']}, command 0x{frames['command']:x}, feedback "
        f"0x{frames['feedback']:x}; change-over {summary['changeover_distance']:.4g} {unit} before the set-point at "
        f"{summary['cruise_velocity']:g} {unit}/s.\n"
        f"An encoder whose sign or scale changes is detected within {detection['travel']:.4g} {unit} "
        f"({detection['allowed']:g} allowed); {slowest}.\n"
        f"If this host dies, only the drive stops the axis: {summary['dead_host']}."
        + "".join(f"\nNote: {note}." for note in summary["notes"])
        + "".join(map(_warn, summary["warnings"]))
    )


def _warn(warning: dict[str, Any]) -> str:
    place = warning["file"] if warning["line"] is None else f"{warning['file']}:{warning['line']}"
    return (
        f"\nWarning: {place}: {warning['key']} = {warning['value']:g} disables {warning['disables']}; {warning['do']}."
    )


def _explain(row: Any) -> str:
    bounds = ", ".join(text for text in (row.lower, row.upper) if text)
    kind = f"{row.type}{f' in {row.unit}' if row.unit and row.unit != '1' else ''}{f', {bounds}' if bounds else ''}"
    default = "required" if row.default is None else f"default {row.default}"
    return f"{row.key}\n    {row.description}\n    {kind}; {default}"


def _design(options: argparse.Namespace) -> ExitCode:
    from twostage_servo.app.assembly import design
    from twostage_servo.axis.refusals import RefusalCode

    if options.plot is not None and options.plot.suffix not in _PLOTS:
        text = f"--plot {options.plot}: the name must end in {' or '.join(_PLOTS)}"
        raise CommandError(ExitCode.USAGE, "usage", text)
    loaded = load_configuration(options)
    with configuration_problems():
        axis_design = design(loaded)
    axis = loaded.config.axis
    velocity = axis.cruise_velocity if options.velocity is None else options.velocity
    if not 0.0 < velocity <= axis.limits.velocity:
        text = f"--velocity {velocity:g}: it must be greater than 0 and at most {axis.limits.velocity:g} {axis.unit}/s"
        raise CommandError(ExitCode.USAGE, RefusalCode.VELOCITY_LIMIT, text)
    loops = axis_design.law.loops()
    report = _report(axis_design, velocity, loops)
    if options.plot is not None:
        _plot(options.plot, axis_design, loops, loaded.source)
    if options.json:
        print_json(report)
    else:
        print_line(_as_text(report, axis_design))
    return ExitCode.DONE


def _plot(path: Path, design: "AxisDesign", loops: "Mapping[str, Loop]", source: str) -> None:
    from twostage_servo.control.loop_analysis import LoopAnalysis
    from twostage_servo.control.loop_plots import loops_figure

    known = {f"{name} stage": loop.controller for name, loop in loops.items() if loop.controller is not None}
    if not known:
        raise CommandError(
            ExitCode.FAILED, "plot", "the law of this axis does not describe its loops: there is nothing to draw"
        )
    analyses = {name: LoopAnalysis(design.plant, controller) for name, controller in known.items()}
    figure = loops_figure(analyses, f"Axis {design.settings.name} of {source}, a tick of {1e3 * design.period_s:g} ms")
    try:
        figure.savefig(path)
    except OSError as error:
        raise CommandError(ExitCode.FAILED, "plot", f"the plot cannot be written: {path}: {error.strerror}") from error
    note(f"plot written to {path}")


def _report(design: "AxisDesign", velocity: float, loops: "Mapping[str, Loop]") -> dict[str, Any]:
    return {
        "period_ms": 1e3 * design.period_s,
        "plant": {name: getattr(design.plant, name) for name in ("a12", "a22", "b1", "b2")},
        "gains": dict(design.law.gains()),
        "velocity": velocity,
        "changeover_distance": design.changeover_distance(velocity),
        "kalman_gain": {"predictor": design.kalman.predictor, "current": design.kalman.current},
        "stages": {name: _stage(design, loop) for name, loop in loops.items()},
    }


def _stage(design: "AxisDesign", loop: "Loop") -> dict[str, Any]:
    """Return the margins of a loop by python-control; those that the law says where it tells no more of itself."""
    from twostage_servo.control.loop_analysis import LoopAnalysis

    margins = loop if loop.controller is None else LoopAnalysis(design.plant, loop.controller).margins()
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


def _as_text(report: dict[str, Any], design: "AxisDesign") -> str:
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
    return "\n".join(lines)


def _or_none(value: float | None) -> str:
    return "unlimited" if value is None else f"{value:.3g}"
