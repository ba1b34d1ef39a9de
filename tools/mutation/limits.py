"""A pytest plugin for mutants: a test may take so much processor time, and a failing example is not made smaller.

The unmutated run tells how much, see :mod:`reach`. It is processor time, so that a busy machine does not make a
mutant's verdict.
"""

import json
import os
import signal
from pathlib import Path
from types import FrameType

import pytest
from hypothesis import Phase, settings

SPENT = "MUTATION_SPENT"
"""Environment variable with the path of the file that keeps what each test took."""

TIMES = 10.0
"""How many times longer than unmutated a test may take."""

LEAST_CPU_S = 3.0
"""What each may take in any case: other tests may have imported before what this one has to import."""

OTHERWISE_CPU_S = 60.0
"""What a test may take of which nothing is known."""

OUT_OF_TIME = 36
"""Exit code, mutmut's own for it."""

_spent: dict[str, float] = {}


def allowed_s(spent: dict[str, float], name: str) -> float:
    """Return the processor time that a test may take, in s."""
    return max(LEAST_CPU_S, TIMES * spent[name]) if name in spent else OTHERWISE_CPU_S


def _stop(_signal: int, _frame: FrameType | None) -> None:
    os._exit(OUT_OF_TIME)


def pytest_sessionstart() -> None:
    """Leave out the shrinking: that a test fails is enough."""
    settings.register_profile(
        "mutation", settings.get_profile("twostage-servo"), phases=(Phase.explicit, Phase.generate), derandomize=True
    )
    settings.load_profile("mutation")
    signal.signal(signal.SIGPROF, _stop)
    path = Path(os.environ.get(SPENT, ""))
    if path.is_file():
        _spent.update(json.loads(path.read_text(encoding="utf-8")))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Start the test's time."""
    signal.setitimer(signal.ITIMER_PROF, allowed_s(_spent, item.nodeid))


def pytest_runtest_teardown() -> None:
    """Stop the test's time."""
    signal.setitimer(signal.ITIMER_PROF, 0.0)
