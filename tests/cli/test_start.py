"""What `run` leaves for later, so that the service is soon ready."""

import gc
import subprocess
import sys
from pathlib import Path

import pytest

from twostage_servo.app.serve import Served
from twostage_servo.cli.main import main

CONFIG = Path(__file__).parents[2] / "config" / "two_processes.toml"


def test_python_collects_no_garbage_while_the_service_starts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    enabled = []

    def serve(*_: object) -> Served:
        enabled.append(gc.isenabled())
        return Served({}, [])

    monkeypatch.setattr("twostage_servo.app.serve.serve", serve)
    assert main(["run", "--config", str(CONFIG), "--set", f"service.socket={tmp_path / 'socket'}"]) == 0
    assert enabled == [False]
    assert gc.isenabled()


def test_it_does_so_again_after_a_start_that_failed() -> None:
    assert main(["run", "--config", str(CONFIG), "--set", "service.tick_ms=0"]) == 2
    assert gc.isenabled()


def test_run_loads_no_other_group_of_verbs() -> None:
    script = (
        "import sys, twostage_servo.cli.main as main; main.build_parser('run'); "
        "rooms = ('twostage_servo.cli.', 'twostage_servo.faults'); "
        "print(*(name for name in sys.modules if name.startswith(rooms)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)  # noqa: S603
    loaded = {name.rpartition(".")[2] for name in done.stdout.split()}
    assert loaded == {"configuration", "extras", "main", "operate", "output", "serve", "typed_names", "typed_numbers"}


def test_an_operators_verb_loads_no_cryptography() -> None:
    """OpenSSL takes a twentieth of the time in which `status` is there."""
    script = "import sys, twostage_servo.cli.operator_verbs; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)  # noqa: S603
    loaded = set(done.stdout.split())
    assert "twostage_servo.client" in loaded
    assert loaded.isdisjoint({"hashlib", "_hashlib", "secrets", "ssl"})
