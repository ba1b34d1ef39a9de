"""CPU hogs."""

import contextlib
import sys
from collections.abc import Iterator
from typing import Final

from tools.bench.children import child

HOGS: Final = 4


@contextlib.contextmanager
def hogs(count: int = HOGS) -> Iterator[None]:
    """Keep so many processes of ordinary priority busy while the block runs."""
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            stack.enter_context(child([sys.executable, "-S", "-c", "while True: pass"], stdout=None))
        yield


@contextlib.contextmanager
def unloaded() -> Iterator[None]:
    """Run the block without hogs."""
    yield
