"""Property tests judge results, never speed: the machine may be busy with anything.

In CI they try the same examples every time, so that a change is judged by what it changes; elsewhere always others.
"""

import gc
import os

# Before anything imports numpy: threads for matrices of order 3 only wait for each other, and on a busy machine that
# takes twenty times as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "twostage-servo",
    deadline=None,
    derandomize="CI" in os.environ,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("twostage-servo")


def pytest_collection_finish() -> None:
    """Keep the thousands of tests themselves out of every search for garbage."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist looks at the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let the tests that start processes run one after another where the tests run on several cores.

    And on one of them alone those that look at one and the same run of the paper's examples.
    """
    for item in items:
        if item.get_closest_marker("processes") is not None:
            item.add_marker(pytest.mark.xdist_group("processes"))
        elif item.path.name == "test_paper.py":
            item.add_marker(pytest.mark.xdist_group("paper"))
