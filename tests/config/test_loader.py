"""Loading: what is accepted, what is wrong with a file or an argument, and that nothing but ConfigError is raised."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tests.machine_settings import VALID, Machine, only_problem, refused, write
from twostage_servo.config.errors import ConfigError, Problem
from twostage_servo.config.loader import Config, described, load, load_as
from twostage_servo.settings.base import Settings
from twostage_servo.settings.reference import describe

VELOCITY_NEEDED = "a number is needed, in axis unit/s, greater than 0, at most 10000 (Largest cruise velocity)"


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


# --- what is right ----------------------------------------------------------------------------------------------------


def test_a_valid_file_is_loaded() -> None:
    loaded = load_as(Machine, write(VALID))
    assert loaded.config.axis.limits.velocity == 900.0
    assert loaded.config.axis.gains == [1.0, 2.5]
    assert loaded.config.axis.fault is False
    assert [waypoint.position for waypoint in loaded.config.axis.waypoints] == [1.0, 2.0]
    assert loaded.config.bus.options == {"tcp_tune": True, "receive buffer": 4096}
    assert loaded.source == "axis.toml"
    assert loaded.folder.resolve() == Path.cwd()


@pytest.mark.parametrize("encode", [lambda t: b"\xef\xbb\xbf" + t.encode(), lambda t: t.replace("\n", "\r\n").encode()])
def test_a_byte_order_mark_and_windows_line_ends_are_accepted(encode: Callable[[str], bytes]) -> None:
    assert load_as(Machine, write(encode(VALID))).config == load_as(Machine, write(VALID.encode())).config
    assert only_problem(write(encode(VALID.replace("900.0", "-1")))).line == 16


@pytest.mark.parametrize(
    ("override", "read", "value"),
    [
        ("axis.limits.velocity=12.5", lambda c: c.axis.limits.velocity, 12.5),
        ("axis.limits.velocity = 12", lambda c: c.axis.limits.velocity, 12.0),
        ('axis.unit="deg"', lambda c: c.axis.unit, "deg"),
        ("axis.unit=deg", lambda c: c.axis.unit, "deg"),
        ("bus.channel=10.0.0.5", lambda c: c.bus.channel, "10.0.0.5"),
        ("bus.channel=3", lambda c: c.bus.channel, 3),
        ("axis.gains=[1, 2]", lambda c: c.axis.gains, [1.0, 2.0]),
        ('bus.options."receive buffer"=1', lambda c: c.bus.options["receive buffer"], 1),
        ("bus.options={a = 1}", lambda c: c.bus.options, {"a": 1}),
        ("bus.listen_only=true", lambda c: c.bus.listen_only, True),
        ("axis.fault=Error", lambda c: c.axis.fault, "Error"),
    ],
)
def test_an_override_takes_the_place_of_the_file(
    override: str, read: Callable[[Machine], object], value: object
) -> None:
    path = write(VALID)
    assert read(load_as(Machine, path).config) != value
    assert read(load_as(Machine, path, [override]).config) == value


def test_the_last_override_of_a_key_wins() -> None:
    loaded = load_as(Machine, write(VALID), ["axis.limits.velocity=1", "axis.limits.velocity=2"])
    assert loaded.config.axis.limits.velocity == 2.0


def test_the_embedded_demo_is_valid() -> None:
    loaded = load(None)
    assert isinstance(loaded.config, Config)
    assert loaded.source == "demo.toml (built in)"
    assert (loaded.folder / "demo.toml").is_file()


def test_all_problems_are_reported_at_once_in_the_order_of_the_file() -> None:
    text = VALID.replace("900.0", '"fast"').replace('"mm"', "5").replace('channel = "can0"', "chanel = 1")
    error = refused(write(text), "axis.home=left")
    assert [(problem.line, problem.key) for problem in error.problems] == [
        (3, "bus.chanel"),
        (7, "axis.unit"),
        (16, "axis.limits.velocity"),
        (None, "axis.home"),
    ]
    assert str(error).split("\n") == [str(problem) for problem in error.problems]


def test_a_file_of_something_else_gives_a_hundred_problems_and_their_number() -> None:
    text = VALID + "".join(f"[table{number}]\n" for number in range(5000))
    problems = refused(write(text)).problems
    assert len(problems) == 101
    assert problems[0].line == len(VALID.split("\n"))
    assert problems[-1].message == "and 4900 more; check that this is a configuration of twostage-servo"


# --- what is wrong with the file itself -------------------------------------------------------------------------------


def test_a_missing_file() -> None:
    problem = only_problem(Path("axsi.toml"))
    assert (
        str(problem)
        == "axsi.toml: there is no such file; check the name, and the current folder if the name is relative"
    )


@pytest.mark.parametrize("typed", ["two_processes", "two_proceses.toml"])
def test_a_missing_file_that_is_named_nearly_as_a_shipped_one(typed: str) -> None:
    assert str(only_problem(Path(typed))) == f"{typed}: there is no such file; did you mean two_processes.toml?"


def test_a_missing_file_that_is_named_nearly_as_one_beside_it(tmp_path: Path) -> None:
    (tmp_path / "axis_left.toml").write_text(VALID, "utf-8")
    problem = only_problem(tmp_path / "axis_lfet.toml")
    assert problem.message == f"there is no such file; did you mean {tmp_path}/axis_left.toml?"


def test_a_folder() -> None:
    write(VALID)
    assert str(only_problem(Path())) == ".: this is a folder; name a TOML file in it: axis.toml"


def test_a_name_below_a_file() -> None:
    assert "axis.toml/x: cannot be read: " in str(only_problem(write(VALID) / "x"))


def test_a_name_with_a_zero_byte() -> None:
    assert "cannot be read: " in only_problem(Path("a\0b.toml")).message


def test_an_unreadable_file(monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(VALID)

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)  # root may read everything, so the mode bits would prove nothing
    assert f"axis.toml: user {os.getuid()} may not read it; check the owner" in str(only_problem(path))


@pytest.mark.parametrize("text", ["", "\n\n", "# only a comment\n", "\ufeff"])
def test_a_file_without_settings(text: str) -> None:
    assert only_problem(write(text)).message == "there are no settings in this file; start from a copy of demo.toml"


def test_a_file_that_is_too_large() -> None:
    filled = VALID + "#" * (1_000_000 - len(VALID))
    assert load_as(Machine, write(filled)).config.axis.unit == "mm"
    assert "is larger than 1000000 bytes" in only_problem(write(filled + "#")).message


def test_a_file_that_never_ends() -> None:
    assert "a device, a pipe or a socket" in only_problem(Path("/dev/zero")).message


def test_a_file_that_is_not_utf8() -> None:
    problem = only_problem(write(VALID.replace('"mm"', '"\u00b5m"').encode("latin-1")))
    assert str(problem) == "axis.toml:7: byte 0xb5 is not UTF-8; save the file as UTF-8"


def test_a_long_line_is_shown_around_the_error() -> None:
    problem = only_problem(write(f"options = [{'1, ' * 200}wrong{', 1' * 200}]"))
    shown, caret = problem.message.split("\n")[1:]
    assert shown[caret.index("^") :].startswith("wrong")
    assert len(shown) <= 104


# --- what is wrong with an override -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "key", "says"),
    [
        ("axis.limits.velocity=fast", "axis.limits.velocity", f'axis.limits.velocity = "fast": {VELOCITY_NEEDED}'),
        ("axis.limits.velocity=-1", "axis.limits.velocity", f"= -1: {VELOCITY_NEEDED}"),
        ("axis.limits.velocty=3", "axis.limits.velocty", "unknown key; did you mean axis.limits.velocity?"),
        ("axsi.unit=mm", "axsi", "unknown key; did you mean axis?"),
        ("axis.unit.length=3", "axis.unit.length", "axis.unit is not a table and has no keys"),
        ("axis.limits={velocity=3}", "axis.limits.overspeed", "is missing; a number is needed"),
        ("axis.limits={velocity=3, overspeed=2}", "axis.limits", "overspeed = 2 is not above velocity = 3"),
        ("axis.waypoints=[{position=101}]", "axis.waypoints[0].position", "= 101: a number is needed"),
        ("axis=3", "axis", "axis = 3: a table is needed"),
        ("axis.limits.velocity", "", "is not KEY=VALUE, such as simulation.gain=234"),
        ("=3", "", "is not KEY=VALUE"),
        ("", "", "is not KEY=VALUE"),
        ("axis..unit=mm", "axis..unit", "is not a dotted key"),
        ("axis unit=mm", "axis unit", "is not a dotted key"),
        ("[axis]=3", "[axis]", "is not a dotted key"),
        ("a={b=1}=3", "a", "write a value as in TOML"),
        ("axis.unit=", "axis.unit", 'Invalid value; write a value as in TOML: 1.5, true, "mm", [1, 2], ""'),
        ('axis.unit="mm', "axis.unit", "write a value as in TOML"),
        ("axis.gains=[1, 2", "axis.gains", "write a value as in TOML"),
        ("axis.unit=a\nb=3", "", "contains unprintable characters"),
        ("axis.unit=\udcff", "", "contains unprintable characters"),
        (f"{'a.' * 3000}a=3", "a", "unknown key"),
        ('axis.new.key="x', "axis.new.key", "write a value as in TOML"),
        (f"axis.gains={'[' * 5000}", "axis.gains", "write a value as in TOML"),
    ],
)
def test_a_broken_override_names_the_argument(override: str, key: str, says: str) -> None:
    problem = only_problem(write(VALID), override)
    assert problem.line is None
    assert problem.file.startswith("--set ")
    if override.isprintable():
        assert problem.file == f"--set {override}"
    assert problem.key == key
    assert says in str(problem)
    assert str(problem).isprintable()


def test_a_check_over_several_keys_names_the_table_and_the_overrides_in_it() -> None:
    problem = only_problem(write(VALID), "axis.limits.velocity=2000")
    assert str(problem) == (
        "axis.toml:15: axis.limits: overspeed = 1100 is not above velocity = 2000 "
        "(with --set axis.limits.velocity=2000)"
    )


def test_an_override_hides_what_was_wrong_in_the_file() -> None:
    path = write(VALID.replace("900.0", '"fast"'))
    assert only_problem(path).line == 16
    assert load_as(Machine, path, ["axis.limits.velocity=3"]).config.axis.limits.velocity == 3.0


# --- problems that are found after loading ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "text"),
    [
        (("axis", "fault"), "axis.toml:9: axis.fault = false: no such signal"),
        (("axis", "gains", 1), "axis.toml:12: axis.gains[1] = 2.5: no such signal"),
        (("axis", "limits"), "axis.toml:15: axis.limits: no such signal"),
        (("axis", "limits", "missed_ticks"), "axis.toml:15: axis.limits.missed_ticks: no such signal"),
        (("bus", "channel"), '--set bus.channel=can1: bus.channel = "can1": no such signal'),
        (("drive", "dbc"), "axis.toml: drive.dbc: no such signal"),
    ],
)
def test_a_later_problem_is_located(key: tuple[str | int, ...], text: str) -> None:
    loaded = load_as(Machine, write(VALID), ["bus.channel=can1"])
    assert str(loaded.problem(key, "no such signal")) == text


# --- nothing but ConfigError ------------------------------------------------------------------------------------------

FRAGMENTS = st.sampled_from(
    [
        *(
            "axis",
            "bus",
            "limits",
            "velocity",
            "waypoints",
            "unit",
            "options",
            "a",
            "1",
            "-1.5",
            "1e999",
            "nan",
            "true",
        ),
        *(
            "1979-05-27",
            "07:32:00",
            '"x"',
            "[axis]",
            "[[axis.waypoints]]",
            "a.b = 1\n",
            "= 1\n",
            '"""',
            "'''",
            "[[",
            "0x",
        ),
        *"[]{}=.,\n #\"'\\\r\0é\ufeff\u2028",
    ]
)


@st.composite
def mutations(draw: st.DrawFn, valid: str) -> str:
    text = valid
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(text)))
        end = min(len(text), start + draw(st.integers(0, 12)))
        text = text[:start] + "".join(draw(st.lists(FRAGMENTS, max_size=3))) + text[end:]
    return text


def accept_or_refuse(model: type[Settings], path: Path, overrides: list[str]) -> None:
    """Load; check that an error is a ConfigError whose every problem names an existing place and can be printed."""
    problems: tuple[Problem, ...] = ()
    try:
        load_as(model, path, overrides)
    except ConfigError as error:
        problems = error.problems
    lines = path.read_bytes().count(b"\n") + 1
    for problem in problems:
        assert problem.message
        assert problem.line is None or 1 <= problem.line <= lines
        str(problem).encode()


FUZZ = settings(
    max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


@FUZZ
@given(st.lists(FRAGMENTS, max_size=40).map("".join) | st.text() | st.binary())
@example("a.a = 1\na = 2")
@example("a = { b = 1, b = [2] }")
def test_random_text_raises_nothing_else(content: str | bytes) -> None:
    encoded = content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass")
    accept_or_refuse(Machine, write(encoded), [])


@FUZZ
@given(mutations(VALID))
def test_a_mutated_file_raises_nothing_else(text: str) -> None:
    accept_or_refuse(Machine, write(text), [])


@FUZZ
@given(mutations((Path(__file__).parents[2] / "config" / "demo.toml").read_text("utf-8")))
def test_a_mutated_demo_raises_nothing_else(text: str) -> None:
    accept_or_refuse(Config, write(text), [])


@FUZZ
@given(st.lists(st.lists(FRAGMENTS, max_size=12).map("".join) | st.text(), min_size=1, max_size=3))
def test_random_overrides_raise_nothing_else(overrides: list[str]) -> None:
    accept_or_refuse(Machine, write(VALID), overrides)


# --- the reference ----------------------------------------------------------------------------------------------------


def test_the_reference_lists_every_key_in_words() -> None:
    rows = {row.key: row for row in describe(Machine)}
    assert list(rows)[:5] == ["bus.channel", "bus.options", "bus.listen_only", "axis.unit", "axis.home"]
    velocity = rows["axis.limits.velocity"]
    assert (velocity.type, velocity.unit, velocity.default) == ("a number", "axis unit/s", None)
    assert velocity.bounds == "greater than 0, at most 10000"
    assert velocity.description == "Largest cruise velocity"
    assert (rows["axis.fault"].type, rows["axis.fault"].default) == ("a text in quotes or false", '"Fault"')
    assert (rows["axis.ratio"].type, rows["axis.ratio"].default) == ("a number", "not set")
    assert rows["axis.home"].type == 'one of "index", "switch"'
    assert rows["bus.options"].default == "{}"


UNBOUNDED = {"protocol.feedback.position_scale": "any factor, of either sign"}
"""Numbers of the real configuration that need no lower or upper bound: key, and why."""


@pytest.mark.parametrize("key", [row.key for row in describe(described(Config, {}))])
def test_every_setting_has_a_description_and_every_number_a_unit_and_bounds(key: str) -> None:
    row = next(row for row in describe(described(Config, {})) if row.key == key)
    assert row.description, "no description"
    assert "\n" not in row.description
    if row.type in ("a number", "a whole number"):
        assert row.unit, "no unit"
        assert (row.lower and row.upper) or key in UNBOUNDED, "a bound is missing"


def test_the_list_of_unbounded_numbers_is_not_stale() -> None:
    rows = {row.key: row for row in describe(described(Config, {}))}
    assert all(not (rows[key].lower and rows[key].upper) for key in UNBOUNDED)
