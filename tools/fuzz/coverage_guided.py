"""Runs a target under atheris, Google's coverage-guided fuzzer for Python, which has to be installed for it."""

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any


def fuzz(target: str, description: str) -> None:
    """Run one of the targets for a while; ends the process.

    Parameters
    ----------
    target
        Its name in :mod:`tools.fuzz.targets`.
    description
        For `--help`.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--seconds", type=int, default=60, help="how long")
    parser.add_argument("--seed", type=int, default=1, help="of the fuzzer's random numbers")
    parser.add_argument("--corpus", type=Path, help="folder to keep the corpus in")
    options = parser.parse_args()
    try:
        atheris: Any = importlib.import_module("atheris")
    except ImportError as error:
        parser.error(f"{error}; install it beside the package: pip install atheris")
    with atheris.instrument_imports(include=["twostage_servo"]):
        one_input = getattr(importlib.import_module("tools.fuzz.targets"), target)()
    here = Path(__file__).parent
    folder = options.corpus or here / "corpus" / target
    failures = here / "failures"
    folder.mkdir(parents=True, exist_ok=True)
    failures.mkdir(exist_ok=True)
    for number, seed in enumerate(one_input.seeds()):
        (folder / f"seed-{number:04}").write_bytes(seed)
    arguments = [
        sys.argv[0], f"-max_total_time={options.seconds}", f"-seed={options.seed}", "-max_len=2048", "-timeout=20",
        "-rss_limit_mb=2048", f"-artifact_prefix={failures}/{target}-", "-print_final_stats=1", str(folder),
    ]  # fmt: skip
    atheris.Setup(arguments, one_input, enable_python_coverage=True)
    atheris.Fuzz()
