"""Fuzz the frames, the control socket's lines, or the configurations.

`python -m tools.fuzz.run frames --count 10000000 --jobs 2`; likewise `lines` and `tomls`. Every case follows from the
seed, which is printed: with `--episode` one episode runs again, alone. Exit code 1 when anything was found.
"""

import argparse
import contextlib
import json
import math
import os
import secrets
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from types import FrameType

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for matrices of order 3, more threads only wait for each other

from tools.fuzz import frames, lines, tomls
from tools.fuzz.outcome import Outcome
from tools.fuzz.quiet_log import quiet_log
from twostage_servo.worker_process import end_with_parent

_MODES = {"frames": frames, "lines": lines, "tomls": tomls}
_COUNTS = {"frames": 10_000_000, "lines": 1_000_000, "tomls": 10_000}
_LONGEST_EPISODE_S = 300
_PROGRESS_S = 2.0


def run_one(mode: str, seed: int, episode: int) -> tuple[int, Outcome]:
    """Run one episode; whatever goes wrong in it is a finding."""
    module = _MODES[mode]
    signal.signal(signal.SIGALRM, _hangs)
    signal.alarm(_LONGEST_EPISODE_S)
    try:
        return episode, module.run_episode(seed, episode, module.PER_EPISODE)
    except Exception as error:  # noqa: BLE001 - what is being looked for
        last = f"{type(error).__name__}: {error}"
        return episode, Outcome(module.PER_EPISODE, findings=[f"{last}\n{''.join(traceback.format_exception(error))}"])
    finally:
        signal.alarm(0)


def _hangs(_: int, __: FrameType | None) -> None:
    raise TimeoutError(f"an episode takes more than {_LONGEST_EPISODE_S} s")


def _outcomes(mode: str, seed: int, episodes: Iterable[int], jobs: int) -> Iterator[tuple[int, Outcome]]:
    work = partial(run_one, mode, seed)
    if jobs == 1:
        quiet_log()
        yield from map(work, episodes)
        return
    with ProcessPoolExecutor(jobs, initializer=_begin) as pool:
        yield from pool.map(work, episodes, chunksize=4)


def _begin() -> None:
    end_with_parent()
    quiet_log()


class _Progress:
    def __init__(self, mode: str, count: int) -> None:
        self._mode, self._count, self._begun, self._said = mode, count, time.monotonic(), 0.0

    @property
    def elapsed_s(self) -> float:
        return max(time.monotonic() - self._begun, 1e-9)

    def say(self, done: int, findings: int) -> None:
        now = time.monotonic()
        if now - self._said < (_PROGRESS_S if sys.stderr.isatty() else 5.0 * _PROGRESS_S):
            return
        self._said = now
        end = "\r" if sys.stderr.isatty() else "\n"
        rate = done / self.elapsed_s
        line = f"{self._mode}: {done:,} of {self._count:,}, {rate:,.0f}/s, {findings} findings "
        print(line, end=end, file=sys.stderr, flush=True)


def _keep(folder: Path, mode: str, seed: int, episode: int, findings: list[str]) -> str:
    """Save findings; return how to see them again."""
    command = f"python -m tools.fuzz.run {mode} --seed {seed} --episode {episode}"
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        text = "\n\n".join([f"{command}\n", *findings])
        (folder / f"{mode}-{seed}-{episode}.txt").write_text(text, encoding="utf-8", errors="backslashreplace")
    return command


def main() -> int:
    """Fuzz, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=_MODES)
    parser.add_argument("--count", type=int, help="cases; by default those of a release: 10 million, 1 million, 10,000")
    parser.add_argument("--seed", type=int, help="decides on everything; by default a new one")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--episode", type=int, help="run this one alone")
    parser.add_argument("--failures", type=Path, default=Path(__file__).parent / "failures", help="folder for findings")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    mode = options.mode
    seed = secrets.randbelow(1_000_000) if options.seed is None else options.seed
    per_episode = _MODES[mode].PER_EPISODE
    count = options.count or _COUNTS[mode]
    episodes = range(math.ceil(count / per_episode)) if options.episode is None else [options.episode]
    print(f"{mode}: seed {seed}, {len(episodes)} episodes of {per_episode:,}", file=sys.stderr, flush=True)

    counts: Counter[str] = Counter()
    failed: list[dict[str, object]] = []
    done, progress = 0, _Progress(mode, len(episodes) * per_episode)
    for episode, outcome in _outcomes(mode, seed, episodes, max(1, options.jobs)):
        done += outcome.cases
        counts.update(outcome.counts)
        if outcome.findings:
            command = _keep(options.failures, mode, seed, episode, outcome.findings)
            what = [finding.partition("\n")[0][:500] for finding in outcome.findings]
            failed.append({"episode": episode, "reproduce": command, "findings": what})
            print(f"\nFOUND {what[0]}\n  {command}", file=sys.stderr, flush=True)
        progress.say(done, len(failed))
    elapsed_s = progress.elapsed_s
    report = {
        "mode": mode, "seed": seed, "cases": done, "seconds": round(elapsed_s, 1), "rate": round(done / elapsed_s),
        "jobs": options.jobs, "episodes_with_findings": failed, "counts": dict(sorted(counts.items())),
    }  # fmt: skip
    if options.json:
        print(json.dumps(report, indent=1))
    else:
        rate = f"{done / elapsed_s:,.0f}/s"
        print(f"{done:,} {mode} in {elapsed_s:.1f} s, {rate}; {len(failed)} episodes with findings; seed {seed}")
        for name, number in sorted(counts.items()):
            print(f"  {name:34} {number:>12,}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
