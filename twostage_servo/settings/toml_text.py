"""Keys and values in TOML notation, for whoever has to be told of them."""

import json
from collections.abc import Sequence
from typing import Any, Final

_LONGEST_VALUE: Final = 80


def key_text(path: Sequence[str | int]) -> str:
    """Write a path as a dotted TOML key, list entries as ``[0]``."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            bare = part.replace("-", "_").replace("_", "a").isalnum() and part.isascii()
            text += ("." if text else "") + (part if bare else json.dumps(part, ensure_ascii=False))
    return text


def value_text(value: object) -> str:
    """Write a value in TOML notation on one line, shortened where it is long."""
    text = _value_text(value, depth=0)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."


def _value_text(value: object, depth: int) -> str:
    if isinstance(value, list | tuple | dict):
        return "..." if depth == 3 else _container_text(value, depth + 1)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value[:_LONGEST_VALUE], ensure_ascii=not value.isprintable())
    if isinstance(value, int) and value.bit_length() > 256:  # Python refuses to write thousands of decimal digits
        return hex(value)
    return "not set" if value is None else str(value)


def _container_text(value: list[Any] | tuple[Any, ...] | dict[str, Any], depth: int) -> str:
    if isinstance(value, dict):
        return (
            "{" + ", ".join(f"{key_text((key,))} = {_value_text(entry, depth)}" for key, entry in value.items()) + "}"
        )
    return "[" + ", ".join(_value_text(entry, depth) for entry in value[:_LONGEST_VALUE]) + "]"
