"""What a run came to, and the reasons of what the tests do not notice."""

import tomllib
from collections.abc import Collection
from pathlib import Path
from typing import Any

from tools.mutation.mutant import Mutant
from tools.mutation.results import in_order, with_status


def reasons() -> dict[str, str]:
    """Return the reason of each mutant in `survivors.toml`, by key."""
    groups = tomllib.loads((Path(__file__).with_name("survivors.toml")).read_text(encoding="utf-8")).get("group", [])
    return {key: group["reason"] for group in groups for key in group["mutants"]}


def as_far_as_tried(every: list[Mutant], explained: Collection[str], seed: int) -> list[Mutant]:
    """Return mutants; one with a reason is open if it comes after the last that was tried, where others are open.

    Those with a reason are not tried. Without this all of them would count, as not found, in a run that ended early and
    tried only a part of the others: its score would be too small.
    """
    if all(mutant.status != "open" for mutant in every):
        return every
    places = {key: place for place, key in enumerate(in_order([mutant.key for mutant in every], seed))}
    tried = [mutant for mutant in every if mutant.status != "open" and mutant.key not in explained]
    last = max((places[mutant.key] for mutant in tried), default=-1)
    return [
        with_status(mutant, "open") if mutant.key in explained and places[mutant.key] > last else mutant
        for mutant in every
    ]


def summarise(every: list[Mutant], explained: dict[str, str], tried: list[str], seconds: float) -> dict[str, Any]:
    """Return counts per module, the score, the survivors, and which of the reasons that were tried can go."""
    mutants = [mutant for mutant in every if mutant.status != "open"]
    modules: dict[str, dict[str, int]] = {}
    for mutant in mutants:
        counts = modules.setdefault(mutant.path, {"mutants": 0, "killed": 0, "timeout": 0, "survived": 0})
        counts["mutants"] += 1
        counts[mutant.status] += 1
    survivors = [mutant for mutant in mutants if mutant.status == "survived"]
    found = len(mutants) - len(survivors)
    places = {mutant.place for mutant in mutants}
    left = {mutant.key for mutant in every if mutant.status in {"survived", "open"}}
    return {
        "modules": modules,
        "mutants": len(mutants),
        "open": len(every) - len(mutants),
        "found": found,
        "score": found / len(mutants) if mutants else 1.0,
        "seconds": round(seconds, 1),
        "survivors": [{"key": mutant.key, "reason": explained.get(mutant.key)} for mutant in survivors],
        "reasons_without_mutant": [key for key in tried if key.split(":")[0] in places and key not in left],
    }


def as_text(summary: dict[str, Any]) -> str:
    """Lay the summary out to be read."""
    lines = [f"{'module':48}{'mutants':>8}{'killed':>8}{'timeout':>8}{'survived':>9}{'found':>8}"]
    for path, counts in summary["modules"].items():
        share = 1.0 - counts["survived"] / counts["mutants"]
        numbers = f"{counts['mutants']:8}{counts['killed']:8}{counts['timeout']:8}{counts['survived']:9}{share:8.1%}"
        lines.append(f"{path:48}{numbers}")
    total = f"{summary['found']} of {summary['mutants']} found: {summary['score']:.1%}"
    left = f"; {summary['open']} were not tried any more" if summary["open"] else ""
    lines.append(f"{total}, in {summary['seconds']:.0f} s{left}")
    lines += [
        f"\nsurvived: {survivor['key']}\n  {survivor['reason'] or 'NO REASON in survivors.toml'}"
        for survivor in summary["survivors"]
    ]
    lines += [f"\nno longer needed in survivors.toml: {key}" for key in summary["reasons_without_mutant"]]
    return "\n".join(lines)
