"""The real service in real time, under hostile clients, signals and hubs: what it holds at the end, and at first.

``python -m tools.soak.hostile --hours 1`` runs service and drive as processes on the loopback address. Clients that do
not read, do not end, flood, abort and crowd are stopped and killed; the socket is deleted; the hub vanishes, comes
back, and greets slowly or never. After a warm-up, and at the end, all is left alone until it is quiet, and the service
says what it holds: descriptors, tasks, threads, memory. Progress goes to stderr, the verdict to stdout; with ``--json``
as one JSON object. The same seed makes the same choices, at other moments. Ctrl-C ends the run with what has been done.
"""

import argparse
import asyncio
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from random import Random
from typing import Any, Final

from tools.soak.hub_gate import HubGate, Mode
from twostage_servo.api.requests import ReloadRequest, Request, StopRequest
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.client.async_connection import AsyncConnection
from twostage_servo.client.errors import Refused, ServoError
from twostage_servo.config.loader import load
from twostage_servo.faults.bench import bench_overrides

MOST_GROWTH_MB: Final = 1.0
HELD: Final = ("descriptors", "tasks", "threads", "resident_mb")

_ROOT: Final = Path(__file__).parents[2]
_LONGEST_ANSWER_S: Final = 10.0
_LONGEST_START_S: Final = 60.0
_LOOK_S: Final = 0.5
_QUIET_LOOKS: Final = 8
_LONGEST_UNREST_S: Final = 120.0
_BUSY: Final = 0.1
"""Share of a processor, more than before any client came, that shows a service which still works for clients."""
_WARM_UP_SHARE: Final = 0.4
_LONGEST_WARM_UP_S: Final = 300.0
_HARMLESS: Final = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU, signal.SIGCONT, signal.SIGWINCH, signal.SIGPIPE)
_DEFECTS: Final = ("the loop failed", "could not be served", "exception", "Traceback", "never retrieved")
"""What no log of a service may have, whoever its clients are."""


class BrokenError(Exception):
    """What the service does not do any more."""


class Hostility:
    """One run.

    Parameters
    ----------
    folder
        For all files.
    seed
        Of all choices.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.broken: list[str] = []
        self.events: Counter[str] = Counter()
        self.stops_ms: list[float] = []
        self.held: list[dict[str, Any]] = []
        self._folder = folder
        self._random = Random(seed)  # noqa: S311 - a soak, no secret
        self._socket = folder / "runtime" / "control.sock"
        self._report = folder / "report.json"
        self._gate: HubGate
        self._service: subprocess.Popen[bytes]
        self._clients: subprocess.Popen[bytes] | None = None
        self._crews = 0
        self._idle_share = 1.0
        self._stack = contextlib.ExitStack()

    async def run(self, seconds: float) -> None:
        """Run for so many s, warm-up included."""
        begun_s = time.monotonic()
        warm_up_s = min(_LONGEST_WARM_UP_S, _WARM_UP_SHARE * seconds)
        with self._stack:
            await self._start()
            try:
                await self._measure("before any client")
                await self._be_hostile(begun_s + warm_up_s)
                await self._measure("after the warm-up")
                await self._be_hostile(begun_s + seconds)
            finally:
                await self._measure("at the end")
                await self._end()

    # The parties -----------------------------------------------------------------------------------------------------

    async def _start(self) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            hub_port = probe.getsockname()[1]
        self._gate = HubGate(hub_port)
        await self._gate.set_mode(Mode.OPEN)
        config = load(None).config
        own = [f"service.socket={json.dumps(str(self._socket))}", "axis.limits.stale_feedback_ms=300.0"]
        self._drive = self._child("drive", ["-m", "twostage_servo.faults.child"], "drive", config, hub_port, [])
        await self._until(lambda: "on the bus" in self._log("drive"), "the drive to be on the bus")
        measured = ["-m", "tools.soak.measured_service"]
        self._service = self._child("service", measured, "run", config, self._gate.port, own)
        await self._until(self._socket.exists, "the control socket")
        await self._ask(ReloadRequest())  # whose thread stays

    def _child(
        self, name: str, program: list[str], verb: str, config: Any, port: int, own: list[str]
    ) -> subprocess.Popen[bytes]:
        overrides = [*bench_overrides(config, port, self._folder), *own]
        demo = str(_ROOT / "config" / "demo.toml")
        if verb == "drive":
            return self._spawn(name, [*program, str(os.getpid()), verb, demo, *overrides])
        options = [argument for override in overrides for argument in ("--set", override)]
        command = [*program, str(os.getpid()), str(self._report), verb, "--config", demo, *options, "--json"]
        return self._spawn(name, command)

    def _spawn(self, name: str, command: list[str]) -> subprocess.Popen[bytes]:
        with (self._folder / f"{name}.log").open("ab") as log, (self._folder / f"{name}.out").open("wb") as out:
            process = subprocess.Popen(  # noqa: S603 - our own programs
                [sys.executable, "-P", *command],
                stdin=subprocess.DEVNULL, stdout=out, stderr=log, start_new_session=True,
                env=os.environ | {"PYTHONPATH": str(_ROOT), "OPENBLAS_NUM_THREADS": "1"},
            )  # fmt: skip
        self._stack.callback(_kill, process)
        return process

    def _new_clients(self) -> None:
        self._crews += 1
        seed, counts = self._random.randrange(1 << 30), self._folder / f"counts-{self._crews}.json"
        command = ["-m", "tools.soak.hostile_clients", str(os.getpid()), str(self._socket), str(seed), str(counts)]
        self._clients = self._spawn("clients", command)

    def _end_clients(self) -> None:
        if self._clients is not None:
            _kill(self._clients)
            self._clients = None

    def counts(self) -> dict[str, int]:
        """Return how often the clients have done what, as far as they could tell."""
        total: Counter[str] = Counter()
        for path in self._folder.glob("counts-*.json"):
            total.update(json.loads(path.read_text(encoding="utf-8")))
        return dict(sorted(total.items()))

    def log_levels(self) -> dict[str, int]:
        """Return how many lines of each level the service has logged."""
        lines = self._log("service").splitlines()
        return dict(Counter(json.loads(line)["level"] for line in lines if line.startswith("{")))

    # What happens ----------------------------------------------------------------------------------------------------

    async def _be_hostile(self, end_s: float) -> None:
        random = self._random
        self._new_clients()
        happenings = (
            self._delete_socket, self._delete_folder, self._shut_gate, self._slow_hub, self._silent_hub,
            self._stop_clients, self._kill_clients, self._send_a_signal, self._ask_to_stop, self._ask_to_stop,
        )  # fmt: skip
        while (left_s := end_s - time.monotonic()) > 0.0:
            show(f"{left_s:6.0f} s left, {sum(self.events.values())} events, {len(self.stops_ms)} stops")
            await asyncio.sleep(min(left_s, random.expovariate(1.0)))
            happening = random.choice(happenings)
            self.events[happening.__name__.removeprefix("_")] += 1
            await happening()
            if self._service.poll() is not None:
                raise BrokenError(f"the service has ended with {self._service.returncode}")
            if self._clients is not None and self._clients.poll() is not None:
                self._new_clients()
        self._end_clients()
        await self._gate.set_mode(Mode.OPEN)

    async def _delete_socket(self) -> None:
        self._socket.unlink(missing_ok=True)

    async def _delete_folder(self) -> None:
        shutil.rmtree(self._socket.parent, ignore_errors=True)

    async def _shut_gate(self) -> None:
        await self._for_a_while(Mode.SHUT)

    async def _slow_hub(self) -> None:
        self._gate.slow_pause_s = self._random.choice((0.05, 0.3, 0.8))
        await self._for_a_while(Mode.SLOW)

    async def _silent_hub(self) -> None:
        await self._for_a_while(Mode.SILENT)

    async def _for_a_while(self, mode: Mode) -> None:
        await self._gate.set_mode(mode)
        await asyncio.sleep(self._random.choice((0.1, 1.0, 3.0)))
        await self._gate.set_mode(Mode.OPEN)

    async def _stop_clients(self) -> None:
        if self._clients is not None:
            self._clients.send_signal(signal.SIGSTOP)
            await asyncio.sleep(self._random.uniform(0.1, 2.0))
            self._clients.send_signal(signal.SIGCONT)

    async def _kill_clients(self) -> None:
        self._end_clients()
        self._new_clients()

    async def _send_a_signal(self) -> None:
        self._service.send_signal(self._random.choice(_HARMLESS))

    async def _ask_to_stop(self) -> None:
        """Ask as a fresh client, and for so long as the socket is away wait for it to be made again."""
        begun_s = time.monotonic()
        while True:
            asked_s = time.monotonic()
            try:
                await asyncio.wait_for(self._ask(StopRequest()), _LONGEST_ANSWER_S)
            except Refused as refused:
                if refused.code not in {RefusalCode.DISARMED, RefusalCode.TRIPPED}:
                    raise BrokenError(f"`stop` was refused: {refused}") from refused
            except (ServoError, TimeoutError) as error:
                if time.monotonic() - begun_s > _LONGEST_ANSWER_S:
                    raise BrokenError(f"`stop` gets no answer for {_LONGEST_ANSWER_S:g} s: {error!r}") from error
                await asyncio.sleep(0.01)
                continue
            self.stops_ms.append(1e3 * (time.monotonic() - asked_s))
            return

    async def _ask(self, request: Request) -> None:
        connection = AsyncConnection(self._socket, _LONGEST_ANSWER_S)
        try:
            await connection.open(_LONGEST_ANSWER_S)
            await connection.ask(request)
        finally:
            connection.close()

    # What it holds ---------------------------------------------------------------------------------------------------

    async def _measure(self, when: str) -> None:
        """Leave the service alone until it has nothing to do and holds no less any more; keep what it holds then."""
        if self._service.poll() is not None:
            return
        self._end_clients()
        least = before = await self._holds()
        calm, end_s = 0, time.monotonic() + _LONGEST_UNREST_S
        while calm < _QUIET_LOOKS and time.monotonic() < end_s:
            show(f"{when}: waiting until it is quiet")
            begun_s = time.monotonic()
            await asyncio.sleep(_LOOK_S)
            now = await self._holds()
            share = (now["processor_s"] - before["processor_s"]) / (time.monotonic() - begun_s)
            self._idle_share = min(self._idle_share, share)
            is_less = any(now[name] < least[name] for name in HELD[:3])
            calm = 0 if is_less or share > self._idle_share + _BUSY else calm + 1
            least, before = now if is_less else least | {"resident_mb": now["resident_mb"]}, now
        self.held.append({"when": when, **{name: least[name] for name in (*HELD, "tasks_by_name")}})
        show(f"\n{self.held[-1]}")

    async def _holds(self) -> dict[str, Any]:
        before = self._reported().get("number", 0)
        self._service.send_signal(signal.SIGUSR2)
        await self._until(lambda: self._reported().get("number", 0) > before, "the service's report")
        return self._reported()

    def _reported(self) -> dict[str, Any]:
        try:
            report: dict[str, Any] = json.loads(self._report.read_text(encoding="ascii"))
        except FileNotFoundError:
            return {}
        return report

    async def _end(self) -> None:
        if self._service.poll() is None:
            self._service.terminate()
            await self._until(lambda: self._service.poll() is not None, "the service to end on SIGTERM")
        if self._service.returncode != 0:
            self.broken.append(f"the service has ended with {self._service.returncode}")
        log = self._log("service")
        self.broken += [f"the log has {text!r}: {_line_with(log, text)}" for text in _DEFECTS if text in log]
        await self._gate.set_mode(Mode.SHUT)

    def _log(self, name: str) -> str:
        path = self._folder / f"{name}.log"
        return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""

    async def _until(self, condition: Any, what: str) -> None:
        end_s = time.monotonic() + _LONGEST_START_S
        while not condition():
            if time.monotonic() > end_s:
                raise BrokenError(f"waited {_LONGEST_START_S:g} s in vain for {what}")
            await asyncio.sleep(0.05)


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait()


def _line_with(log: str, text: str) -> str:
    return next(line for line in log.splitlines() if text in line)[:500]


def show(text: str) -> None:
    """Tell how far it is: on one line of a terminal, and a line for each measurement elsewhere."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)
    elif text.startswith("\n"):
        print(text[1:], file=sys.stderr, flush=True)


def summarise(run: Hostility, seed: int, seconds: float) -> dict[str, Any]:
    """Return what a run came to."""
    grown: dict[str, float] = {}
    broken = list(run.broken)
    if len(run.held) < 3:
        broken.append("it did not come to a comparison")
    else:
        first, last = run.held[1], run.held[-1]
        grown = {name: round(last[name] - first[name], 3) for name in HELD}
        allowed = {"resident_mb": MOST_GROWTH_MB}
        broken += [
            f"{grown[name]:g} more {name} than after the warm-up" for name in HELD if grown[name] > allowed.get(name, 0)
        ]
    return {
        "kind": "hostile",
        "seed": seed,
        "seconds": round(seconds, 1),
        "held": run.held,
        "grown": grown,
        "events": dict(sorted(run.events.items())),
        "clients": run.counts(),
        "stops": len(run.stops_ms),
        "slowest_stop_ms": round(max(run.stops_ms, default=0.0), 1),
        "log_lines": run.log_levels(),
        "broken": broken,
    }


def as_text(summary: dict[str, Any]) -> str:
    """Return the summary for people."""
    lines = [
        (
            f"{summary['seconds']:.0f} s, seed {summary['seed']}: {sum(summary['events'].values())} events, "
            f"{sum(summary['clients'].values())} doings of clients, {summary['stops']} stops, the slowest after "
            f"{summary['slowest_stop_ms']:g} ms"
        ),
        *(f"{one['when']}: " + ", ".join(f"{name} {one[name]:g}" for name in HELD) for one in summary["held"]),
        *(f"BROKEN {one}" for one in summary["broken"]),
    ]
    return "\n".join(lines if summary["broken"] else [*lines, "it holds no more than after the warm-up"])


def main() -> int:
    """Run what the arguments describe; return 0 if nothing broke."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--hours", type=float, help="how long, in all")
    length.add_argument("--minutes", type=float, help="how long, in all (default 5)")
    parser.add_argument("--seed", type=int, default=1, metavar="N")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="leave logs and trip files there")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    seconds = 3600.0 * options.hours if options.hours else 60.0 * (options.minutes or 5.0)
    begun_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="twostage-servo-") as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        run = Hostility(folder, options.seed)
        try:
            asyncio.run(run.run(seconds))
        except BrokenError as error:
            run.broken.append(str(error))
        except KeyboardInterrupt:
            print("\ninterrupted", file=sys.stderr)
        summary = summarise(run, options.seed, time.monotonic() - begun_s)
    print(json.dumps(summary) if options.json else as_text(summary))
    return 1 if summary["broken"] else 0


if __name__ == "__main__":
    sys.exit(main())
