"""Coordinated moves: all axes set out in one tick and arrive together."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from twostage_servo.axis.axis import Axis


def velocities_to_arrive_together(moves: "Sequence[tuple[Axis, float, float]]") -> list[float]:
    """Return a cruise velocity for each move, with which none arrives before the one that takes longest.

    Parameters
    ----------
    moves
        Axis, set-point in its unit, and the largest velocity in its unit/s; the axes are at rest.
    """
    distances = [abs(target - axis.estimate.position) for axis, target, _ in moves]
    longest_s = max(
        axis.duration.duration_s(distance, fastest)
        for (axis, _, fastest), distance in zip(moves, distances, strict=True)
    )
    return [
        axis.duration.velocity_for(distance, longest_s, fastest)
        for (axis, _, fastest), distance in zip(moves, distances, strict=True)
    ]
