"""Reads a configuration again and designs its axes, in a process of its own: 32 axes take most of a second.

A thread would not do. What it computes it computes with the interpreter's lock, for which each tick would have to wait.

:func:`main` reads a :class:`Job` from the standard input, and writes what came of it to the standard output, both as
pickles: they come from the service that has started it, and go to nobody else.
"""

import pickle
import sys
import traceback
from pathlib import Path
from typing import NamedTuple

from twostage_servo.app.assembly import prepare_axes
from twostage_servo.axis.design import AxisDesign
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


class Failure(NamedTuple):
    """What kept a job from being done, other than the configuration: for the operator, and in full for the log."""

    text: str
    details: str

    @classmethod
    def of(cls, error: Exception) -> "Failure":
        """Return what an error that nobody has foreseen says, and where it was raised."""
        *_, place = traceback.extract_tb(error.__traceback__)
        what = "".join(traceback.format_exception_only(error)).strip()
        return cls(f"{what} ({place.filename}:{place.lineno})", "".join(traceback.format_exception(error)))


class Prepared(NamedTuple):
    """What came of it: the machine and the designs of its axes; or what keeps them from being used.

    Attributes
    ----------
    source
        The file.
    machine
        A pickle of the machine.
    designs
        A pickle of each axis' design; None for one that cannot be sent, since the design of another package's law may
        hold anything, such as a function that was made in it.
    problem
        What is wrong with the configuration.
    failure
        What else has gone wrong.
    """

    source: str
    machine: bytes
    designs: tuple[bytes | None, ...]
    problem: str | None = None
    failure: Failure | None = None


def prepare(job: Job) -> Prepared:
    """Read the configuration, and design its axes."""
    try:
        running: Machine = pickle.loads(job.running)  # noqa: S301 - see the module's text
        fresh = load_machine(job.path, job.overrides)
        axes = prepare_axes(job.traits, running, fresh, job.period_s)
        return Prepared(fresh.source, pickle.dumps(fresh), tuple(_packed(axis.design) for axis in axes))
    except ConfigError as error:
        return Prepared("", b"", (), problem=f"the configuration cannot be used\n{error}")
    except Exception as error:  # noqa: BLE001 - laws and drives of other packages may raise anything
        return Prepared("", b"", (), failure=Failure.of(error))


def _packed(design: AxisDesign) -> bytes | None:
    try:
        packed = pickle.dumps(design)
        pickle.loads(packed)  # noqa: S301 - made here
    except Exception:  # noqa: BLE001 - what other packages bring may raise anything
        return None
    return packed


def main() -> None:
    """Do the job that stands on the standard input."""
    job: Job = pickle.loads(sys.stdin.buffer.read())  # noqa: S301 - see the module's text
    sys.stdout.buffer.write(pickle.dumps(prepare(job)))
