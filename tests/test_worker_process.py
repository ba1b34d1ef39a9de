"""Workers of a pool end with the process that began them, which a pool by itself does not see to."""

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.processes

_LONGEST_S = 60.0
POOL = """
import concurrent.futures, multiprocessing, os, time
from twostage_servo.worker_process import end_with_parent
def work(_):
    return os.getpid()
if __name__ == "__main__":
    context = multiprocessing.get_context("{method}")
    with concurrent.futures.ProcessPoolExecutor(1, context, initializer=end_with_parent) as pool:
        print(pool.submit(work, 0).result(), flush=True)
        time.sleep(600.0)
"""


@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_a_worker_ends_when_its_parent_is_killed(method: str, tmp_path: Path) -> None:
    program = tmp_path / "pool.py"
    program.write_text(POOL.format(method=method))
    command = [sys.executable, str(program)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:  # noqa: S603 - our own text
        assert parent.stdout is not None
        worker = os.pidfd_open(int(parent.stdout.readline()))
        try:
            parent.send_signal(signal.SIGKILL)
            ended, _, _ = select.select([worker], [], [], _LONGEST_S)
            assert ended, f"the worker goes on {_LONGEST_S:g} s after its parent"
        finally:
            os.close(worker)
