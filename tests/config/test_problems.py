"""Every broken file names its line, its key and what would be right."""

from pathlib import Path
from typing import NamedTuple

import pytest

from tests.machine_settings import VALID, refused, write


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def check(old: str, new: str, key: str, says: tuple[str, ...]) -> None:
    """Change VALID; ``# <--`` in the change marks the line that the problem must name (no mark: no line)."""
    assert VALID.count(old) == 1
    text = VALID.replace(old, new)
    marked = [number for number, line in enumerate(text.split("\n"), start=1) if "# <--" in line]
    problem = refused(write(text)).problems[0]
    assert problem.file == "axis.toml"
    assert problem.key == key
    assert problem.line == (marked[0] if marked else None)
    assert str(problem).startswith(f"axis.toml:{marked[0]}: " if marked else "axis.toml: ")
    for part in says:
        assert part in str(problem)


# --- one number, with everything that it is not -----------------------------------------------------------------------

NOT_A_VELOCITY = {
    '"fast"': '"fast"',
    "-3": "-3",
    "0": "0",
    "1e5": "100000.0",
    "true": "true",
    "2024-01-02": "2024-01-02",
    "[[1], 2]": "[[1], 2]",
    "[[[[[1]]]]]": "[[[...]]]",
    '{ x = 1, "y z" = "" }': None,
    "nan": "nan",
    "-inf": "-inf",
    "1e999": "inf",
    f"0x{'f' * 5000}": "0x" + "f" * 75 + "...",
}


@pytest.mark.parametrize(("written", "shown"), NOT_A_VELOCITY.items())
def test_a_wrong_number_is_shown_with_what_is_needed(written: str, shown: str | None) -> None:
    needed = "a number is needed, in axis unit/s, greater than 0, at most 10000 (Largest cruise velocity)"
    value = "" if shown is None else f" = {shown}"
    finite = "is not finite; " if "nan" in written or "inf" in str(shown) else ""
    check("900.0", f"{written} # <--", "axis.limits.velocity", (f":16: axis.limits.velocity{value}: {finite}{needed}",))


# --- the other types, keys and tables ---------------------------------------------------------------------------------


class Broken(NamedTuple):
    old: str
    new: str
    key: str
    says: str


LIMITS = "[axis.limits]\nvelocity = 900.0\noverspeed = 1100.0"
GAINS = "gains = [\n    1.0,  # first\n    2.5,\n]"
AXIS = VALID[VALID.index("[axis]") : VALID.index("[[axis")]
AXIS_WITHOUT_LIMITS = AXIS.replace(LIMITS, "").replace("[axis]", "[axis] # <--")
FIRST_WAYPOINT = "[[axis.waypoints]]\nposition = 1.0"

WRONG_VALUES = [
    Broken(
        "1100.0", "1e4 # <--", "axis.limits.overspeed", "= 10000.0: a number is needed, in axis unit/s, greater than 0"
    ),
    Broken("1100.0", "1e4 # <--", "axis.limits.overspeed", "less than 10000 (Speed at which the axis trips)"),
    Broken(
        "1100.0",
        "1100\nmissed_ticks = 2.5 # <--",
        "axis.limits.missed_ticks",
        "= 2.5: a whole number is needed, in ticks, at least 0, at most 1000 (Ticks missed in one go)",
    ),
    Broken('"mm"', "5 # <--", "axis.unit", "= 5: a text in quotes is needed, not empty"),
    Broken('"mm"', '"" # <--', "axis.unit", '= "": a text in quotes is needed, not empty'),
    Broken('"mm"', '"metre" # <--', "axis.unit", '= "metre": a text in quotes is needed'),
    Broken('"mm"', '"metre" # <--', "axis.unit", "at most 4 characters (Unit of position)"),
    Broken('"mm"', r'"\u001b[2Jmm" # <--', "axis.unit", r'= "\u001b[2Jmm": a text in quotes is needed'),
    Broken('"switch"', '"swich" # <--', "axis.home", '= "swich": one of "index", "switch" is needed (How the zero is'),
    Broken("false", "true # <--", "axis.fault", "= true: a text in quotes or false is needed (Signal of the"),
    Broken('"mm"', '"mm"\ncode = "aa" # <--', "axis.code", "needed, matching ^[A-Z][0-9]$ (Order code)"),
    Broken(
        '"mm"', '"mm"\nratio = 101 # <--', "axis.ratio", "= 101: a number is needed, greater than 0, at most 100 (Gear"
    ),
    Broken('"can0"', "1.5 # <--", "bus.channel", "= 1.5: a text in quotes or a whole number is needed (Channel"),
    Broken('"can0"', '"can0"\nlisten_only = "yes" # <--', "bus.listen_only", '= "yes": true or false is needed (Never'),
    Broken("    2.5,", '    "b", # <--', "axis.gains[1]", '= "b": a number is needed (Gains)'),
    Broken(
        GAINS, "gains = [ # <--\n 1, 2,\n 3, 4]", "axis.gains", "= [1, 2, 3, 4]: a list (each entry a number) is needed"
    ),
    Broken(GAINS, "gains = [] # <--", "axis.gains", "is needed, not empty, at most 3 entries (Gains)"),
    Broken("4096 }", "[4] } # <--", 'bus.options."receive buffer"', "= [4]: a text in quotes or a whole number or a"),
    Broken("2.0", "200 # <--", "axis.waypoints[1].position", "= 200: a number is needed, in axis unit, at least -100"),
    Broken('[bus]\nchannel = "can0"\n', "bus = 3 # <--\n[more]\n", "bus", "= 3: a table is needed"),
    Broken(LIMITS, "limits = 3 # <--", "axis.limits", "= 3: a table is needed (What the axis must never exceed)"),
    Broken(
        LIMITS,
        LIMITS.replace("]", "] # <--").replace("1100", "800"),
        "axis.limits",
        "overspeed = 800 is not above velocity = 900",
    ),
]

WRONG_KEYS = [
    Broken("[axis.limits]\nvelocity = 900.0", "[axis.limits] # <--", "axis.limits.velocity", "is missing; a number is"),
    Broken(LIMITS, "limits = { velocity = 1 } # <--", "axis.limits.overspeed", "is missing; a number is needed"),
    Broken(FIRST_WAYPOINT, "[[axis.waypoints]] # <--", "axis.waypoints[0].position", "is missing; a number is needed"),
    Broken('[axis]\nunit = "mm"', "[axis] # <--", "axis.unit", "is missing; a text in quotes is needed"),
    Broken(
        AXIS,
        AXIS_WITHOUT_LIMITS,
        "axis.limits",
        "the table is missing (What the axis must never exceed)",
    ),
    Broken(AXIS, AXIS_WITHOUT_LIMITS, "axis.limits", "required keys: velocity, overspeed"),
    Broken("900.0", "900\nvelocty = 1 # <--", "axis.limits.velocty", "unknown key; did you mean axis.limits.velocity?"),
    Broken(
        "900.0",
        "900\nvelocty = 1 # <--",
        "axis.limits.velocty",
        "keys of [axis.limits]: velocity, overspeed, missed_ticks",
    ),
    Broken('"mm"', '"mm"\nvelocity = 5 # <--', "axis.velocity", "unknown key; did you mean axis.limits.velocity?"),
    Broken('"mm"', '"mm"\nqqq = 5 # <--', "axis.qqq", "= 5: unknown key; keys of [axis]: unit, home, fault"),
    Broken('"mm"', '"mm"\n"uni t" = 5 # <--', 'axis."uni t"', "unknown key; did you mean axis.unit?"),
    Broken('"mm"', '"mm"\nlimit.velocity = 5 # <--', "axis.limit", "unknown key; did you mean axis.limits?"),
    Broken(
        "2.0", "2.0\nspeed = 1 # <--", "axis.waypoints[1].speed", "unknown key; keys of [axis.waypoints[1]]: position"
    ),
    Broken("[bus]", "[buss] # <--", "buss", "buss: unknown key; did you mean bus?; keys of the file: bus, axis"),
    Broken("# a machine", "speed = 1 # <--", "speed", "speed = 1: unknown key; keys of the file: bus, axis"),
]

GIVEN_TWICE = [
    Broken("1100.0", "1100\nvelocity = 1 # <--", "axis.limits.velocity", "clashes with line 16: each key"),
    Broken(LIMITS, "gains = [ # <--\n1,\n]", "axis.gains", "clashes with line 10: each key"),
    Broken(FIRST_WAYPOINT, "[axis] # <--", "axis", "clashes with line 6: each key"),
    Broken(FIRST_WAYPOINT, "[axis.unit] # <--", "axis.unit", "clashes with line 7: each key"),
    Broken("true,", "true, tcp_tune = 1, # <--", "bus.options.tcp_tune", "clashes with line 4: each key"),
]


@pytest.mark.parametrize("broken", [*WRONG_VALUES, *WRONG_KEYS, *GIVEN_TWICE])
def test_a_wrong_value_or_key_names_its_line_and_what_is_right(broken: Broken) -> None:
    check(broken.old, broken.new, broken.key, (broken.says,))


# --- syntax -----------------------------------------------------------------------------------------------------------

SYNTAX = [
    (
        '"mm"',
        "mm # <--",
        "not TOML at column 8: Invalid value: write text in quotes",
        "\n    unit = mm # <--\n           ^",
    ),
    (
        '"mm"',
        '"mm # <--',
        "not TOML at column 17: Illegal character '\\n'",
        '\n    unit = "mm # <--\n                    ^',
    ),
    ("velocity = ", "velocity # <--", "not TOML at column 10: Expected '='", "\n             ^"),
    ("velocity = 900.0", "velocity: 900.0 # <--", "not TOML at column 9: Expected '='", "\n            ^"),
    ("[axis.limits]", "[axis.limits # <--", "not TOML at column 14: Expected ']'", "\n                 ^"),
    ("900.0", "900.0 1 # <--", "not TOML at column 18: Expected newline", "\n                     ^"),
    ("900.0", "900,0 # <--", "not TOML at column 15: Expected newline", "\n                  ^"),
    ("900.0", "900.0mm # <--", "not TOML at column 17: Expected newline", "\n                    ^"),
    ("900.0", "# <--", "not TOML at column 12: Invalid value", "\n               ^"),
    ('"mm"', "\x00 # <--", "not TOML at column 8: Invalid value", "\n    unit =   # <--\n           ^"),
    ("    2.5,\n]\n", "    2.5,\n[axis.limits] # <--\n", "not TOML at column", "^"),
    ("position = 2.0\n", "position = [ # <--", "not TOML at column", "(the file ends too early)"),
    (
        "position = 2.0\n",
        "position = '''# <--",
        "not TOML at column 20: Expected \"'''\" (the file ends too early)",
        "^",
    ),
    ("900.0", "9" * 5000 + " # <--", "contains a value that cannot be read", "4300"),
    ("900.0", "[" * 5000, "nested too deeply", "three levels"),
]


@pytest.mark.parametrize("old_new_says", SYNTAX, ids=[new[:30] for _, new, *_ in SYNTAX])
def test_what_is_not_toml_is_shown_with_a_caret(old_new_says: tuple[str, ...]) -> None:
    old, new, *says = old_new_says
    check(old, new, "", tuple(says))
