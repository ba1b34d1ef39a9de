"""How long and how often everything is measured."""

from dataclasses import dataclass
from typing import Final

PERIOD_S: Final = 0.01
HOST: Final = "127.0.0.1"

PATIENT: Final = (
    "axis.limits.stale_feedback_ms=3000", "axis.limits.heartbeat_ms=3000", "axis.limits.missed_ticks=300",
    "axis.limits.feedback_errors=100", "axis.limits.following_error_minimum=500", "axis.limits.innovation_gate=500",
    "service.log_level=warning",
)  # fmt: skip
"""Overrides with which the axis goes on moving on a busy machine: its punctuality is measured, not its limits."""


@dataclass(frozen=True, slots=True)
class Plan:
    """One run's lengths.

    Attributes
    ----------
    lateness_rounds, lateness_s
        Rounds over all loops, every other one in the opposite order; and how long each loop runs in a round.
    frame_rounds, frames_s, frame_settling_s
        Rounds over all senders, how long each of them is listened to in a round, and how long the service has run by
        then.
    step_rounds, tick_count, real_ticks
        Rounds of the control step; timed ticks of the whole tick, in simulated and in real time, where 0 is none.
    memory_warm_up, memory_ticks
        Ticks before the resident memory is read first, and between the two readings.
    client_rounds, clients_s
        Rounds over the kinds of clients, and how long the service is watched with each; 0 leaves them out.
    short_ticks_s
        How long the tick of 1 ms runs; 0 leaves it out.
    stops
        How often somebody stops beside each kind of load; 0 leaves it out.
    starts, asks, cpu_s
        Starts of the service, calls of `status`, and how long the service's share of a core is looked at.
    """

    lateness_rounds: int
    lateness_s: float
    frame_rounds: int
    frames_s: float
    frame_settling_s: float
    step_rounds: int
    tick_count: int
    real_ticks: int
    memory_warm_up: int
    memory_ticks: int
    client_rounds: int
    clients_s: float
    short_ticks_s: float
    stops: int
    starts: int
    asks: int
    cpu_s: float


FULL: Final = Plan(4, 4.0, 4, 6.0, 3.0, 40, 20_000, 1_000, 50_000, 1_000_000, 2, 10.0, 60.0, 200, 5, 10, 15.0)
QUICK: Final = Plan(1, 0.7, 1, 0.7, 1.0, 8, 2_000, 0, 1_000, 4_000, 0, 0.0, 0.0, 0, 1, 3, 1.5)
