"""How well the project's laws and the baselines move axes that are off their model.

``python -m tools.bench.control_quality [--quick] [--json]`` runs the suite on 1000 plants a noise level, 100 with
``--quick``. Progress goes to stderr, and the result to stdout: tables, or one JSON object. The baselines run with the
values that ``python -m tools.bench.control_quality.tuning`` has found.
"""

import argparse
import json
import sys
from typing import Final

from tools.bench.control_quality import contestants, report
from tools.bench.control_quality.measure import FIRST_SEED, measure, result_of

_PLANTS: Final = 1000
_QUICK_PLANTS: Final = 100


def main() -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{_QUICK_PLANTS} plants a noise level: under a minute")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--law", metavar="NAME", action="append", help="this law only; may be repeated")
    parser.add_argument("--plants", type=int, metavar="N", help="so many plants a noise level")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the first plant (default %(default)s)")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one a core)")
    options = parser.parse_args()
    known = [*contestants.project_laws(), *contestants.baselines()]
    for name, package in contestants.missing().items():
        print(f"without {name}: install {package}: pip install 'twostage-servo[bench]'", file=sys.stderr)
    laws = options.law or known
    if unknown := sorted(set(laws) - set(known)):
        parser.error(f"no law is called {', '.join(unknown)}; there are: {', '.join(known)}")
    plants = options.plants or (_QUICK_PLANTS if options.quick else _PLANTS)
    result = result_of(measure(laws, plants, options.seed, workers=options.workers))
    print(json.dumps(result, indent=1) if options.json else report.text(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
