"""What the coverage-guided fuzzers call: one frame for the codec, or some lines for the control socket."""

import asyncio
import tempfile
from pathlib import Path

import can

from tools.fuzz.bench import Bench, BenchLoop
from tools.fuzz.drives import Kind, all_drives
from tools.fuzz.frames import compare_with_reference
from tools.fuzz.line_maker import Line
from tools.fuzz.lines import ControlSocketRig, corpus
from tools.fuzz.quiet_log import quiet_log
from tools.fuzz.reproducible import reproducible
from twostage_servo.axis.state import State

_MOST_LINES = 20
_MOST_TICKS_TO_REST = 150


class CodecTarget:
    """Decodes three bytes (message, checksum and length, kind of frame) and then the data of a frame."""

    def __init__(self) -> None:
        by_layout = {drive.loaded.config.protocol.model_dump_json(): drive for drive in all_drives()}
        self.kinds: list[Kind] = [kind for drive in by_layout.values() for kind in drive.kinds.values()]

    def __call__(self, data: bytes) -> None:
        """Hold the codec to the reference; raises what goes wrong."""
        if len(data) < 3:
            return
        which, repaired, bits = data[:3]
        kind = self.kinds[which % len(self.kinds)]
        payload = bytearray(data[3:67])
        if repaired & 2 == 0:
            payload = payload.ljust(kind.message.length, b"\0")[: kind.message.length]
        if repaired & 1 and len(payload) == kind.message.length:
            payload = kind.repaired(payload)
        number, extended = kind.identifier
        message = can.Message(
            0.0, number ^ (bits >> 4), extended != bool(bits & 1), is_remote_frame=bool(bits & 2),
            is_error_frame=bool(bits & 4), is_fd=kind.fd != bool(bits & 8),
            data=None if bits & 2 else payload, dlc=len(payload),
        )  # fmt: skip
        compare_with_reference(kind, message)

    def seeds(self) -> list[bytes]:
        """Return inputs to begin with: valid frames of every message."""
        rng = reproducible("codec")
        return [
            bytes((index, repaired, 0)) + kind.random_data(rng)
            for index, kind in enumerate(self.kinds)
            for repaired in (0, 1)
            for _ in range(4)
        ]


class SocketTarget:
    """Sends lines of a control socket; the input is a byte, how many ticks pass between two lines, then the lines.

    One service runs on; before each input its axis is brought to hold again, so that an input gives the same alone.
    """

    def __init__(self) -> None:
        quiet_log()
        self._bench = Bench(all_drives()[0], reproducible("socket"), self._wait)
        self._socket_rig = ControlSocketRig(self._bench, Path(tempfile.gettempdir()) / "never listened on")
        self._loop = BenchLoop()
        self._go: asyncio.Event = asyncio.Event()
        self._ticks_to_go = 0
        self._waiting: asyncio.Event = asyncio.Event()
        self._service = self._loop.create_task(self._bench.service.run())

    async def _wait(self) -> None:
        if self._ticks_to_go <= 0:
            self._waiting.set()
            await self._go.wait()
            self._go.clear()
        self._ticks_to_go -= 1
        self._bench.answer_as_drive()

    async def _tick(self, ticks: int) -> None:
        if ticks <= 0:
            return
        self._ticks_to_go = ticks
        self._waiting.clear()
        self._go.set()
        waiting = asyncio.ensure_future(self._waiting.wait())
        await asyncio.wait({waiting, self._service}, return_when=asyncio.FIRST_COMPLETED)
        if self._service.done():
            waiting.cancel()
            self._service.result()

    def __call__(self, data: bytes) -> None:
        """Ask what the lines say; raises what goes wrong."""
        self._loop.run_until_complete(self._ask(data))

    async def _ask(self, data: bytes) -> None:
        bench = self._bench
        if not self._waiting.is_set():
            await self._waiting.wait()
        for _ in range(_MOST_TICKS_TO_REST):
            state = bench.axis_loop.axis.state
            if state is State.HOLDING:
                break
            if state in {State.TRIPPED, State.DISARMED}:
                bench.place_within_limits()
                bench.ask(op="reset" if state is State.TRIPPED else "arm")
            await self._tick(1)
        pause = data[0] % 8 if data else 0
        for line in data[1:].split(b"\n")[:_MOST_LINES]:
            self._socket_rig.ask(Line(line, refused=False))
            await self._tick(pause)
        bench.harness.requests.disconnect(bench.harness.requests.authority.holder or "")

    def close(self) -> None:
        """End the service."""
        self._service.cancel()
        self._loop.run_until_complete(asyncio.gather(self._service, return_exceptions=True))
        self._bench.bus.shutdown()
        self._socket_rig.close()
        self._loop.close()

    def seeds(self) -> list[bytes]:
        """Return inputs to begin with: each request alone, and some in a row."""
        lines = list(corpus())
        rng = reproducible("lines")
        return [b"\1" + line for line in lines] + [b"\3" + b"\n".join(rng.sample(lines, 4)) for _ in range(40)]
