"""The way of a key from TOML to its use: each file is read, parsed and scanned once, whoever asks."""

import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from twostage_servo.cli.main import main
from twostage_servo.config import toml_lines
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.files import shipped_configuration
from twostage_servo.config.machine import load_machine
from twostage_servo.config.named_socket import socket_named_in

TWO_AXES = shipped_configuration("two_axes.toml")


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """What is read, parsed and scanned, each with how often."""
    counted: Counter[str] = Counter()
    path_open, loads, key_lines = Path.open, tomllib.loads, toml_lines.key_lines

    def counting_open(path: Path, *arguments: Any, **options: Any) -> Any:
        if path.suffix == ".toml":
            counted[f"read {path.name}"] += 1
        return path_open(path, *arguments, **options)

    def counting_loads(text: str) -> dict[str, Any]:
        counted["parsed"] += "\n" in text
        return loads(text)

    def counting_lines(text: str) -> dict[toml_lines.Path, int]:
        counted["scanned"] += 1
        return key_lines(text)

    monkeypatch.setattr(Path, "open", counting_open)
    monkeypatch.setattr(tomllib, "loads", counting_loads)
    monkeypatch.setattr(toml_lines, "key_lines", counting_lines)
    return counted


def test_an_axis_is_read_once(done: Counter[str]) -> None:
    load_machine(shipped_configuration("demo.toml"), ["simulation.gain=200.0"])
    assert done == {"read demo.toml": 1, "parsed": 1, "scanned": 1}


def test_a_machine_and_its_axes_are_read_once_each_also_with_arguments_for_an_axis(done: Counter[str]) -> None:
    names = tomllib.loads(TWO_AXES.read_text("utf-8"))["machine"]["axes"]
    done.clear()
    machine = load_machine(TWO_AXES, ["y:simulation.gain=200.0", "x:simulation.pole=11.0"])
    assert (machine.axis("y").config.simulation.gain, machine.axis("x").config.simulation.pole) == (200.0, 11.0)
    assert done == {"read two_axes.toml": 1, **{f"read {name}": 1 for name in names}, "parsed": 3, "scanned": 3}


def test_an_argument_for_one_axis_leaves_what_was_read_as_it_was() -> None:
    machine = load_machine(TWO_AXES, ["y:axis.limits.velocity=100.0"])
    assert machine.axis("y").config.axis.limits.velocity == 100.0
    assert load_machine(TWO_AXES).axis("y").config.axis.limits.velocity != 100.0


def test_the_socket_of_a_configuration_is_read_once_and_the_rest_is_not_judged(
    done: Counter[str], tmp_path: Path
) -> None:
    path = tmp_path / "axis.toml"
    path.write_text('[service]\nsocket = "/run/x/s"\nno_such_key = 1\n', "utf-8")
    done.clear()
    assert socket_named_in(path) == Path("/run/x/s")
    assert done == {"read axis.toml": 1, "parsed": 1}
    path.write_text("[axis]\nname = 5\n", "utf-8")
    assert socket_named_in(path) is None
    path.write_text('[service]\nsocket = ""\n', "utf-8")
    assert socket_named_in(path) is None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[service]\n\nsocket = 5\n", ":3: service.socket = 5: a text in quotes is needed"),
        ("a = 1\nservice = 5\n", ":2: service = 5: a table is needed"),
        ('service = "x"\n', ':1: service = "x": a table is needed'),
        ("[service]\nsocket = x\n", ":2: not TOML at column 10"),
        ("", ": there are no settings in this file"),
    ],
)
def test_a_socket_that_cannot_be_had_is_told_with_its_place(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "axis.toml"
    path.write_text(text, "utf-8")
    with pytest.raises(ConfigError) as refused:
        socket_named_in(path)
    assert str(refused.value).startswith(f"{path}{says}")


def test_an_operators_verb_refuses_such_a_file_as_check_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "axis.toml"
    path.write_text("[service]\nsocket = 5\n", "utf-8")
    assert main(["status", "--config", str(path)]) == 2
    assert f"{path}:2: service.socket = 5: a text in quotes is needed" in capsys.readouterr().err
    assert main(["status", "--config", str(tmp_path / "none.toml")]) == 2
    assert "there is no such file" in capsys.readouterr().err


def test_the_socket_is_found_without_the_settings_and_their_library() -> None:
    script = (
        "import sys, pathlib\nfrom twostage_servo.config.named_socket import socket_named_in\n"
        "print(socket_named_in(pathlib.Path(sys.argv[1])))\n"
        "print(*sorted(set(sys.modules) & {'pydantic', 'numpy', 'can', 'asyncio', 'scipy'}))"
    )
    command = [sys.executable, "-c", script, str(TWO_AXES)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)  # noqa: S603 - our own text
    assert done.stdout.split("\n") == ["None", "", ""]
