"""The long-running verbs: `run`, the service, and `drive`, a simulated drive as a process of its own."""

import argparse
from contextlib import contextmanager
from typing import TYPE_CHECKING

from twostage_servo.cli.configuration import add_options, configuration_problems, load_machine
from twostage_servo.cli.extras import require
from twostage_servo.cli.output import CommandError, ExitCode, print_json
from twostage_servo.config.files import find_configuration

if TYPE_CHECKING:
    from collections.abc import Iterator

    from twostage_servo.config.machine import Machine


def add_verbs(verbs: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the verbs."""
    run = verbs.add_parser(
        "run",
        help="run the service",
        description="Run the service until SIGTERM or Ctrl-C; it then brakes and disables its axes. It does the same "
        "on any other signal that can be caught, and ends with exit code 128 plus the signal's number.",
    )
    add_options(run, required=True)
    run.set_defaults(run=_run)
    drive = verbs.add_parser(
        "drive",
        help="run a simulated drive",
        description="Run a simulated drive on the configured bus until SIGTERM or Ctrl-C.",
    )
    add_options(drive, required=True)
    drive.set_defaults(run=_drive)


def _run(options: argparse.Namespace) -> int:
    from twostage_servo.host.garbage import postponed

    with postponed():
        return _run_service(options)


def _run_service(options: argparse.Namespace) -> int:
    from twostage_servo.service.ending_signals import EndingSignals

    with EndingSignals() as signals:
        from twostage_servo.app.serve import serve

        machine = _load(options)
        with configuration_problems(), _start_errors():
            served = serve(machine, signals, find_configuration(options.config), options.overrides)
        if options.json:
            print_json(served.snapshot)
        # A signal that is a failure says so; else it is told what became of the drives.
        return signals.exit_code or (ExitCode.FAILED if served.not_disabled else ExitCode.DONE)


def _drive(options: argparse.Namespace) -> int:
    from twostage_servo.service.ending_signals import EndingSignals

    with EndingSignals() as signals:
        from twostage_servo.app.simulate import simulate

        machine = _load(options)
        with configuration_problems(), _start_errors():
            summaries = simulate(machine, signals)
        if options.json:
            print_json(summaries[0] if len(summaries) == 1 else {"drives": summaries})
        return signals.exit_code


def _load(options: argparse.Namespace) -> "Machine":
    machine = load_machine(options)
    if any(loaded.config.bus.interface == "udp_multicast" for loaded in machine.axes):
        require("multicast", 'a bus with interface = "udp_multicast"')
    return machine


@contextmanager
def _start_errors() -> "Iterator[None]":
    """Let what keeps a service or a drive from starting end the verb with its text.

    Raises
    ------
    CommandError
        In place of a :class:`twostage_servo.app.start_error.StartError`.
    """
    from twostage_servo.app.start_error import StartError

    try:
        yield
    except StartError as error:
        raise CommandError(ExitCode.USAGE if error.is_usage else ExitCode.FAILED, error.code, str(error)) from error
