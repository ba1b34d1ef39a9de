"""The table ``[axis.law]``: which law drives an axis, with a table for the keys of each that is installed."""

import contextlib
import functools
from collections.abc import Mapping
from typing import Any, Literal, Self

from pydantic import Field, ValidationError, create_model, field_validator, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import InitErrorDetails, PydanticCustomError

from twostage_servo.control.laws.paper_type import PaperSettings
from twostage_servo.control.laws.registry import LAWS, PAPER, LawType
from twostage_servo.plug_ins import UnknownPlugInError
from twostage_servo.settings.base import Settings, quantity


class LawSettings(Settings):
    """Which law drives the axis, with a table for the keys of each."""

    type: str = Field(
        PAPER, description="Name of the law; its keys are in the table axis.law.<type>", min_length=1, max_length=64
    )
    memory: Literal["none", "moves", "file"] = Field(
        "moves",
        description="How long what the law has learned of its plant is kept: for one move, while the service runs, or "
        "in a file in the folder of the trip files",
    )
    jerk: float | None = quantity(
        None,
        unit="axis unit/s³",
        description="Smoothing of the reference: by how much its acceleration changes at most in a second; none if "
        "absent. Quick stops and stops after a trip are not smoothed, and the law `paper` cannot be",
        gt=0.0,
        le=1e15,
    )
    performance_index_ratio: float | None = quantity(
        None, unit="1", description="Former place of axis.law.paper.performance_index_ratio", ge=1e-12, le=1e6
    )
    paper: PaperSettings = Field(PaperSettings(), description="The two-stage law of the paper")

    @property
    def unnamed(self) -> str:
        """What is to be told of a table that names no type; empty where it does.

        No machine moves otherwise after an upgrade, unless it is asked to.
        """
        if "type" in self.model_fields_set:
            return ""
        return (
            f'is not set, so the axis keeps the law "{self.type}"; type = "adaptive" settles sooner and overshoots '
            f'less (docs/adaptive-law.md), and type = "{self.type}" ends this note'
        )

    @field_validator("type")
    @classmethod
    def _installed(cls, name: str) -> str:
        if name not in _tables(cls.model_fields):
            try:
                LAWS.get(name)
            except UnknownPlugInError as error:
                raise ValueError(str(error)) from None
            raise ValueError(f"{name!r} is not the name of a law")
        return name

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        """Read Q/R from the one place where it is set."""
        ratio = self.performance_index_ratio
        if ratio is None:
            return self
        if "performance_index_ratio" in self.paper.model_fields_set:
            text = "is set in axis.law and in axis.law.paper: remove one of the two"
            twice = PydanticCustomError("value_error", "twice", {"error": text})
            keys = ("performance_index_ratio",), ("paper", "performance_index_ratio")
            raise ValidationError.from_exception_data(
                "LawSettings", [InitErrorDetails(type=twice, loc=key, input=ratio) for key in keys]
            )
        # Read as if it stood there, and not as one that does: an instance may be checked again.
        there = PaperSettings.model_construct(_fields_set=set(), performance_index_ratio=ratio)
        object.__setattr__(self, "paper", there)
        return self

    @classmethod
    def all_fields(cls) -> Mapping[str, FieldInfo]:
        """Return the keys, and the table of each law that is installed."""
        fields = dict(cls.model_fields)
        for name in LAWS.names():
            with contextlib.suppress(UnknownPlugInError):  # a package that is broken has no keys
                fields.setdefault(name, _table_of(LAWS.get(name)))
        return fields

    def __reduce__(self) -> tuple[Any, ...]:
        """Pack the settings so that another process can unpack them: it has no class of these tables yet."""
        tables = tuple(name for name in type(self).model_fields if name not in LawSettings.model_fields)
        return _unpacked, (tables, self.__getstate__())

    @property
    def keys(self) -> Settings:
        """The keys of the law that drives the axis."""
        table: Settings = getattr(self, self.type)
        return table

    @property
    def place_of_ratio(self) -> tuple[str, ...]:
        """Where Q/R stands, below ``axis.law``."""
        return (
            ("performance_index_ratio",)
            if self.performance_index_ratio is not None
            else (PAPER, "performance_index_ratio")
        )


def _tables(fields: Mapping[str, FieldInfo]) -> list[str]:
    """Return the names of those fields that are tables: the laws."""
    return [name for name, field in fields.items() if isinstance(field.annotation, type(Settings))]


def _table_of(law: LawType) -> FieldInfo:
    return FieldInfo(annotation=law.settings, default=law.settings(), description="Another law")


@functools.cache
def _with_tables(names: tuple[str, ...]) -> type[LawSettings]:
    """Return the settings of a law with a table for each of these laws, as far as they are installed."""
    tables: dict[str, Any] = {}
    for name in names:
        with contextlib.suppress(UnknownPlugInError):
            law = LAWS.get(name)
            tables[name] = (law.settings, law.settings())
    return create_model("LawSettings", __base__=LawSettings, **tables) if tables else LawSettings


def _unpacked(tables: tuple[str, ...], state: dict[str, Any]) -> LawSettings:
    """Return the settings that were packed, of a law with these tables."""
    kind = _with_tables(tables)
    settings = kind.__new__(kind)
    settings.__setstate__(state)
    return settings


def choose_law(value: object) -> object:
    """Read ``[axis.law]`` with the tables of those laws that it names; only then are the installed ones looked for."""
    if not isinstance(value, dict):
        return value
    known = LawSettings.model_fields
    names = [name for name, table in value.items() if isinstance(table, dict) and name not in known]
    chosen = value.get("type")
    if isinstance(chosen, str) and chosen not in {*known, *names}:
        names.append(chosen)
    return _with_tables(tuple(names)).model_validate(value) if names else value
