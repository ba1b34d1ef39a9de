"""Makes configurations at random: shipped ones with some keys set, and with their text or their DBC damaged."""

import importlib.resources
import random
import types
import typing
from functools import cache
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from twostage_servo.config.loader import Config

_WORDS = (
    "true", "false", '""', '"x"', "'it''s'", '"\\u0000"', '"\\ud800"', '"é漢😀"', "[]", "{}", "[1, 2]", "[[]]",
    "{ a = 1 }", "1979-05-27", "07:32:00", "1979-05-27T07:32:00Z", "nan", "+nan", "-nan", "inf", "-inf", "1e308",
    "-1e308", "1e400", "-1e400", "1e-320", "0", "-0.0", "0.0", "-1", "1", "1e9", "1e-12", "5e-324",
    "9223372036854775807", "9223372036854775808", "0x7fffffff", "0b1", "1_000", "1__0", "01", "1.", ".5", "+", "10.0",
    '"10.0"', '"' + "a" * 2000 + '"', "9" * 5000, "[" * 150 + "]" * 150, "yes", "'''", '"""', '"/nowhere/at.all"',
    '"."', '"\\n"', '"\\uFFFF"', "1e5", "3", "100", "0.001", "250", "1e6", "1e12",
)  # fmt: skip


@cache
def shipped() -> tuple[tuple[str, str], ...]:
    """Return name and text of each shipped configuration."""
    folder = importlib.resources.files("twostage_servo_config")
    names = sorted(entry.name for entry in folder.iterdir() if entry.name.endswith(".toml"))
    return tuple((name, (folder / name).read_text(encoding="utf-8")) for name in names)


@cache
def shipped_dbc() -> str:
    """Return the shipped DBC."""
    return (importlib.resources.files("twostage_servo_config") / "servo_drive.dbc").read_text(encoding="cp1252")


@cache
def all_keys() -> tuple[tuple[str, str, FieldInfo], ...]:
    """Return table, key and declaration of every setting that there is."""
    return tuple(_keys_of(Config, ""))


def _keys_of(model: type[BaseModel], table: str) -> "typing.Iterator[tuple[str, str, FieldInfo]]":
    for name, field in model.model_fields.items():
        annotation = field.annotation
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield from _keys_of(annotation, f"{table}.{name}".lstrip("."))
        else:
            yield table, name, field


class ConfigMaker:
    """Makes configurations.

    Parameters
    ----------
    rng
        Decides.
    """

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng

    def config(self) -> tuple[bytes, bytes | None]:
        """Return a file, and the DBC beside it that it may name."""
        rng = self._rng
        _, text = rng.choice(shipped())
        kind = rng.random()
        if kind < 0.04:
            return rng.randbytes(rng.randrange(300)), None
        if kind < 0.16:
            text, dbc = self._with_dbc(text)
            return text.encode(), dbc
        plausible = kind < 0.5
        lines = text.split("\n")
        for _ in range(rng.choice((1, 1, 1, 2, 3, 6)) if plausible else 1 + rng.getrandbits(3)):
            self._set_plausible(lines) if plausible else self._break(lines)
        data = "\n".join(lines).encode("utf-8", "surrogatepass")
        return (data if plausible or rng.random() < 0.7 else self._damage(data)), None

    def _set_plausible(self, lines: list[str]) -> None:
        """Give a key that there is a value of its type, within or about its bounds."""
        rng = self._rng
        table, key, field = rng.choice(all_keys())
        _set(lines, table, key, _plausible(rng, field))

    def _break(self, lines: list[str]) -> None:
        rng = self._rng
        lines += [] if lines else [""]
        action, at = rng.randrange(11), rng.randrange(len(lines))
        assigned = [index for index, line in enumerate(lines) if "=" in line.partition("#")[0]] or [at]
        headers = [index for index, line in enumerate(lines) if line.startswith("[")] or [at]
        target = rng.choice(assigned)
        key = lines[target].partition("=")[0].strip() or "x"
        if action < 3:
            lines[target] = f"{key} = {rng.choice(_WORDS)}"
        elif action == 3:
            table, key, _ = rng.choice(all_keys())
            _set(lines, table, key, rng.choice(_WORDS))
        elif action == 4:
            del lines[target]
        elif action == 5:
            lines.insert(at, rng.choice((lines[rng.choice(assigned)], lines[rng.choice(headers)])))
        elif action == 6:
            lines[target] = lines[target].replace(
                key, rng.choice((key + "x", key[1:], key.upper(), "", "é", f"'{key}'", f"{key}.a"))
            )
        elif action == 7:
            header = rng.choice(headers)
            lines[header] = rng.choice(
                ("[x]", "[[axis]]", "[axis.limits.x]", "[", "[]", "[axis", lines[header] * 2, f"[{lines[header]}]")
            )
        elif action == 8:
            del lines[at:]
            lines.append("")
        elif action == 9:
            lines.insert(
                at,
                rng.choice(
                    (f"x = {rng.choice(_WORDS)}", "axis = 1", "[bus]", "=", "a.b.c = 1", "\0", "\ufeff", "# \x07")
                ),
            )
        else:
            rng.shuffle(lines)

    def _damage(self, data: bytes) -> bytes:
        rng = self._rng
        damaged = bytearray(data)
        for _ in range(1 + rng.getrandbits(3)):
            if not damaged:
                break
            at = rng.randrange(len(damaged))
            action = rng.randrange(5)
            if action == 0:
                damaged[at] = rng.getrandbits(8)
            elif action == 1:
                del damaged[at:]
            elif action == 2:
                del damaged[at : at + rng.randrange(40)]
            elif action == 3:
                damaged[at:at] = rng.randbytes(rng.randrange(8))
            else:
                damaged[at:at] = damaged[at : at + rng.randrange(200)]
        return bytes(damaged)

    def _with_dbc(self, text: str) -> tuple[str, bytes]:
        """Let the file name a DBC that is damaged."""
        rng = self._rng
        lines = text.split("\n")
        _set(lines, "protocol", "dbc", '"drive.dbc"')
        dbc = shipped_dbc().split("\n")
        for _ in range(1 + rng.getrandbits(2)):
            at = rng.choice([index for index, line in enumerate(dbc) if "SG_" in line or "BO_" in line] or [0])
            words = dbc[at].split(" ")
            action = rng.randrange(7)
            if action == 0:
                del dbc[at]
            elif action == 1:
                dbc.insert(at, dbc[at])
            elif action == 2:
                dbc[at] = "".join(
                    character if not character.isdigit() or rng.random() < 0.7 else rng.choice("0123456789")
                    for character in dbc[at]
                )
            elif action == 3:
                words[rng.randrange(len(words))] = rng.choice(
                    (
                        "(0,0)",
                        "(1e400,0)",
                        "[nan|nan]",
                        "[0|0]",
                        "[5|1]",
                        "-",
                        "0|64@1-",
                        "7|64@0+",
                        "32|33@1+",
                        "m0",
                        "M",
                        "1e308",
                        "",
                    )
                )
                dbc[at] = " ".join(words)
            elif action == 4:
                return "\n".join(lines), self._damage("\n".join(dbc).encode("cp1252", "replace"))
            elif action == 5:
                del dbc[at:]
                dbc.append("")
            else:
                message, name = rng.choice((385, 513, 641)), rng.choice(("Position", "Effort", "x"))
                dbc.append(f"SIG_VALTYPE_ {message} {name} : {rng.randrange(4)};")
        return "\n".join(lines), "\n".join(dbc).encode("cp1252", "replace")


def _set(lines: list[str], table: str, key: str, value: str) -> None:
    """Set a key in its table, whether or not they are there."""
    header = f"[{table}]"
    start = next((index for index, line in enumerate(lines) if line.startswith(header)), None)
    if start is None:
        lines += [header, f"{key} = {value}"]
        return
    end = next((index for index in range(start + 1, len(lines)) if lines[index].startswith("[")), len(lines))
    for index in range(start + 1, end):
        if lines[index].partition("=")[0].strip() == key:
            lines[index] = f"{key} = {value}"
            return
    lines.insert(start + 1, f"{key} = {value}")


def _plausible(rng: random.Random, field: FieldInfo) -> str:
    annotation = field.annotation
    choices = _literals(annotation)
    if choices and rng.random() < 0.9:
        choice = rng.choice(choices)
        return str(choice).lower() if isinstance(choice, bool) else f'"{choice}"'
    if annotation is bool:
        return rng.choice(("true", "false"))
    bounds = {
        name: getattr(bound, name)
        for bound in field.metadata
        for name in ("gt", "ge", "lt", "le")
        if hasattr(bound, name)
    }
    low, high = bounds.get("ge", bounds.get("gt", -1e9)), bounds.get("le", bounds.get("lt", 1e9))
    if not any(kind in typing.get_args(annotation) or annotation is kind for kind in (int, float)):
        return rng.choice(('"x"', '"mm"', '"virtual"', '"Position"', '"Enable"', '""'))
    default = field.default if isinstance(field.default, (int, float)) else 100.0
    ends = (low, high, low + 1e-9, default, default * 2.0, default / 3.0, -default)
    spread = max(low, min(high, 10.0 ** rng.uniform(-12.0, 12.0)))
    value = rng.choice((*ends, spread, spread, spread, rng.uniform(low, high)))
    return str(int(value)) if annotation is int or (value == int(value) and rng.random() < 0.2) else repr(float(value))


def _literals(annotation: Any) -> tuple[Any, ...]:
    origin = typing.get_origin(annotation)
    if origin is typing.Literal:
        return typing.get_args(annotation)
    if origin in {typing.Union, types.UnionType}:
        return tuple(choice for member in typing.get_args(annotation) for choice in _literals(member))
    return ()
