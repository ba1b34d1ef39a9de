"""Move two axes together: they set out in the same tick and arrive together.

Start two simulated drives and a service first, in a terminal each: ``twostage-servo drive --config two_axes.toml`` and
``twostage-servo run --config two_axes.toml``.
"""

import twostage_servo

CORNERS = ((100.0, 0.0), (100.0, 60.0), (0.0, 60.0), (0.0, 0.0))
"""Positions of x and y, in mm."""


def main() -> None:
    """Go round a rectangle; if one axis trips, the other stops, and what it tripped by is told."""
    with twostage_servo.connect() as machine:
        machine.arm()
        try:
            for x, y in CORNERS:
                machine.move({"x": x, "y": y}, wait=True)
        except twostage_servo.Tripped as error:
            print(f"{error.trip.code}: {error.trip.cause}\nNext: {error.trip.next_action}")
        machine.disarm()


if __name__ == "__main__":
    main()
