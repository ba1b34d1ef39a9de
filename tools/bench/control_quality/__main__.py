"""How well the project's laws and the baselines move axes that are off their model.

``python -m tools.bench.control_quality [--quick] [--json]`` runs the suite on 1000 plants a noise level, 50 with
``--quick``. Progress goes to stderr, and the result to stdout: tables, or one JSON object. The baselines run with the
values that ``python -m tools.bench.control_quality.tuning`` has found. ``--docs`` writes the tables and pictures of the
docs as well, with further scenarios.
"""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from tools.bench.control_quality import contestants, report
from tools.bench.control_quality.axes import measure_axes
from tools.bench.control_quality.measure import (
    FIRST_SEED,
    Measured,
    measure,
    measure_scenarios,
    result_of,
    write_outcomes,
)

_PLANTS: Final = 1000
_QUICK_PLANTS: Final = 50
_FURTHER_SHARE: Final = 4
"""Of the plants, one in so many for each further scenario."""
_FRAMES_SAMPLE: Final = 100
_PAGE: Final = Path(__file__).parents[3] / "docs" / "control-quality.md"


def main() -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{_QUICK_PLANTS} plants a noise level: under a minute")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--law", metavar="NAME", action="append", help="this law only; may be repeated")
    parser.add_argument("--plants", type=int, metavar="N", help="so many plants a noise level")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the first plant (default %(default)s)")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one a core)")
    parser.add_argument("--outcomes", type=Path, metavar="FILE.csv", help="write every move, with its seed")
    parser.add_argument("--docs", action="store_true", help="write tables and pictures of docs/control-quality.md")
    options = parser.parse_args()
    known = [*contestants.project_laws(), *contestants.baselines()]
    for name, package in contestants.missing().items():
        print(f"without {name}: install {package}: pip install 'twostage-servo[bench]'", file=sys.stderr)
    laws = options.law or known
    if unknown := sorted(set(laws) - set(known)):
        parser.error(f"no law is called {', '.join(unknown)}; there are: {', '.join(known)}")
    plants = options.plants or (_QUICK_PLANTS if options.quick else _PLANTS)
    measured = measure(laws, plants, options.seed, workers=options.workers)
    result = result_of(measured)
    print(json.dumps(result, indent=1) if options.json else report.text(measured))
    if options.outcomes is not None:
        write_outcomes(measured, options.outcomes)
    if options.docs:
        _write_docs(result, measured, options.workers)
    return 0


def _write_docs(result: Mapping[str, Any], measured: Measured, workers: int | None) -> None:
    """Run what the docs show beside the suite, and write page and pictures."""
    from tools.bench.control_quality import over_frames, pictures  # noqa: PLC0415 - the service takes a second to load

    laws = list(result["laws"])
    ours = [law for law in contestants.project_laws() if law in laws]
    part = max(1, measured.plants // _FURTHER_SHARE)
    further = report.Further(
        measure_scenarios(laws, part, measured.first_seed, workers=workers),
        measure_axes(ours, workers=workers),
        over_frames.measure_frames(ours, min(part, _FRAMES_SAMPLE), workers=workers),
    )
    report.write_docs(measured, further, _PAGE)
    for path in (_PAGE, *pictures.draw_all(result, _PAGE.parent / "pictures")):
        print(f"{path} written", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
