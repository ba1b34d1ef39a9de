"""What all settings have in common: unknown keys are refused, and each number has a unit, bounds and a line of text."""

import sys
from collections.abc import Mapping
from operator import attrgetter
from types import MappingProxyType
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo


class Settings(BaseModel):
    """Base of all configuration tables: immutable, strict in types, closed to unknown keys, NaN and infinity.

    Attributes
    ----------
    renamed
        Former names of keys of this table, each with its present one: files may have them until 1.0.
    """

    renamed: ClassVar[Mapping[str, str]] = MappingProxyType({})

    # A validator is built where it is first used. Most tables are only read as a part of the whole configuration, whose
    # validator contains theirs: building each table's own as well takes 9 ms of every start.
    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        validate_default=True,
        hide_input_in_errors=False,
        defer_build=True,
    )

    @classmethod
    def all_fields(cls) -> Mapping[str, FieldInfo]:
        """Return all keys that the table may have; more than its own where others may add to it."""
        return cls.model_fields


def quantity(default: Any = ..., *, unit: str, description: str, **bounds: Any) -> Any:
    """Declare a numeric field.

    Parameters
    ----------
    default
        Value when the key is absent; ``...`` makes the key required.
    unit
        Unit of the number; ``axis unit`` stands for the unit that the config names in ``axis.unit``, ``1`` for none.
    description
        One line for the operator: what the number does.
    bounds
        ``gt``, ``ge``, ``lt``, ``le`` as in :func:`pydantic.Field`.

    Returns
    -------
    Any
        A pydantic field whose JSON schema carries the unit.
    """
    return Field(default, description=description, json_schema_extra={"unit": unit}, **bounds)


def check_importable(settings: type[Settings]) -> None:
    """Check that another process finds a settings class by its name: settings are sent to one.

    Raises
    ------
    TypeError
        If it does not.
    """
    module = sys.modules.get(settings.__module__)
    try:
        found = attrgetter(settings.__qualname__)(module)
    except AttributeError:
        found = None
    if found is not settings:
        raise TypeError(
            f"settings class {settings.__qualname__} of {settings.__module__} cannot be imported by its name, as "
            "another process has to: define it at the top level of its module"
        )
