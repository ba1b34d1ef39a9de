"""Makes a service punctual on its host: real-time set-up, early wake-up, garbage between ticks, a warm start."""

import asyncio
import contextlib
from collections.abc import Callable, Iterator, Sequence

import structlog

from twostage_servo.api.status import GarbageStatus, RealtimeStatus, Refusal
from twostage_servo.axis.state import DRIVEN
from twostage_servo.host import realtime
from twostage_servo.host.garbage import GarbageCollection, resume
from twostage_servo.host.realtime import RealtimeReport
from twostage_servo.host.settings import RealtimeSettings
from twostage_servo.host.warm_up import warm_up
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.runtime import Runtime
from twostage_servo.timing.output_offset import OutputOffset, output_offset
from twostage_servo.timing.ticks import Ticks
from twostage_servo.timing.wake_margin import wake_margin


@contextlib.contextmanager
def punctual(
    settings: RealtimeSettings,
    axis_loops: Sequence[AxisLoop],
    period_s: float,
    sign_of_life: Callable[[float], None] | None = None,
) -> Iterator[Runtime]:
    """Set the calling thread, which is to run the service in real time, up as the settings say.

    What the kernel refuses is a warning, with its remedy; what it has granted stands in the log and in the snapshot.

    Parameters
    ----------
    settings
        The table ``[realtime]``.
    axis_loops
        The axes of the service.
    period_s
        Length of a tick in s.
    sign_of_life
        Called with the loop's time in s after each completed tick.
    """
    log = structlog.get_logger().bind(room="realtime")
    report = realtime.apply(settings)
    for grant in report.grants:
        if grant.warning:
            log.warning(grant.warning, what=grant.name, asked=grant.asked, remedy=grant.remedy)
        else:
            log.info("granted", what=grant.name, granted=grant.granted)
    ticks = Ticks(period_s, margin=wake_margin(settings.busy_wait, period_s))
    offset = output_offset(settings.output_offset, settings.busy_wait, period_s)
    for axis_loop in axis_loops:
        law = axis_loop.axis.design.build_law()
        law.set_target(1.0, 1.0)
        warm_up(lambda law=law: law.step(None))  # type: ignore[misc]
    garbage = GarbageCollection() if settings.collect_garbage == "between_ticks" else None
    idle = () if garbage is None else (_Collector(garbage, axis_loops),)
    if garbage is None:
        resume()  # the start has postponed it
    else:
        garbage.begin()
    try:
        yield Runtime(
            ticks, offset, idle, sign_of_life, lambda: _report(settings, report, ticks.margin_s, offset, garbage)
        )
    finally:
        if garbage is not None:
            garbage.end()


class _Collector:
    """Collects garbage in what a tick leaves of its period."""

    def __init__(self, garbage: GarbageCollection, axis_loops: Sequence[AxisLoop]) -> None:
        self._garbage = garbage
        self._axis_loops = axis_loops

    def open(self, until_s: float) -> None:
        """Collect, if there is the time."""
        driven = any(axis_loop.axis.state in DRIVEN for axis_loop in self._axis_loops)
        self._garbage.after_tick(until_s - asyncio.get_running_loop().time(), driven=driven)

    def end(self) -> None:
        """Do nothing: the collector is given back when the service has ended."""


def _report(
    settings: RealtimeSettings,
    report: RealtimeReport,
    margin_s: float,
    offset: OutputOffset | None,
    garbage: GarbageCollection | None,
) -> RealtimeStatus:
    return RealtimeStatus(
        busy_wait=settings.busy_wait,
        margin_us=round(1e6 * margin_s, 1),
        output_offset=settings.output_offset,
        output_offset_us=None if offset is None else round(1e6 * offset.offset_s, 1),
        granted={grant.name: grant.granted for grant in report.grants if not grant.warning},
        refused=[
            Refusal(what=grant.name, asked=grant.asked, why=grant.warning, remedy=grant.remedy)
            for grant in report.warnings
        ],
        garbage=None
        if garbage is None
        else GarbageStatus(
            collections=garbage.collections,
            postponed=garbage.postponed,
            longest_us=round(1e6 * garbage.longest_s, 1),
        ),
    )
