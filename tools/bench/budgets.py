"""Holds the figures of a run against ``budgets.toml``."""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

FILE: Final = Path(__file__).with_name("budgets.toml")
_KEYS: Final = frozenset({"name", "figure", "limit", "times", "of", "plus", "bound", "each"})


class BudgetError(Exception):
    """The file of budgets says something that cannot be."""


@dataclass(frozen=True, slots=True)
class Budget:
    """One comparison; its attributes are those of the file, where ``each`` and ``*`` have been written out.

    Attributes
    ----------
    name
        What it guards, in words.
    figure
        Path of the figure in the result.
    at_most
        Whether the figure may not exceed the bound, or may not fall below it.
    factor
        The bound, or by how much the figure at `of` is multiplied.
    of
        Path of the figure to compare with; empty for a plain number.
    plus
        Added to the bound: below it a ratio says nothing, since it is of the size of what the measuring adds.
    """

    name: str
    figure: str
    at_most: bool
    factor: float
    of: str = ""
    plus: float = 0.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """How a comparison ended.

    Attributes
    ----------
    state
        ``"kept"``, ``"broken"``, or ``"not measured"``.
    text
        Both figures, in words; or what is missing.
    """

    budget: Budget
    state: Literal["kept", "broken", "not measured"]
    text: str

    def as_json(self) -> dict[str, Any]:
        """Return the verdict, ready for JSON."""
        return {"name": self.budget.name, "state": self.state, "text": self.text}


def read(kind: Literal["budget", "goal"], result: Mapping[str, Any], file: Path = FILE) -> list[Budget]:
    """Read the budgets or the goals; ``of = "table.*"`` is the best other contender in the result's table.

    Raises
    ------
    BudgetError
        If an entry is not complete, or has a key that nobody knows.
    """
    entries = tomllib.loads(file.read_text(encoding="utf-8")).get(kind, [])
    return [budget for entry in entries for budget in _written_out(entry, result)]


def judge(budget: Budget, result: Mapping[str, Any]) -> Verdict:
    """Compare a figure with its bound."""
    figure, other = look_up(result, budget.figure), look_up(result, budget.of) if budget.of else 1.0
    for path, value in ((budget.figure, figure), (budget.of, other)):
        if value is None:
            return Verdict(budget, "not measured", f"{path} was not measured")
    assert figure is not None  # noqa: S101 - see above; for the type checker
    assert other is not None  # noqa: S101
    bound = budget.factor * other + budget.plus
    kept = figure <= bound if budget.at_most else figure >= bound
    side = "at most" if budget.at_most else "at least"
    plus = f" + {budget.plus:g}" if budget.plus else ""
    against = (
        f"{side} {budget.factor:g} x {budget.of}{plus} = {budget.factor:g} x {other:g}{plus}" if budget.of else side
    )
    return Verdict(
        budget, "kept" if kept else "broken", f"{budget.figure} = {figure:g}, wanted is {against}"
        + (f" = {bound:g}" if budget.of else f" {bound:g}")
    )  # fmt: skip


def look_up(result: Mapping[str, Any], path: str) -> float | None:
    """Return the number at a path such as ``control_step_us.c.p50``; None if there is none."""
    value: Any = result
    for key in path.split("."):
        if not isinstance(value, Mapping) or key not in value:
            return None
        value = value[key]
    return float(value) if isinstance(value, int | float) else None


def _written_out(entry: Mapping[str, Any], result: Mapping[str, Any]) -> Iterator[Budget]:
    name = entry.get("name", "without a name")
    if unknown := set(entry) - _KEYS:
        raise BudgetError(f"{name}: nobody knows {', '.join(sorted(unknown))}")
    if entry.get("limit") not in {"at most", "at least"} or ("bound" in entry) == ("of" in entry):
        raise BudgetError(f"{name}: needs a limit, 'at most' or 'at least', and either 'bound' or 'times' and 'of'")
    try:
        figure, factor = str(entry["figure"]), float(entry["times" if "of" in entry else "bound"])
        plus = float(entry.get("plus", 0.0))
    except (KeyError, ValueError) as error:
        raise BudgetError(f"{name}: {error!r}") from error
    of, at_most = str(entry.get("of", "")), entry["limit"] == "at most"
    for key in entry.get("each", [""]):
        suffix = f".{key}" if key else ""
        other = _best(of.removesuffix(".*"), figure, suffix, result, at_most=at_most) if of.endswith(".*") else of
        yield Budget(name, figure + suffix, at_most, factor, other + suffix if other else "", plus)


def _best(table: str, figure: str, suffix: str, result: Mapping[str, Any], *, at_most: bool) -> str:
    """Return the path of the strictest contender to compare with in a table, other than the one that is compared."""
    others = [path for key in result.get(table, {}) if (path := f"{table}.{key}") != figure]
    choose = min if at_most else max
    return choose(others, key=lambda path: look_up(result, path + suffix) or 0.0, default=f"{table}.others")
