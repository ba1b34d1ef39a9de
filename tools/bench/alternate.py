"""Whether another tree is as fast: the same parts of the benchmark in two trees, in turns.

``python -m tools.bench.alternate BEFORE AFTER --rounds 30``: each is a checkout with its own ``.venv``. A round runs
both, every other one in the opposite order, and gives a ratio for each figure. The result is the median of the ratios
with its 95 % interval, by the bootstrap (B. Efron, *Bootstrap methods: another look at the jackknife*, Annals of
Statistics 7, 1979). A machine whose speed drifts does not matter, as long as it does so more slowly than a round.
"""

import argparse
import json
import random
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

_PARTS: Final = ("step", "tick", "processes")
_FIGURES: Final = {
    "control step, µs": ("control_step_us", "ours", "p50"),
    "whole tick, 1 axis, µs": ("whole_tick_us", "1", "p50"),
    "whole tick, 64 axes, µs": ("whole_tick_us", "64", "p50"),
    "start to ready, s": ("startup_s", "p50"),
    "status, s": ("status_s", "p50"),
}
"""What is compared, and where the benchmark's result has it."""

_RESAMPLES: Final = 10_000
_SEED: Final = 1


def compile_modules(tree: Path) -> None:
    """Compile the modules of a tree: without its bytecode a start takes 20 ms longer, where none may be written."""
    command = [str(tree / ".venv" / "bin" / "python"), "-m", "compileall", "-q", "twostage_servo", "tools"]
    subprocess.run(command, cwd=tree, check=True)  # noqa: S603 - a tree that the user names


def measure(tree: Path) -> dict[str, float]:
    """Run the benchmark of a tree, and return the figures.

    Raises
    ------
    subprocess.CalledProcessError
        If it fails.
    """
    module = (tree / "tools" / "__init__.py").exists()
    program = ["-m", "tools.bench.run"] if module else ["tools/bench/run.py"]
    command = [str(tree / ".venv" / "bin" / "python"), *program, "--quick", "--json", "--only", *_PARTS]
    printed = subprocess.run(command, cwd=tree, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL).stdout  # noqa: S603 - a tree that the user names
    result: Any = json.loads(printed)
    figures = {}
    for name, path in _FIGURES.items():
        value = result
        for key in path:
            value = value[key]
        figures[name] = float(value)
    return figures


def compare(before: list[float], after: list[float]) -> dict[str, float]:
    """Return the medians, and the median of the ratios of the same rounds with its 95 % interval."""
    ratios = [second / first for first, second in zip(before, after, strict=True)]
    rng = random.Random(_SEED)  # noqa: S311 - no secret
    medians = sorted(statistics.median(rng.choices(ratios, k=len(ratios))) for _ in range(_RESAMPLES))
    return {
        "before": statistics.median(before),
        "after": statistics.median(after),
        "ratio": statistics.median(ratios),
        "from": medians[int(0.025 * _RESAMPLES)],
        "to": medians[int(0.975 * _RESAMPLES)],
    }


def main() -> int:
    """Run the rounds that the arguments describe; a round that a Ctrl-C interrupts does not count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, metavar="BEFORE")
    parser.add_argument("after", type=Path, metavar="AFTER")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    trees = (options.before.absolute(), options.after.absolute())
    for tree in trees:
        compile_modules(tree)
    rounds: list[tuple[dict[str, float], dict[str, float]]] = []
    try:
        for number in range(options.rounds):
            order = trees if number % 2 == 0 else trees[::-1]
            measured = {tree: measure(tree) for tree in order}
            rounds.append((measured[trees[0]], measured[trees[1]]))
            print(f"{number + 1} of {options.rounds} rounds", file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
    if not rounds:
        return 130
    result = {
        name: compare([first[name] for first, _ in rounds], [second[name] for _, second in rounds]) for name in _FIGURES
    }
    if options.json:
        print(json.dumps({"rounds": len(rounds), "figures": result}))
    else:
        print(f"{len(rounds)} rounds\n{'':26}{'before':>10}{'after':>10}{'ratio':>8}   95 % interval")
        for name, one in result.items():
            print(
                f"{name:26}{one['before']:10.4g}{one['after']:10.4g}{one['ratio']:8.3f}   "
                f"{one['from']:.3f} to {one['to']:.3f}"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
