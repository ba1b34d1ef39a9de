"""Lets a running service have the axes of a configuration that was read again, without holding up its ticks."""

import asyncio
import contextlib
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

from twostage_servo.app.assembly import design
from twostage_servo.app.axes_preparation import Failure, Job, Prepared
from twostage_servo.app.build import Parts, replace_axes, traits_of
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.portable_error import PortableError
from twostage_servo.service.background_server import Priority
from twostage_servo.worker_thread import WorkerThread

if TYPE_CHECKING:
    from twostage_servo.config.machine import Machine

LONGEST_S: Final = 60.0
_LONGEST_LINE: Final = 500
_COMMAND: Final = (sys.executable, "-P", "-c", "from twostage_servo.app.axes_preparation import main; main()")


class ReadingError(PortableError):
    """The configuration could not be read again, through no fault of its own.

    Attributes
    ----------
    details
        All that is known of it, for the log.
    """

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.text)
        self.details = failure.details


class Reloading:
    """Reads a service's configuration again.

    Another process reads it, designs the axes and checks them (:mod:`~twostage_servo.app.axes_preparation`). A thread
    takes the designs over, and makes again what cannot be sent: such a design holds the lock of the interpreter for the
    switch interval at most. The loop builds an axis of each in one turn, between ticks, and puts all of them in
    force at once.

    Parameters
    ----------
    parts
        The service, with the configuration that it runs on.
    path, overrides
        What is read again; see :func:`~twostage_servo.config.machine.load_machine`.
    carry_out
        Has the job done, in a thread: by a process, if not told otherwise.
    """

    def __init__(
        self,
        parts: Parts,
        path: Path | None,
        overrides: Sequence[str],
        carry_out: Callable[[Job], Prepared] | None = None,
    ) -> None:
        self._parts = parts
        self._job = Job(
            path,
            tuple(overrides),
            pickle.dumps(parts.machine),
            traits_of(parts.axis_loops),
            parts.period_s,
        )
        self._carry_out = carry_out or by_a_process
        self._thread = WorkerThread("read_configuration")

    async def prepare(self) -> Callable[[], None]:
        """Read the configuration and design its axes; return what puts them in force.

        Raises
        ------
        Refused
            If it cannot be used, or not be read.
        """
        loop = asyncio.get_running_loop()
        axes: list[Axis] = []
        try:
            prepared, designs = await loop.run_in_executor(self._thread, self._read)
            for designed, traits in zip(designs, self._job.traits.values(), strict=True):
                async with self._parts.background.slot(Priority.REQUEST):
                    axes.append(Axis(designed, traits))
        except Refused:
            raise
        except Exception as error:
            failure = Failure(str(error), error.details) if isinstance(error, ReadingError) else Failure.of(error)
            structlog.get_logger().error("the configuration could not be read again", exception=failure.details)
            text = (
                f"the configuration could not be read again, and nothing has changed: {failure.text}. The log has more"
            )
            raise Refused(RefusalCode.RELOAD_FAILED, text) from error
        return lambda: self._apply(prepared, axes)

    def _read(self) -> tuple[Prepared, list[AxisDesign]]:
        """Have the job done, and take the designs over; in a thread."""
        prepared = self._carry_out(self._job)
        if prepared.failure is not None:
            raise ReadingError(prepared.failure)
        if prepared.problem is not None:
            raise Refused(RefusalCode.CONFIG, prepared.problem)
        fresh: Machine = pickle.loads(prepared.machine)  # noqa: S301 - from the process that was started here
        return prepared, [
            pickle.loads(packed)  # noqa: S301
            if packed is not None
            else design(fresh.axis(name), self._job.period_s, traits)
            for (name, traits), packed in zip(self._job.traits.items(), prepared.designs, strict=True)
        ]

    def _apply(self, prepared: Prepared, axes: list[Axis]) -> None:
        replace_axes(self._parts, axes)
        self._job = self._job._replace(running=prepared.machine)
        structlog.get_logger().info("configuration read again", config=prepared.source)


def by_a_process(job: Job) -> Prepared:
    """Have a job done by a process of its own, which has no priority over what else runs; waits for it.

    Raises
    ------
    OSError, ReadingError
        If it cannot be started, takes too long, or fails.
    """
    with contextlib.suppress(OSError):  # where even that is forbidden, threads do not inherit the priority
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # of this thread, and so of the process
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        done = subprocess.run(  # noqa: S603 - our own module
            _COMMAND, input=pickle.dumps(job), capture_output=True, timeout=LONGEST_S, env=environment, check=False
        )
    except subprocess.TimeoutExpired as error:
        words = (error.stderr or b"").decode("utf-8", "replace").strip()
        raise ReadingError(Failure(f"the process that reads it had not ended after {LONGEST_S:g} s", words)) from error
    if done.returncode != 0:
        raise ReadingError(_end_of(done.returncode, done.stderr.decode("utf-8", "replace").strip()))
    prepared: Prepared = pickle.loads(done.stdout)  # noqa: S301 - from the process that was started here
    return prepared


def _end_of(code: int, words: str) -> Failure:
    """Return how a process has failed, with its last line, which is what the whole traceback above it comes to."""
    how = f"was ended by signal {-code} ({signal.strsignal(-code)})" if code < 0 else f"ended with code {code}"
    said = f": {words.splitlines()[-1][:_LONGEST_LINE]}" if words else ""
    return Failure(f"the process that reads it {how}{said}", words)
