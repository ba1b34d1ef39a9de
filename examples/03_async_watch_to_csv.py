"""Log every tick to a CSV file while another task moves the axis.

Start a simulated drive and a service first, in a terminal each: ``twostage-servo drive --config two_processes.toml``
and ``twostage-servo run --config two_processes.toml``.
"""

import asyncio
import csv
from pathlib import Path

import twostage_servo


async def log_to(path: Path, axis: twostage_servo.AsyncServoClient) -> None:
    """Write a line a tick, until the task is cancelled."""
    with path.open("w", newline="") as file:
        log = csv.writer(file)
        log.writerow(["time_s", "position", "velocity"])
        async for status in axis.watch(every=1):
            log.writerow([status.service.uptime_s, status.axis.position, status.axis.velocity])


async def main(path: Path = Path("velocity.csv")) -> None:
    """Move while the other task logs; an error anywhere in here stops the axis."""
    async with twostage_servo.connect_async() as axis:
        logging = asyncio.create_task(log_to(path, axis))
        await axis.arm()
        for position in (100.0, 150.0, 0.0):
            await axis.move(position, wait=True)
        await axis.disarm()
        logging.cancel()


if __name__ == "__main__":
    asyncio.run(main())
