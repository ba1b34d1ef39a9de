"""What the installed package holds, and what its rooms may not load."""

import ast
import importlib.resources
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import cantools
import pytest

import twostage_servo

PACKAGE = Path(twostage_servo.__file__).parent
PYPROJECT = Path(__file__).parent.parent / "pyproject.toml"

HEAVY = {"numpy", "scipy", "control", "can", "cantools", "pydantic", "structlog", "asyncio", "matplotlib"}


def imported_modules(source: Path) -> Iterator[str]:
    """Every module that a file imports anywhere, also inside functions; of ``from package import module`` both."""
    for node in ast.walk(ast.parse(source.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{source}: relative import"
            assert node.module is not None
            yield node.module
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name for name in names if is_module(PACKAGE.parent.joinpath(*name.split("."))))


def is_module(path: Path) -> bool:
    return path.is_dir() or path.with_suffix(".py").is_file()


def room_of(source: Path) -> str:
    return source.relative_to(PACKAGE).parts[0].removesuffix(".py")


SOURCES = sorted(source for source in PACKAGE.rglob("*.py") if source != PACKAGE / "__init__.py")


def test_the_configuration_takes_only_settings_from_the_rooms() -> None:
    own = {"config", "settings"}
    names = {
        alias.name
        for source in (PACKAGE / "config").glob("*.py")
        for node in ast.walk(ast.parse(source.read_text("utf-8")))
        if isinstance(node, ast.ImportFrom)
        and (module := (node.module or "").split("."))[0] == "twostage_servo"
        and module[1] not in own
        and len(module) > 2  # of a room; what belongs to none, such as portable_error, serves all
        for alias in node.names
    }
    assert sorted(names) == [
        "AxisSettings",
        "BusSettings",
        "DriveSettings",
        "RealtimeSettings",
        "ServiceSettings",
        "SimulationSettings",
    ]


@pytest.mark.parametrize(
    "source", [s for s in SOURCES if room_of(s) in {"control", "axis"}], ids=lambda s: str(s.relative_to(PACKAGE))
)
def test_control_and_axis_know_neither_bus_nor_loop(source: Path) -> None:
    assert {name.partition(".")[0] for name in imported_modules(source)}.isdisjoint({"can", "cantools", "asyncio"})


@pytest.mark.parametrize("source", [s for s in SOURCES if room_of(s) == "drives"], ids=lambda s: s.name)
def test_drives_know_neither_bus_nor_loop_nor_log(source: Path) -> None:
    assert {name.partition(".")[0] for name in imported_modules(source)}.isdisjoint({"can", "asyncio", "structlog"})


@pytest.mark.parametrize("module", ["twostage_servo.cli.main", "twostage_servo"])
def test_the_command_line_starts_without_heavy_imports(module: str, tmp_path: Path) -> None:
    script = f"import sys; before = set(sys.modules); import {module}; print(*sorted(set(sys.modules) - before))"
    finished = subprocess.run(  # noqa: S603 - our own interpreter and text
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60
    )
    loaded = finished.stdout.split()
    assert module in loaded
    assert {name.partition(".")[0] for name in loaded} & HEAVY == set()


def test_the_demo_and_the_dbc_are_in_the_package() -> None:
    folder = importlib.resources.files("twostage_servo_config")
    assert tomllib.loads((folder / "demo.toml").read_text("utf-8"))
    database = cantools.database.can.Database(strict=True)
    database.add_dbc_string((folder / "servo_drive.dbc").read_text("utf-8"))
    assert {message.name for message in database.messages} >= {"DriveCommand", "DriveFeedback", "DriveHeartbeat"}


def test_the_version_is_the_same_in_both_places() -> None:
    assert tomllib.loads(PYPROJECT.read_text("utf-8"))["project"]["version"] == twostage_servo.__version__


def test_every_room_is_in_the_wheel() -> None:
    listed = tomllib.loads(PYPROJECT.read_text("utf-8"))["tool"]["setuptools"]["packages"]
    rooms = {
        ".".join(folder.parent.relative_to(PACKAGE.parent).parts)
        for folder in PACKAGE.rglob("__init__.py")
        if folder.parent != PACKAGE
    }
    assert set(listed) == {"twostage_servo", "twostage_servo_config", "twostage_servo_systemd"} | rooms
