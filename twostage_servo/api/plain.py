"""Classes that are declared by their fields, as data classes are, and that are made a hundred times sooner.

An operator's command lives for less than 0.1 s. To import ``dataclasses``, and to let it write the methods of forty
classes, would take a fifth of that.
"""

import typing
from typing import Any, ClassVar


@typing.dataclass_transform(kw_only_default=True, frozen_default=True)
class Plain:
    """Base of such a class: each annotation is a field, and what it is set to in the class is its default.

    Objects can't be changed. Two of one class with the same values are equal.
    """

    field_names: ClassVar[tuple[str, ...]] = ()
    """Names of the fields, those of the classes above first."""
    required_names: ClassVar[tuple[str, ...]] = ()
    """Those without a default."""

    _all: ClassVar[frozenset[str]] = frozenset()

    def __init_subclass__(cls) -> None:
        own = [
            name
            for name, hint in cls.__dict__.get("__annotations__", {}).items()  # noqa: RUF063 - inspect is slow to import
            if typing.get_origin(hint) is not ClassVar and name not in cls.field_names
        ]
        cls.field_names = (*cls.field_names, *own)
        cls._all = frozenset(cls.field_names)
        cls.required_names = tuple(name for name in cls.field_names if not hasattr(cls, name))

    def __init__(self, **values: Any) -> None:
        given = self.__dict__
        given.update(values)
        if len(given) != len(self.field_names) or not self._all.issuperset(given):
            self._complete(given)

    def _complete(self, given: dict[str, Any]) -> None:
        """Add the defaults.

        Raises
        ------
        TypeError
            If a field is missing, or there is none of a name.
        """
        unknown = given.keys() - set(self.field_names)
        missing = [name for name in self.required_names if name not in given]
        if unknown or missing:
            raise TypeError(f"{type(self).__name__}: unknown are {sorted(unknown)}, missing are {missing}")
        for name in self.field_names:
            given.setdefault(name, getattr(type(self), name, None))

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"{type(self).__name__} is not changed: {name}")

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and vars(other) == vars(self)

    def __hash__(self) -> int:
        return hash((type(self), *map(repr, vars(self).values())))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in vars(self).items())})"
