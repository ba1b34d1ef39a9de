"""The real service in real time, under hostile clients, signals and hubs: what it holds at the end, and at first.

``python -m tools.soak.hostile --hours 1`` runs service and drive as processes on the loopback address. Clients that do
not read, do not end, flood, abort and crowd are stopped and killed; the socket is deleted; the hub vanishes, comes
back, and greets slowly or never. After a warm-up, and at the end, all is left alone until it is quiet, and the service
says what it holds: descriptors, tasks, threads, memory. Progress goes to stderr, the verdict to stdout; with ``--json``
as one JSON object. The same seed makes the same choices, at other moments. Ctrl-C ends the run with what has been done.
"""

import argparse
import asyncio
import json
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from random import Random
from typing import Any, Final

from tools.soak.hostile_processes import LONGEST_ANSWER_S, BrokenError, HostileProcesses, until
from tools.soak.hub_gate import Mode
from twostage_servo.api.requests import StopRequest
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.client.errors import Refused, ServoError

MOST_GROWTH_MB: Final = 1.0
HELD: Final = ("descriptors", "tasks", "threads", "resident_mb")

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
        self.processes = HostileProcesses(folder)
        self._random = Random(seed)  # noqa: S311 - a soak, no secret
        self._idle_share = 1.0

    async def run(self, seconds: float) -> None:
        """Run for so many s, warm-up included."""
        begun_s = time.monotonic()
        warm_up_s = min(_LONGEST_WARM_UP_S, _WARM_UP_SHARE * seconds)
        with self.processes:
            await self.processes.start()
            try:
                await self._measure("before any client")
                await self._be_hostile(begun_s + warm_up_s)
                await self._measure("after the warm-up")
                await self._be_hostile(begun_s + seconds)
            finally:
                await self._measure("at the end")
                await self._end()

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
            if self.processes.service.poll() is not None:
                raise BrokenError(f"the service has ended with {self.processes.service.returncode}")
            if self.processes.clients is not None and self.processes.clients.poll() is not None:
                self._new_clients()
        self.processes.end_clients()
        await self.processes.gate.set_mode(Mode.OPEN)

    def _new_clients(self) -> None:
        self.processes.new_clients(self._random.randrange(1 << 30))

    async def _delete_socket(self) -> None:
        self.processes.socket.unlink(missing_ok=True)

    async def _delete_folder(self) -> None:
        shutil.rmtree(self.processes.socket.parent, ignore_errors=True)

    async def _shut_gate(self) -> None:
        await self._for_a_while(Mode.SHUT)

    async def _slow_hub(self) -> None:
        self.processes.gate.slow_pause_s = self._random.choice((0.05, 0.3, 0.8))
        await self._for_a_while(Mode.SLOW)

    async def _silent_hub(self) -> None:
        await self._for_a_while(Mode.SILENT)

    async def _for_a_while(self, mode: Mode) -> None:
        await self.processes.gate.set_mode(mode)
        await asyncio.sleep(self._random.choice((0.1, 1.0, 3.0)))
        await self.processes.gate.set_mode(Mode.OPEN)

    async def _stop_clients(self) -> None:
        if self.processes.clients is not None:
            self.processes.clients.send_signal(signal.SIGSTOP)
            await asyncio.sleep(self._random.uniform(0.1, 2.0))
            self.processes.clients.send_signal(signal.SIGCONT)

    async def _kill_clients(self) -> None:
        self.processes.end_clients()
        self._new_clients()

    async def _send_a_signal(self) -> None:
        self.processes.service.send_signal(self._random.choice(_HARMLESS))

    async def _ask_to_stop(self) -> None:
        """Ask as a fresh client, and for so long as the socket is away wait for it to be made again."""
        begun_s = time.monotonic()
        while True:
            asked_s = time.monotonic()
            try:
                await asyncio.wait_for(self.processes.ask(StopRequest()), LONGEST_ANSWER_S)
            except Refused as refused:
                if refused.code not in {RefusalCode.DISARMED, RefusalCode.TRIPPED}:
                    raise BrokenError(f"`stop` was refused: {refused}") from refused
            except (ServoError, TimeoutError) as error:
                if time.monotonic() - begun_s > LONGEST_ANSWER_S:
                    raise BrokenError(f"`stop` gets no answer for {LONGEST_ANSWER_S:g} s: {error!r}") from error
                await asyncio.sleep(0.01)
                continue
            self.stops_ms.append(1e3 * (time.monotonic() - asked_s))
            return

    # What it holds ---------------------------------------------------------------------------------------------------

    async def _measure(self, when: str) -> None:
        """Leave the service alone until it has nothing to do and holds no less any more; keep what it holds then."""
        if self.processes.service.poll() is not None:
            return
        self.processes.end_clients()
        least = before = await self.processes.holds()
        calm, end_s = 0, time.monotonic() + _LONGEST_UNREST_S
        while calm < _QUIET_LOOKS and time.monotonic() < end_s:
            show(f"{when}: waiting until it is quiet")
            begun_s = time.monotonic()
            await asyncio.sleep(_LOOK_S)
            now = await self.processes.holds()
            share = (now["processor_s"] - before["processor_s"]) / (time.monotonic() - begun_s)
            self._idle_share = min(self._idle_share, share)
            is_less = any(now[name] < least[name] for name in HELD[:3])
            calm = 0 if is_less or share > self._idle_share + _BUSY else calm + 1
            least, before = now if is_less else least | {"resident_mb": now["resident_mb"]}, now
        self.held.append({"when": when, **{name: least[name] for name in (*HELD, "tasks_by_name")}})
        show(f"\n{self.held[-1]}")

    async def _end(self) -> None:
        service = self.processes.service
        if service.poll() is None:
            service.terminate()
            await until(lambda: service.poll() is not None, "the service to end on SIGTERM")
        if service.returncode != 0:
            self.broken.append(f"the service has ended with {service.returncode}")
        log = self.processes.log("service")
        self.broken += [f"the log has {text!r}: {_line_with(log, text)}" for text in _DEFECTS if text in log]
        await self.processes.gate.set_mode(Mode.SHUT)


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
        "clients": run.processes.counts(),
        "stops": len(run.stops_ms),
        "slowest_stop_ms": round(max(run.stops_ms, default=0.0), 1),
        "log_lines": run.processes.log_levels(),
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
