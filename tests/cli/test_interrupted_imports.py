"""Ctrl-C while the program is still being imported ends it as at any other time."""

import signal
import subprocess
import sys

import pytest

INTERRUPTED = """
import os, signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
        return None
sys.meta_path.insert(0, Finder())
from twostage_servo.__main__ import entry_point
sys.argv = ["twostage-servo", *{arguments!r}]
entry_point()
"""


def run(code: str) -> tuple[int, str, str]:
    """Run a program as an operator's shell does, which does not ignore SIGINT; whoever runs the tests may (nohup)."""
    done = subprocess.run(  # noqa: S603 - our own interpreter and text
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        ("argparse", ["check"]),
        ("twostage_servo.cli.main", ["check"]),
        ("twostage_servo.cli.check", ["--version"]),
        ("pydantic", ["check"]),
        ("numpy", ["design"]),
        ("twostage_servo.client.blocking", ["stop"]),
    ],
)
def test_an_interrupt_in_an_import_is_130_without_a_traceback(module: str, arguments: list[str]) -> None:
    assert run(INTERRUPTED.format(module=module, arguments=arguments)) == (130, "", "")


def test_it_is_so_where_the_tests_are_run_by_what_ignores_an_interrupt() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert run(INTERRUPTED.format(module="argparse", arguments=["check"])) == (130, "", "")
    finally:
        signal.signal(signal.SIGINT, before)


def test_the_package_is_run_as_a_module() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "twostage_servo", "--version"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout[:15]) == (0, "twostage-servo ")
