"""What becomes of a command whose output is closed, full or no longer read."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = f"{sys.executable} -c 'from twostage_servo.cli.main import entry_point; entry_point()'"


def shell(line: str) -> tuple[int, str, str]:
    done = subprocess.run(  # noqa: S602
        line.replace("SERVO", COMMAND), shell=True, capture_output=True, text=True, timeout=60, check=False
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("arguments", ["design", "check --explain", "demo --fast --to 1 --json"])
def test_a_closed_stdout_changes_nothing_else(arguments: str) -> None:
    assert shell(f"SERVO {arguments} >&-") == (0, "", "")


def test_a_closed_stderr_changes_no_exit_code() -> None:
    exit_code, out, _ = shell("SERVO demo --fast --to 1 --json 2>&-")
    assert exit_code == 0
    assert json.loads(out)["trip"] is None
    assert shell("SERVO demo --to 9999 --fast 2>&-")[0] == 2


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_told_in_one_line() -> None:
    exit_code, _, error = shell("SERVO design >/dev/full")
    assert exit_code == 1
    assert error == "twostage-servo design: the result cannot be written: No space left on device\n"


def test_a_reader_that_has_enough_ends_the_command_quietly() -> None:
    reader = subprocess.Popen(
        [sys.executable, "-c", "from twostage_servo.cli.main import entry_point; entry_point()", "check", "--explain"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert reader.stdout is not None
    assert reader.stderr is not None
    assert reader.stdout.readline()
    reader.stdout.close()
    assert (reader.wait(60), reader.stderr.read()) == (0, "")
    reader.stderr.close()
