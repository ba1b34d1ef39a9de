"""Move two axes together: they set out in the same tick and arrive together.

Start two simulated drives and a service first, in a terminal each: ``twostage-servo drive --config two_axes.toml`` and
``twostage-servo run --config two_axes.toml``.
"""

import sys

import twostage_servo

CORNERS = ((100.0, 0.0), (100.0, 60.0), (0.0, 60.0), (0.0, 0.0))
"""Positions of x and y, in mm."""


def main() -> int:
    """Go round a rectangle; if one axis trips, the other stops, and it is told which has tripped, and by what."""
    code = 0
    with twostage_servo.connect() as machine:
        machine.arm()
        try:
            for x, y in CORNERS:
                machine.move({"x": x, "y": y}, wait=True)
        except twostage_servo.Tripped as error:
            print(
                f"Axis {error.axis} has tripped, {error.trip.code}: {error.trip.cause}\nNext: {error.trip.next_action}"
            )
            code = 3  # as the commands have it
        machine.disarm()
    return code


if __name__ == "__main__":
    sys.exit(main())
