"""The examples: short, numbered, and each that operates an axis does so on the real service in simulated time."""

import asyncio
import csv
import importlib.util
import json
import re
import threading
from pathlib import Path
from types import ModuleType

import pytest

from tests.service.operators import serve
from tests.service.rig import World
from twostage_servo.api.address import ENVIRONMENT_VARIABLE
from twostage_servo.app.closed_loop import Wires, closed_loop
from twostage_servo.axis.state import State
from twostage_servo.cli.main import main
from twostage_servo.config.machine import load_machine
from twostage_servo.service.control_socket import ControlSocket
from twostage_servo.timing.virtual_clock import run

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


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
    numbers = sorted(path.name[:2] for path in (ROOT / "examples").iterdir() if not path.name.startswith(("_", ".")))
    assert numbers == [f"{number:02d}" for number in range(1, len(numbers) + 1)]


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


@pytest.mark.parametrize("y_is_held", [False, True])
def test_two_axes_go_round_a_rectangle_and_one_that_trips_stops_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *, y_is_held: bool
) -> None:
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(tmp_path / "s"))
    overrides = ["y:simulation.hard_stop_maximum=20"] if y_is_held else []
    machine = load_machine(ROOT / "config" / "two_axes.toml", overrides)
    errors: list[BaseException] = []
    codes: list[int] = []
    places: list[tuple[float, float]] = []

    def operate() -> None:
        try:
            codes.append(example("02_two_axes.py").main())
        except BaseException as error:  # noqa: BLE001 - told below, in the thread of the test
            errors.append(error)

    async def script() -> None:
        async with closed_loop(machine, wires=Wires()) as loop:
            control = loop.control_socket(tmp_path / "s")
            await control.start()
            x, y = (loop.axes[name].drive for name in ("x", "y"))
            await asyncio.sleep(0.5)
            thread = threading.Thread(target=operate)
            thread.start()
            while thread.is_alive():
                await asyncio.sleep(0.01)
                places.append((x.position, y.position))
            await control.stop()

    run(script())
    assert not errors
    told = capsys.readouterr().out
    if y_is_held:
        assert "\nAxis y has tripped, stall: " in told
        assert "\nNext: " in told
        assert codes == [3]
        assert max(y for _, y in places) < 21.0
    else:
        assert "has tripped" not in told
        assert codes == [0]
        for corner in ((100.0, 0.0), (100.0, 60.0), (0.0, 60.0)):
            assert any(place == pytest.approx(corner, abs=0.5) for place in places)


def test_a_dbc_of_ones_own_moves_an_axis(capsys: pytest.CaptureFixture[str]) -> None:
    file = str(ROOT / "examples" / "06_own_dbc" / "axis.toml")
    assert main(["check", file]) == 0
    assert "command 0x300, feedback 0x301" in capsys.readouterr().out
    assert main(["demo", "--fast", "--json", "--config", file]) == 0
    result = json.loads(capsys.readouterr().out)
    assert abs(result["final_error"]) < 0.05
    assert result["frames"]["rejected"] == 0
