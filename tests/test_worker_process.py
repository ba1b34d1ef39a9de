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


INTERRUPTED = """
import signal, sys, time
from twostage_servo.worker_process import InterruptibleProcesses
def begin():
    pass
def work(number):
    print(number, flush=True)
    time.sleep(600.0)
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with InterruptibleProcesses(2, begin) as pool:
            for future in [pool.submit(work, number) for number in range(9)]:
                future.result()
    except KeyboardInterrupt:
        sys.exit(130)
"""


@pytest.mark.parametrize("whom", ["the group", "the parent alone"])
def test_workers_end_without_a_word_when_they_are_interrupted(whom: str, tmp_path: Path) -> None:
    program, folder = tmp_path / "pool.py", tmp_path / "temporary"
    program.write_text(INTERRUPTED)
    folder.mkdir()
    command = [sys.executable, str(program)]
    with subprocess.Popen(  # noqa: S603 - our own text
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TMPDIR": str(folder), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        start_new_session=True,
    ) as parent:
        assert parent.stdout is not None
        assert {parent.stdout.readline(), parent.stdout.readline()} == {"0\n", "1\n"}
        if whom == "the group":
            os.killpg(parent.pid, signal.SIGINT)
        else:
            parent.send_signal(signal.SIGINT)
        _, told = parent.communicate(timeout=_LONGEST_S)  # of tasks that take ten times as long
    assert (parent.returncode, told) == (130, "")
    assert list(folder.iterdir()) == []
