"""Makes a service punctual on its host: real-time set-up, early wake-up, garbage between ticks, a warm start."""

import contextlib
from collections.abc import Callable, Iterator

import structlog

from twostage_servo.api.status import GarbageStatus, RealtimeStatus, Refusal
from twostage_servo.axis.state import DRIVEN
from twostage_servo.host import realtime
from twostage_servo.host.garbage import GarbageCollection
from twostage_servo.host.realtime import RealtimeReport
from twostage_servo.host.settings import RealtimeSettings
from twostage_servo.host.warm_up import warm_up
from twostage_servo.service.servo_service import ServoService
from twostage_servo.timing.output_offset import output_offset
from twostage_servo.timing.ticks import Tick
from twostage_servo.timing.wake_margin import wake_margin


@contextlib.contextmanager
def punctual(service: ServoService, settings: RealtimeSettings) -> Iterator[None]:
    """Set the calling thread, which is to run the service in real time, up as the settings say.

    What the kernel refuses is a warning, with its remedy; what it has granted stands in the log and in the snapshot.
    """
    log = structlog.get_logger().bind(room="realtime")
    report = realtime.apply(settings)
    for grant in report.grants:
        if grant.warning:
            log.warning(grant.warning, what=grant.name, asked=grant.asked, remedy=grant.remedy)
        else:
            log.info("granted", what=grant.name, granted=grant.granted)
    service.ticks.margin = wake_margin(settings.busy_wait, service.ticks.period_s)
    service.output_offset = output_offset(settings.output_offset, settings.busy_wait, service.ticks.period_s)
    for axis_loop in service.axis_loops:
        law = axis_loop.axis.design.build_law()
        law.set_target(1.0, 1.0)
        warm_up(lambda law=law: law.step(None))  # type: ignore[misc]
    garbage = GarbageCollection() if settings.collect_garbage == "between_ticks" else None
    service.host = lambda: _report(service, settings, report, garbage)
    if garbage is None:
        yield
        return
    garbage.begin()
    service.after_tick = _collector(service, garbage)
    try:
        yield
    finally:
        service.after_tick = None
        garbage.end()


def _collector(service: ServoService, garbage: GarbageCollection) -> Callable[[Tick, float], None]:
    period_s = service.ticks.period_s

    def after_tick(tick: Tick, now_s: float) -> None:
        driven = any(axis_loop.axis.state in DRIVEN for axis_loop in service.axis_loops)
        garbage.after_tick(tick.deadline_s + period_s - service.ticks.margin_s - now_s, driven=driven)

    return after_tick


def _report(
    service: ServoService, settings: RealtimeSettings, report: RealtimeReport, garbage: GarbageCollection | None
) -> RealtimeStatus:
    return RealtimeStatus(
        busy_wait=settings.busy_wait,
        margin_us=round(1e6 * service.ticks.margin_s, 1),
        output_offset=settings.output_offset,
        output_offset_us=None if service.output_offset is None else round(1e6 * service.output_offset.offset_s, 1),
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
