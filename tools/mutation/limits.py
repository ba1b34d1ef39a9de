"""A pytest plugin for mutants: a test may take so much processor time, and a failing example is not made smaller."""

import os
import signal
from types import FrameType

from hypothesis import Phase, settings

MOST_CPU_S = 20.0
"""Of one test; the longest takes less than 3 s. Processor time, so a busy machine does not make a mutant's verdict."""

OUT_OF_TIME = 36
"""Exit code, mutmut's own for it."""


def _stop(_signal: int, _frame: FrameType | None) -> None:
    os._exit(OUT_OF_TIME)


def pytest_sessionstart() -> None:
    """Leave out the shrinking: that a test fails is enough."""
    settings.register_profile(
        "mutation", settings.get_profile("twostage-servo"), phases=(Phase.explicit, Phase.generate), derandomize=True
    )
    settings.load_profile("mutation")
    signal.signal(signal.SIGPROF, _stop)


def pytest_runtest_setup() -> None:
    """Start the test's time."""
    signal.setitimer(signal.ITIMER_PROF, MOST_CPU_S)


def pytest_runtest_teardown() -> None:
    """Stop the test's time."""
    signal.setitimer(signal.ITIMER_PROF, 0.0)
