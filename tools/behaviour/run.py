"""What the service does, frame by frame, as a hash a run: two trees that behave the same print the same.

A demonstration has a second hash of what it prints beside its frames, which a changed sentence changes too.

``python -m tools.behaviour.run > before.txt``, then the same in the other tree, on the same machine, and ``diff`` says
which runs differ. The runs are the demonstrations of all shipped configurations, the demo with faults that its
simulated drive has, and a machine of two axes on one bus, of which one trips. All of it is in simulated time; with
``--json`` as one JSON object.
"""

import argparse
import asyncio
import contextlib
import hashlib
import io
import json
import os
import struct
import sys
from pathlib import Path
from typing import Final

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from twostage_servo.api.request_reading import read_request
from twostage_servo.app.closed_loop import ClosedLoop, Wires, closed_loop
from twostage_servo.axis.refusals import Refused
from twostage_servo.canbus.link import BusSettings
from twostage_servo.cli.main import main as run_verb
from twostage_servo.config.machine import load_machine
from twostage_servo.service.log import open_log
from twostage_servo.timing.virtual_clock import run

_CONFIGURATIONS: Final = Path(__file__).parents[2] / "config"
_FAULTS: Final = {
    "frames are lost": ("simulation.frame_loss=0.1",),
    "a load sets in": ("simulation.load=6", "simulation.load_at_s=2"),
    "another plant, and a delay": ("simulation.gain=225", "simulation.pole=11", "simulation.delay_ms=5"),
    "noise on a coarse encoder": ("simulation.noise_std=0.05", "simulation.quantum=0.1"),
    "a hard stop on the way": ("simulation.hard_stop_maximum=150",),
    "a limit switch on the way": ("simulation.positive_limit_from=250",),
    "a drive that is too impatient": ("simulation.command_timeout_ms=9",),
    "an axis that does not move": ("simulation.coulomb_friction=40",),
}
"""Overrides of the demo's configuration, by what is wrong then."""

_SCRIPT: Final[tuple[tuple[float, dict[str, object] | str], ...]] = (
    (0.5, {"op": "arm"}),
    (0.5, {"op": "move", "positions": {"x": 120.0, "y": 200.0}}),
    (2.0, {"op": "move", "axis": "x", "position": -80.0, "velocity": 150.0}),
    (1.0, {"op": "stop", "axis": "x"}),
    (1.5, {"op": "jog", "axis": "x", "velocity": -40.0}),
    (0.5, {"op": "move", "axis": "y", "by": -60.0}),
    (0.3, {"op": "stop", "quick": True}),
    (1.0, {"op": "move", "axis": "y", "position": 20.0}),
    (1.0, "turn the encoder of y round"),
    (2.0, {"op": "disarm"}),
    (1.0, {"op": "reset"}),
    (0.5, {"op": "home", "axis": "y", "position": 10.0}),
    (0.5, {"op": "arm", "axis": "x"}),
    (1.0, {"op": "status"}),
)
"""Seconds to wait, and what is asked for or goes wrong then."""


def demonstration(configuration: str, overrides: tuple[str, ...]) -> str:
    """Return the exit code of one demonstration, the hash of its frames, and that of all else that it prints."""
    arguments = ["demo", "--fast", "--json", "--config", str(_CONFIGURATIONS / configuration)]
    for override in overrides:
        arguments += ["--set", override]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
        code = run_verb(arguments)
    result = json.loads(printed.getvalue())
    result.get("ticks", {}).pop("lateness_us", None)  # measured on the processor's clock, where there is any
    frames = result.pop("trace_sha256")
    return f"{code} frames {frames} beside {_digest(json.dumps(result, sort_keys=True).encode())}"


async def two_axes() -> str:
    """Return the hash of all frames of two axes on a bus, and of what their requests came to."""
    clock, seen, wires = asyncio.get_running_loop(), hashlib.sha256(), Wires()
    machine = load_machine(_CONFIGURATIONS / "two_axes.toml")
    bus = BusSettings(interface="socketcan", channel="can0")
    listener = wires.wire(bus).attach("listener")

    async def listen() -> None:
        while True:
            while (frame := listener.recv(0)) is not None:
                seen.update(struct.pack("<dIB", frame.timestamp, frame.arbitration_id, len(frame.data)) + frame.data)
            await asyncio.sleep(0.001)

    async with closed_loop(machine, bus=bus, wires=wires) as loop:
        listening = asyncio.create_task(listen())
        for wait_s, step in _SCRIPT:
            await asyncio.sleep(wait_s)
            if isinstance(step, str):
                drive = loop.axes["y"].drive
                place = drive.position
                drive.change(clock.time(), measure=lambda position, place=place: 2.0 * place - position)
            else:
                seen.update(_ask(loop, step).encode())
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)
    listener.shutdown()
    return seen.hexdigest()


def _ask(loop: ClosedLoop, request: dict[str, object]) -> str:
    """Return what a request came to: its refusal, or how each axis is then."""
    try:
        loop.requests.handle(read_request(request))
    except Refused as refused:
        return f"{refused.code}: {refused}"
    return json.dumps(
        [
            (axis.state, axis.drive.position, None if axis.trip is None else (axis.trip.code, axis.trip.cause))
            for axis in (one.axis for one in loop.service.axis_loops)
        ]
    )


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def main() -> int:
    """Run all, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    hashes: dict[str, str] = {}

    def keep(name: str, what: str) -> None:
        hashes[name] = what
        if not options.json:
            print(f"{name}: {what}", flush=True)

    machines = {"two_axes.toml"}
    for path in sorted(_CONFIGURATIONS.glob("*.toml")):
        if path.name not in machines:
            keep(path.name, demonstration(path.name, ()))
    for name, overrides in _FAULTS.items():
        keep(f"demo.toml, {name}", demonstration("demo.toml", overrides))
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        writer = open_log("critical", nowhere)
        keep("two axes on one bus", run(two_axes()))
        writer.close()
    if options.json:
        print(json.dumps(hashes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
