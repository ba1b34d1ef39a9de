"""Lets a running service have the axes of a configuration that was read again, without holding up its ticks."""

import asyncio
import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

from twostage_servo.app.axes_preparation import Job, Prepared
from twostage_servo.app.build import Parts, replace_axes, traits_of
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.service.background_server import Priority
from twostage_servo.worker_thread import WorkerThread

if TYPE_CHECKING:
    from twostage_servo.axis.axis import Axis

LONGEST_S: Final = 60.0
_COMMAND: Final = (sys.executable, "-P", "-c", "from twostage_servo.app.axes_preparation import main; main()")
_LAST_WORDS: Final = 500


class Reloading:
    """Reads a service's configuration again.

    Another process reads it and designs the axes (:mod:`~twostage_servo.app.axes_preparation`). The loop takes them
    over one in a turn, between ticks, and puts all of them in force at once.

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
            If it cannot be used.
        """
        loop = asyncio.get_running_loop()
        try:
            prepared = await loop.run_in_executor(self._thread, self._carry_out, self._job)
        except (OSError, RuntimeError, MemoryError, subprocess.SubprocessError) as error:
            text = f"the configuration could not be read again, and nothing has changed: {error}"
            raise Refused(RefusalCode.CONFIG, text) from error
        if prepared.problem is not None:
            raise Refused(RefusalCode.CONFIG, prepared.problem)
        axes: list[Axis] = []
        for packed in prepared.axes:
            async with self._parts.background.slot(Priority.REQUEST):
                axes.append(pickle.loads(packed))  # noqa: S301 - from the process that was started here
        return lambda: self._apply(prepared, axes)

    def _apply(self, prepared: Prepared, axes: "list[Axis]") -> None:
        replace_axes(self._parts, axes)
        self._job = self._job._replace(running=prepared.machine)
        structlog.get_logger().info("configuration read again", config=prepared.source)


def by_a_process(job: Job) -> Prepared:
    """Have a job done by a process of its own, which has no priority over what else runs; waits for it.

    Raises
    ------
    OSError, subprocess.SubprocessError
        If it cannot be started, takes too long, or fails.
    """
    with contextlib.suppress(OSError):  # where even that is forbidden, threads do not inherit the priority
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # of this thread, and so of the process
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(  # noqa: S603 - our own module
        _COMMAND, input=pickle.dumps(job), capture_output=True, timeout=LONGEST_S, env=environment, check=False
    )
    if done.returncode != 0:
        words = done.stderr.decode("utf-8", "replace")[-_LAST_WORDS:].strip()
        raise subprocess.SubprocessError(f"the process that reads it ended with code {done.returncode}: {words}")
    prepared: Prepared = pickle.loads(done.stdout)  # noqa: S301 - from the process that was started here
    return prepared
