"""Arm the axis, make three moves, and log its velocity to a CSV file.

Start a simulated drive and a service first, in a terminal each: ``twostage-servo drive --config two_processes.toml``
and ``twostage-servo run --config two_processes.toml``.
"""

import csv
from pathlib import Path

import twostage_servo


def main(path: Path = Path("velocity.csv")) -> None:
    """Log to a file; an error anywhere in here stops the axis."""
    with twostage_servo.connect() as axis, path.open("w", newline="") as file:
        log = csv.writer(file)
        log.writerow(["time_s", "position", "velocity"])

        def write(status: twostage_servo.Status) -> None:
            log.writerow([status.service.uptime_s, status.axis.position, status.axis.velocity])

        axis.arm()
        for position in (100.0, 150.0, 0.0):
            axis.move(position, wait=True, progress=write)
        axis.disarm()


if __name__ == "__main__":
    main()
