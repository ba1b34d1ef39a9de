"""The examples: short, numbered, and each that operates an axis does so on the real service in simulated time."""

import csv
import importlib.util
import re
import threading
from pathlib import Path
from types import ModuleType

import pytest

from tests.service.operators import serve
from tests.service.rig import World
from twostage_servo.api.address import ENVIRONMENT_VARIABLE
from twostage_servo.axis.state import State
from twostage_servo.service.control_socket import ControlSocket

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))


def example(name: str) -> ModuleType:
    (path,) = (path for path in EXAMPLES if path.name == name)
    spec = importlib.util.spec_from_file_location("example", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def check_log(path: Path) -> None:
    """Check that a log tells of three moves: forth, forth and back."""
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    velocities = [float(row["velocity"]) for row in rows if row["velocity"]]
    assert len(rows) > 30
    assert max(velocities) > 50.0
    assert min(velocities) < -50.0
    assert max(float(row["position"]) for row in rows if row["position"]) == pytest.approx(150.0, abs=5.0)
    times = [float(row["time_s"]) for row in rows]
    assert times == sorted(times)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_an_example_is_numbered_and_fits_on_a_screen(path: Path) -> None:
    assert re.match(r"\d\d_\w+\.py$", path.name)
    assert 10 <= len(path.read_text("utf-8").splitlines()) <= 60


def test_no_two_examples_have_one_number() -> None:
    numbers = [path.name[:2] for path in EXAMPLES]
    assert sorted(set(numbers)) == numbers


def test_the_asynchronous_one_logs_each_tick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(tmp_path / "s"))

    async def script(world: World, _: ControlSocket) -> None:
        await example("03_async_watch_to_csv.py").main(tmp_path / "velocity.csv")
        assert world.state() is State.DISARMED

    serve(tmp_path / "s", script)
    check_log(tmp_path / "velocity.csv")


def test_the_blocking_one_operates_the_axis(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(tmp_path / "s"))
    monkeypatch.chdir(tmp_path)
    errors: list[BaseException] = []

    def run() -> None:
        try:
            example("01_first_move.py").main()
        except BaseException as error:  # noqa: BLE001 - told below, in the thread of the test
            errors.append(error)

    async def script(world: World, _: ControlSocket) -> None:
        thread = threading.Thread(target=run)
        thread.start()
        while thread.is_alive():
            await world.seconds(0.01)
        assert not errors
        assert world.state() is State.DISARMED
        assert world.drive.position == pytest.approx(0.0, abs=1.0)

    serve(tmp_path / "s", script)
    check_log(tmp_path / "velocity.csv")
