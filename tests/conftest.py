"""Property tests judge results, never speed: the machine may be busy with anything.

In CI they try the same examples every time, so that a change is judged by what it changes; elsewhere always others.
"""

import gc
import os
import zlib

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


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare what CI divides the tests by."""
    parser.addoption("--part", metavar="K/N", help="run one of N parts of the tests, for K from 0 to N - 1")


def part_of(test: str, parts: int) -> int:
    """Return the part that a test is in, whatever its parameters: each has about as many tests."""
    return zlib.crc32(test.partition("[")[0].encode()) % parts


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist looks at the groups
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let the tests that start processes run one after another where the tests run on several cores.

    And on one of them alone those that look at one and the same run of the paper's examples.
    """
    if part := config.getoption("--part"):
        number, parts = map(int, part.split("/"))
        config.hook.pytest_deselected(items=[item for item in items if part_of(item.nodeid, parts) != number])
        items[:] = [item for item in items if part_of(item.nodeid, parts) == number]
    for item in items:
        if item.get_closest_marker("processes") is not None:
            item.add_marker(pytest.mark.xdist_group("processes"))
        elif item.path.name == "test_paper.py":
            item.add_marker(pytest.mark.xdist_group("paper"))
