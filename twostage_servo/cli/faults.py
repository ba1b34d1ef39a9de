"""`faults`: the fault campaign on an axis, in simulated time: what its limits mean in distance."""

import argparse
from typing import TYPE_CHECKING

from twostage_servo.cli.configuration import add_options, configuration_problems
from twostage_servo.cli.output import CommandError, ExitCode, Progress, bar, note, print_json, print_line
from twostage_servo.cli.result_file import check_result, write_result
from twostage_servo.cli.typed_names import file_path
from twostage_servo.cli.typed_numbers import whole
from twostage_servo.config.files import find_configuration
from twostage_servo.faults.phase import Phase

if TYPE_CHECKING:
    from twostage_servo.faults.cell import Cell


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verb."""
    faults = verbs.add_parser(
        "faults",
        help="inject faults into this axis in simulated time; show how it reacts and how far it travels",
        description="Inject 65 faults of bus, encoder, drive, host, operator and disk into the running service, in "
        "simulated time, on the axis of a configuration or on each axis of a machine: in six phases of a move, the "
        "severe ones also while homing and jogging, those of the encoder also while stopping. Show the reaction, and "
        "the travel that it costs against what the limits allow. Five faults need real processes and real time; "
        "--simulated omits them.",
    )
    add_options(faults, required=False)
    faults.add_argument("--fault", type=whole, action="append", metavar="N", help="only this fault; may be repeated")
    faults.add_argument(
        "--phase", choices=[phase.value for phase in Phase], action="append", help="only this phase; may be repeated"
    )
    faults.add_argument(
        "--seed", type=whole, default=1, metavar="N", help="seed of noise, sizes and times of the faults (default 1)"
    )
    faults.add_argument("--html", type=file_path, metavar="FILE", help="write the matrix as an HTML page")
    faults.add_argument("--simulated", action="store_true", help="omit the faults that need real processes")
    faults.set_defaults(run=_faults)


def _faults(options: argparse.Namespace) -> ExitCode:
    from twostage_servo.faults.report import as_json, as_page, as_text
    from twostage_servo.faults.runner import run_campaign
    from twostage_servo.faults.simulated_approach import NotOperableError

    if not 0 <= options.seed < 2**63:
        raise CommandError(ExitCode.USAGE, "usage", f"--seed {options.seed}: must be from 0 to 2^63 - 1")
    if options.html is not None:
        check_result(options.html, "page")
    path = find_configuration(options.config)
    progress = Progress(quiet=options.json)
    missed, reported, interrupted = 0, "no cell done", False

    def report(cell: "Cell", done: int, total: int) -> None:
        nonlocal missed, reported
        missed += not cell.met
        reported = f"{done} of {total} cells done, {missed} missed"
        progress.show(f"{bar(done / total)} {done} of {total}, {missed} missed: {cell.fault} {cell.name}, {cell.phase}")

    try:
        with configuration_problems():
            result = run_campaign(
                path, options.overrides, options.seed,
                faults=tuple(options.fault or ()),
                phases=[Phase(phase) for phase in options.phase] if options.phase else tuple(Phase),
                processes=not options.simulated,
                report=report,
            )  # fmt: skip
    except NotOperableError as error:
        raise CommandError(
            ExitCode.FAILED, "not_operable", f"{error}. `demo --fast` with this configuration shows the same move."
        ) from error
    except KeyboardInterrupt:
        interrupted = True
        raise
    finally:
        progress.end()
        if interrupted:
            note(f"twostage-servo faults: interrupted, {reported}")
    if not result.cells and not result.not_applicable:
        raise CommandError(
            ExitCode.USAGE, "usage", "there is no such fault, or not in this phase: see the list in docs/faults.md"
        )
    missed = sum(not cell.met for cell in result.cells)
    if options.json:
        print_json(as_json(result, options.seed))
    else:
        print_line(as_text(result))
        print_line(f"{len(result.cells) - missed} cells met, {missed} missed; seed {options.seed}")
    if options.html is not None:  # last: a page that cannot be written does not hide what took minutes
        what = f"{', '.join(f'axis {name}' for name in result.units)} of {path or 'the embedded demo.toml'}"
        write_result(options.html, as_page(result, options.seed, what).encode(), "page")
        note(f"page written to {options.html}")
    return ExitCode.FAILED if missed else ExitCode.DONE
