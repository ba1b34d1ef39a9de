"""`demo`: service and simulated drive in one process on the virtual bus; arms, moves, waits until there, stops."""

import argparse
import functools
from typing import TYPE_CHECKING, Any

from twostage_servo.cli.configuration import add_options, configuration_problems, load_configuration
from twostage_servo.cli.output import CommandError, ExitCode, Progress, bar, note, print_json, print_line
from twostage_servo.cli.result_file import as_csv, check_result, write_result
from twostage_servo.cli.typed_names import file_path
from twostage_servo.cli.typed_numbers import decimal, whole

if TYPE_CHECKING:
    from twostage_servo.app.demonstration import TracedTick


_PATIENCE = (
    "axis.limits.stale_feedback_ms=100",
    "axis.limits.missed_ticks=20",
    "axis.limits.innovation_gate=5",
    "simulation.command_timeout_ms=250",
)
"""What the embedded demo allows in real time: a busy desktop may well hold a process up for a tenth of a second."""

_MOST_MOVES = 1000

_CRUISE_S = 4.0
"""How long the demo's move would take at its cruise velocity."""


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verb."""
    demo = verbs.add_parser(
        "demo",
        help="move a simulated axis, all in this process",
        description="Run the service and a simulated drive in one process on the virtual bus: arm, move, wait for the "
        "position window, stop. Needs no hardware. In real time, the embedded configuration tolerates a busy "
        "machine: 100 ms without feedback, 20 missed ticks, 250 ms of silence at the drive.",
    )
    add_options(demo, required=False)
    demo.add_argument("--to", type=decimal, metavar="POSITION", help="set-point (default: 4 s of cruise away)")
    demo.add_argument("--velocity", type=decimal, help="cruise velocity (default: axis.cruise_velocity)")
    demo.add_argument(
        "--moves", type=_moves, default=1, metavar="N", help="so many moves, to the set-point and back (default 1)"
    )
    demo.add_argument("--fast", action="store_true", help="run in simulated time")
    demo.add_argument("--trace", type=file_path, metavar="FILE", help="write every tick to a CSV file")
    demo.set_defaults(run=_demo)


def _moves(text: str) -> int:
    count = whole(text)
    if not 1 <= count <= _MOST_MOVES:
        raise argparse.ArgumentTypeError(f"{count} moves: 1 to {_MOST_MOVES} can be made")
    return count


def _demo(options: argparse.Namespace) -> ExitCode:
    import asyncio

    from twostage_servo.app.demonstration import TRACE_FIELDS, demonstrate, trace_row
    from twostage_servo.service.log import open_log
    from twostage_servo.timing.ticks import real_time_loop
    from twostage_servo.timing.virtual_clock import VirtualClockLoop

    loaded = load_configuration(options, () if options.fast or options.config is not None else _PATIENCE)
    if options.trace is not None:
        check_result(options.trace, "trace")  # a path that cannot be written is told before the move
    level = loaded.config.service.log_level
    writer = open_log("debug" if level == "debug" else "critical")  # a trip stands in the summary
    progress = Progress(quiet=options.json or options.fast)
    try:
        axis, start = loaded.config.axis, loaded.config.simulation.initial_position
        velocity = axis.cruise_velocity if options.velocity is None else options.velocity
        farthest = min(max(start + _CRUISE_S * velocity, axis.limits.position_minimum), axis.limits.position_maximum)
        target = farthest if options.to is None else options.to
        show = functools.partial(_show, progress, axis.unit)
        realtime = None if options.fast else loaded.config.realtime
        loop_factory = VirtualClockLoop if options.fast else real_time_loop
        with asyncio.Runner(loop_factory=loop_factory) as runner, configuration_problems():
            demo = runner.run(demonstrate(loaded, target, velocity, show, realtime, options.moves))
    finally:
        progress.end()
        writer.close()
    if demo.refused is not None:
        raise CommandError(ExitCode.USAGE, demo.refused.code, str(demo.refused))
    if options.trace is not None:
        write_result(options.trace, as_csv([TRACE_FIELDS, *map(trace_row, demo.samples)]), "trace")
        note(f"{len(demo.samples)} ticks written to {options.trace}")
    result = demo.result()
    if options.json:
        print_json(result)
    else:
        print_line(_summary(result, loaded.config.axis.unit, fast=options.fast))
    return ExitCode.DONE if demo.failure is None else ExitCode.FAILED


def _show(progress: Progress, unit: str, share: float, tick: "TracedTick") -> None:
    progress.show(
        f"{bar(share)} {tick.true_position:9.2f} {unit} {tick.true_velocity:8.1f} {unit}/s  {tick.sample.state}"
    )


def _summary(result: dict[str, Any], unit: str, *, fast: bool) -> str:
    ticks, lateness, changeover = result["ticks"], result["ticks"]["lateness_us"], result["changeover"]
    if result["final_error"] is None:
        lines = [f"no move to {result['target']:g} {unit}: {result['failure']}"]
    else:
        settled = "never" if result["settling_time_s"] is None else f"after {result['settling_time_s']:.2f} s"
        lines = [
            "not done" if result["failure"] else f"moved to {result['target']:g} {unit}",
            (
                f"true position: within ±{result['settling_band']:g} {unit} {settled}, final error "
                f"{result['final_error']:+.4f} {unit}, overshoot {result['overshoot']:.3f} {unit}, peak velocity "
                f"{result['peak_velocity']:.1f} {unit}/s"
            ),
        ]
        if result["failure"]:
            lines[0] += f": {result['failure']}"
    if changeover:
        lines.append(
            f"change-over at {changeover['time_s']:.2f} s, {changeover['distance']:.2f} {unit} before the "
            f"set-point; the effort changed by {changeover['effort_step']:.3f} in that tick, "
            f"by up to {changeover['ordinary_effort_step']:.3f} in those before"
        )
    for number, move in enumerate(result["moves"][1:], 2):
        settled = "never" if move["settling_time_s"] is None else f"after {move['settling_time_s']:.2f} s"
        lines.append(
            f"move {number}, to {move['target']:g} {unit}: settled {settled}, final error {move['final_error']:+.4f} "
            f"{unit}, overshoot {move['overshoot']:.3f} {unit}"
        )
    clock = "simulated time" if fast else f"lateness p50 {lateness['p50']:g} µs, p99 {lateness['p99']:g} µs"
    frames = result["frames"]
    lines.append(
        f"{ticks['count']} ticks, {ticks['missed']} missed, {clock}; {frames['received']} frames received, "
        f"{frames['sent']} sent, {frames['rejected']} rejected"
    )
    if result["trip"]:
        lines.append(f"next: {result['trip']['next_action']}")
    return "\n".join(lines)
