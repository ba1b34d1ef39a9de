"""Keys under their former names: taken, with a note of the present one and of the place."""

from collections.abc import Callable
from pathlib import Path

import pytest

from twostage_servo.cli.main import main
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.loader import Config, load
from twostage_servo.config.machine import MachineConfig, load_machine
from twostage_servo.config.renamed_keys import present_path
from twostage_servo.settings.base import Settings
from twostage_servo.settings.reference import table_of

CONFIGURATIONS = Path(__file__).parents[2] / "config"


@pytest.fixture
def demo_with(tmp_path: Path) -> Callable[[str], Path]:
    def write(more: str) -> Path:
        path = tmp_path / "axis.toml"
        path.write_text((CONFIGURATIONS / "demo.toml").read_text(encoding="utf-8") + more, encoding="utf-8")
        return path

    return write


def test_a_former_name_means_the_same_and_is_noted_with_its_line(demo_with: Callable[[str], Path]) -> None:
    path = demo_with('\n[realtime]\nspin = "off"\nsend_at = 120.0\n')
    loaded = load(path)
    assert (loaded.config.realtime.busy_wait, loaded.config.realtime.output_offset) == ("off", 120.0)
    last = len(path.read_text(encoding="utf-8").splitlines())
    assert [str(one) for one in loaded.notes] == [
        f"{path}:{last - 1}: realtime.spin: is now called realtime.busy_wait; the former name works until 1.0",
        f"{path}:{last}: realtime.send_at: is now called realtime.output_offset; the former name works until 1.0",
    ]


@pytest.mark.parametrize(
    ("former", "present"),
    [("innovation", "innovation_gate"), ("jam_effort", "stall_effort"), ("jam_time_ms", "stall_time_ms")],
)
def test_a_limit_may_have_its_former_name(tmp_path: Path, former: str, present: str) -> None:
    text = (CONFIGURATIONS / "demo.toml").read_text(encoding="utf-8")
    path = tmp_path / "axis.toml"
    path.write_text(text.replace(f"\n{present} = ", f"\n{former} = "), encoding="utf-8")
    loaded = load(path)
    assert loaded.config == load(CONFIGURATIONS / "demo.toml").config
    (note,) = loaded.notes
    assert f"axis.limits.{former}: is now called axis.limits.{present};" in str(note)


def test_present_names_are_not_noted(demo_with: Callable[[str], Path]) -> None:
    assert load(demo_with('\n[realtime]\nbusy_wait = "off"\n')).notes == ()


def test_a_value_under_a_former_name_is_refused_at_its_line(demo_with: Callable[[str], Path]) -> None:
    path = demo_with("\n[realtime]\nspin = 2000.0\n")
    last = len(path.read_text(encoding="utf-8").splitlines())
    with pytest.raises(ConfigError, match=rf"axis\.toml:{last}: realtime\.busy_wait = 2000\.0: "):
        load(path)


def test_both_names_in_one_file_are_refused_with_both_lines(demo_with: Callable[[str], Path]) -> None:
    path = demo_with('\n[realtime]\nspin = "off"\nbusy_wait = "auto"\n')
    last = len(path.read_text(encoding="utf-8").splitlines())
    with pytest.raises(ConfigError, match=rf"axis\.toml:{last - 1}: realtime\.spin: .*is also in line {last}"):
        load(path)


def test_an_argument_may_have_a_former_name_and_goes_before_the_file(demo_with: Callable[[str], Path]) -> None:
    loaded = load(demo_with('\n[realtime]\nbusy_wait = "auto"\n'), ["realtime.spin=50.0"])
    assert loaded.config.realtime.busy_wait == 50.0
    (note,) = loaded.notes
    assert str(note).startswith("--set realtime.spin=50.0: realtime.spin: is now called realtime.busy_wait;")


def test_a_machine_notes_those_of_its_axes_as_well(tmp_path: Path) -> None:
    for name in ("two_processes.toml", "second_axis.toml"):
        text = (CONFIGURATIONS / name).read_text(encoding="utf-8")
        (tmp_path / name).write_text(text, encoding="utf-8")
    path = tmp_path / "machine.toml"
    path.write_text(
        '[machine]\naxes = ["two_processes.toml", "second_axis.toml"]\nwhen_one_trips = "disarm"\n', encoding="utf-8"
    )
    machine = load_machine(path, ["realtime.send_at=off", "y:realtime.send_at=off"])
    assert machine.fault_reaction == "disarm"
    assert [one.key for one in machine.notes] == ["machine.when_one_trips", "realtime.send_at", "realtime.send_at"]


def test_check_notes_them_on_stderr_and_ends_well(
    demo_with: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = demo_with('\n[realtime]\nspin = "off"\n')
    assert main(["check", str(path), "--json"]) == 0
    assert "realtime.spin: is now called realtime.busy_wait" in capsys.readouterr().err


@pytest.mark.parametrize("model", [Config, MachineConfig])
def test_no_former_name_is_a_key_and_each_present_one_is(model: type[Settings]) -> None:
    left = [model]
    seen = 0
    while left:
        table = left.pop()
        seen += 1
        fields = table.model_fields
        assert not set(table.renamed) & set(fields)
        assert set(table.renamed.values()) <= set(fields)
        inner = [table_of(field.annotation) for field in fields.values()]
        left += [one for one in inner if one is not None and issubclass(one, Settings)]
    assert seen > 3


def test_a_path_that_nobody_knows_stays_as_it_is() -> None:
    assert present_path(Config, ("nowhere", "spin")) == ("nowhere", "spin")
    assert present_path(Config, ("realtime", "spin")) == ("realtime", "busy_wait")
