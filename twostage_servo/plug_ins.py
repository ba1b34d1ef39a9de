"""What other packages bring by an entry point, found by its name: a law, or a type of drives."""

from importlib import import_module, metadata
from typing import Generic, TypeVar

KindT = TypeVar("KindT")


class UnknownPlugInError(LookupError):
    """Nothing of this name is installed, or it cannot be loaded; the text says so."""


class PlugIns(Generic[KindT]):
    """All of one kind.

    Parameters
    ----------
    kind
        The class of which each is an instance.
    what
        What one is called in a text.
    group
        The group of the entry points.
    built_in
        Name, module and attribute of each that comes with this package. They are known without a search through all
        installed packages, which takes up to 20 ms of a start.
    """

    def __init__(self, kind: type[KindT], what: str, group: str, *built_in: tuple[str, str, str]) -> None:
        self.group = group
        self._kind = kind
        self._what = what
        self._built_in = {name: (module, attribute) for name, module, attribute in built_in}
        self._loaded: dict[str, KindT] = {}

    def names(self) -> list[str]:
        """Return the names of all that are installed."""
        return sorted({*self._built_in, *(point.name for point in self._entry_points())})

    def get(self, name: str) -> KindT:
        """Return the one of a name; only its own module is imported, and once.

        Raises
        ------
        UnknownPlugInError
            If there is none, or its package is broken.
        """
        if name not in self._loaded:
            found = self._load(name)
            if not isinstance(found, self._kind):
                text = f"is a {type(found).__name__}, not a {self._kind.__name__}: correct its package"
                raise UnknownPlugInError(f"the {self._what} {name!r} {text}")
            self._loaded[name] = found
        return self._loaded[name]

    def forget(self) -> None:
        """Look for each anew, as after another package has been installed."""
        self._loaded.clear()

    def _load(self, name: str) -> object:
        if name in self._built_in:
            module, attribute = self._built_in[name]
            return getattr(import_module(module), attribute)
        point = next((point for point in self._entry_points() if point.name == name), None)
        if point is None:
            raise UnknownPlugInError(
                f"no {self._what} is called {name!r}; there are: {', '.join(self.names())}. A package brings one by an "
                f"entry point of the group {self.group}"
            )
        try:
            return point.load()
        except Exception as error:
            raise UnknownPlugInError(
                f"the {self._what} {name!r} cannot be loaded from {point.value}: {error}"
            ) from error

    def _entry_points(self) -> metadata.EntryPoints:
        return metadata.entry_points(group=self.group)
