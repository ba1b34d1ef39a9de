"""Tick statistics in constant memory."""

from twostage_servo.api.status import HistogramBin, TickStatus, Times
from twostage_servo.timing.histogram import TimeHistogram

PHASES = ("read", "update", "hold", "write", "publish")
"""Parts of a tick, in their order; in ``hold`` the commands are ready and wait for their time."""


class TickStatistics:
    """What the ticks of a service were like.

    Attributes
    ----------
    uptime_s
        How long the service had run when the latest tick was due, in s.
    count, missed
        Ticks served, and deadlines that passed unserved.
    lateness
        How long after their deadlines the ticks began.
    duration
        How long each phase of a tick took, and the whole of it.
    """

    def __init__(self) -> None:
        self.uptime_s = 0.0
        self.count = 0
        self.missed = 0
        self.lateness = TimeHistogram()
        self.duration = {name: TimeHistogram() for name in (*PHASES, "whole")}

    def begin(self, uptime_s: float, lateness_s: float, missed: int) -> None:
        """Count a tick as it begins."""
        self.uptime_s = uptime_s
        self.count += 1
        self.missed += missed
        self.lateness.add(lateness_s)

    def end(self, *times_s: float) -> None:
        """Record the times, on one clock in s, at which the phases began, and at which the last one ended."""
        for histogram, begun_s, ended_s in zip(self.duration.values(), times_s, times_s[1:], strict=False):
            histogram.add(ended_s - begun_s)
        self.duration["whole"].add(times_s[-1] - times_s[0])

    def summary(self) -> TickStatus:
        """Return all of it."""
        return TickStatus(
            count=self.count,
            missed=self.missed,
            lateness_us=times_of(self.lateness),
            lateness_histogram=[
                HistogramBin(up_to_us=edge_us, ticks=ticks) for edge_us, ticks in self.lateness.histogram()
            ],
            duration_us={name: times_of(histogram) for name, histogram in self.duration.items()},
        )


def times_of(histogram: TimeHistogram) -> Times:
    """Return the percentiles of a histogram that are told, in µs."""
    p50, p90, p99 = histogram.percentiles_us(50.0, 90.0, 99.0)
    return Times(p50=round(p50, 1), p90=round(p90, 1), p99=round(p99, 1), max=round(histogram.largest_us, 1))
