"""Reads a configuration again and designs its axes, in a process of its own: 32 axes take most of a second.

A thread would not do. What it computes it computes with the interpreter's lock, for which each tick would have to wait.

:func:`main` reads a :class:`Job` from the standard input, and writes what came of it to the standard output, both as
pickles: they come from the service that has started it, and go to nobody else.
"""

import pickle
import sys
from pathlib import Path
from typing import NamedTuple

from twostage_servo.app.assembly import prepare_axes
from twostage_servo.axis.messages import DriveTraits
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.machine import Machine, load_machine


class Job(NamedTuple):
    """What is to be done.

    Attributes
    ----------
    path, overrides
        The configuration, as in :func:`~twostage_servo.config.machine.load_machine`.
    running
        A pickle of the machine that runs.
    traits
        What the axes have to know of their drives, by their names and in their order.
    period_s
        Length of a tick in s.
    """

    path: Path | None
    overrides: tuple[str, ...]
    running: bytes
    traits: dict[str, DriveTraits]
    period_s: float


class Prepared(NamedTuple):
    """What came of it: pickles of the machine and of each axis; or the problem that keeps it from being used."""

    source: str
    machine: bytes
    axes: tuple[bytes, ...]
    problem: str | None = None


def prepare(job: Job) -> Prepared:
    """Read the configuration, and design its axes."""
    running: Machine = pickle.loads(job.running)  # noqa: S301 - see the module's text
    try:
        fresh = load_machine(job.path, job.overrides)
        axes = prepare_axes(job.traits, running, fresh, job.period_s)
    except ConfigError as error:
        return Prepared("", b"", (), f"the configuration cannot be used\n{error}")
    return Prepared(fresh.source, pickle.dumps(fresh), tuple(pickle.dumps(axis) for axis in axes))


def main() -> None:
    """Do the job that stands on the standard input."""
    job: Job = pickle.loads(sys.stdin.buffer.read())  # noqa: S301 - see the module's text
    sys.stdout.buffer.write(pickle.dumps(prepare(job)))
