"""The verb `check`: whether a configuration can be used, and what it protects from. The bus is not touched."""

import argparse
import math
from typing import TYPE_CHECKING, Any

from twostage_servo.cli.configuration import add_options, configuration_problems, load_machine
from twostage_servo.cli.expected_moves import check_uncertainty, expectation_as_json, response_lines
from twostage_servo.cli.output import CommandError, ExitCode, print_json, print_line
from twostage_servo.cli.typed_numbers import decimal

if TYPE_CHECKING:
    from collections.abc import Iterator

    from twostage_servo.app.expected_response import Expectation
    from twostage_servo.app.tight_limit import TightLimit
    from twostage_servo.axis.design import AxisDesign
    from twostage_servo.config.errors import ConfigError
    from twostage_servo.config.loader import Config, LoadedConfig
    from twostage_servo.config.machine import Machine
    from twostage_servo.service.axis_loop import AxisLoop

_UNIT_WAITS_S = 15.0
"""TimeoutStopSec= of the unit that comes with the program."""


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verb."""
    check = verbs.add_parser(
        "check",
        help="check a configuration",
        description="Check a configuration, its DBC and the design that follows from it. The bus is not touched.",
    )
    check.add_argument("file", nargs="?", help="the configuration, same as --config")
    check.add_argument("--explain", action="store_true", help="list every key with its unit, bounds and meaning")
    check.add_argument(
        "--uncertainty",
        type=decimal,
        default=0.0,
        metavar="PERCENT",
        help="also move plants whose gain and pole are off the model by so much (default: only the model's own)",
    )
    add_options(check, required=False)
    check.set_defaults(run=_check)


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
    check_uncertainty(options.uncertainty)
    machine = load_machine(options, file=options.file)
    with configuration_problems():
        parts = build_parts(machine)
        axis_loops = [parts.axis_loop(loaded.config.axis.name) for loaded in machine.axes]
        moves = [_moves(*axis, options.uncertainty) for axis in zip(machine.axes, axis_loops, strict=True)]
    summaries = [_summary(machine, *axis) for axis in zip(machine.axes, axis_loops, moves, strict=True)]
    arming_timeouts_ms = (loaded.config.axis.arming_timeout_ms for loaded in machine.axes)
    ends_within_s = longest_end_s(parts.shutdown.settings, arming_timeouts_ms)
    if options.json:
        several = {"axes": summaries} if len(summaries) > 1 else summaries[0]
        print_json({"config": machine.source, "valid": True, "longest_end_s": ends_within_s, **several})
    else:
        lines = [
            response_lines(expected, axis_loop.axis.design, options.uncertainty)
            for expected, axis_loop in zip(moves, axis_loops, strict=True)
        ]
        print_line(f"{machine.source}: valid. " + "\n".join(map(_sentence, summaries, lines)))
        if ends_within_s > _UNIT_WAITS_S:
            print_line(
                f"The service may take {ends_within_s:.3g} s to end, including service.shutdown_timeout_ms to brake. "
                "It asks systemd for that time; any other manager must wait as long before it kills the service."
            )
    return ExitCode.DONE


def _summary(
    machine: "Machine", loaded: "LoadedConfig[Config]", axis_loop: "AxisLoop", moves: "list[Expectation]"
) -> dict[str, Any]:
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
        "response": [expectation_as_json(move) for move in moves],
        "notes": [*_notes(config, axis.design.period_s), *_notes_of_moves(axis_loop, moves)],
        "warnings": [*_warnings(loaded, axis_loop), *_warnings_of_the_end(machine, axis_loop)],
    }


def _warnings(loaded: "LoadedConfig[Config]", axis_loop: "AxisLoop") -> "Iterator[dict[str, Any]]":
    """Yield the limits that protect from nothing, with the place where each is set."""
    from twostage_servo.axis.weak_limits import weak_limits

    traits = axis_loop.drive.traits
    is_cyclic = traits.sampling == "cyclic"
    found = weak_limits(
        axis_loop.axis.design, traits.position_quantum, heartbeat=traits.has_heartbeat, is_cyclic=is_cyclic
    )
    for weak in found:
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


def _moves(loaded: "LoadedConfig[Config]", axis_loop: "AxisLoop", uncertainty: float) -> "list[Expectation]":
    """Return what the configured move and the fastest one will come to, with an uncertainty in percent.

    Raises
    ------
    ConfigError
        If a limit ends the configured move even on the plant of the model.
    """
    from twostage_servo.app.expected_response import configured_move, expect
    from twostage_servo.app.tight_limit import tight_limit

    design, traits = axis_loop.axis.design, axis_loop.drive.traits
    axis = design.settings
    usual, fastest = (configured_move(axis, velocity) for velocity in (axis.cruise_velocity, axis.limits.velocity))
    found = [expect(design, traits, move, uncertainty / 100.0) for move in dict.fromkeys((usual, fastest))]
    if (tight := tight_limit(design, traits, found[0])) is not None:
        place = ("axis", "limits") if tight.key is None else ("axis", "limits", tight.key)
        raise loaded.problem(place, f"{_ends(tight, axis.unit)}: {_remedy(tight)}")
    return found


def _ends(tight: "TightLimit", unit: str) -> str:
    move = tight.move
    return (
        f"a move of {move.distance:.4g} {unit} at {move.velocity:g} {unit}/s trips ({tight.trip}) even if the plant is "
        "as axis.plant says"
    )


def _remedy(tight: "TightLimit") -> str:
    return "lower the velocity" if tight.enough is None else f"{tight.enough:.4g} would do"


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


def _notes_of_moves(axis_loop: "AxisLoop", moves: "list[Expectation]") -> "Iterator[str]":
    """Yield the limits that end a move on the plant of the model."""
    from twostage_servo.app.tight_limit import tight_limit

    design = axis_loop.axis.design
    for move in moves:
        if (tight := tight_limit(design, axis_loop.drive.traits, move)) is not None:
            limit = "" if tight.key is None else f"axis.limits.{tight.key} is {tight.value:g}, "
            yield f"{_ends(tight, design.settings.unit)}; {limit}{_remedy(tight)}"


def _sentence(summary: dict[str, Any], lines: "list[str]") -> str:
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
        + "".join(f"\n{line}" for line in lines)
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
