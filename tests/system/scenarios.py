"""What must hold on a real bus, under a real systemd.

``python -m tools.rig.run --timeout 600 -- PYTHON -m tests.system.scenarios``

PYTHON is one of a virtual environment that the system's Python has made and that has this package installed, not
editable: the service runs as a user of its own. One boot, one service with axis x on can0 and axis y on vcan0 (CAN FD),
each with its simulated drive as a process of its own. The scenarios follow each other: each leaves both axes disarmed.
Prints a line a scenario, with its figures; `--json` prints them as one object. Exit code 1 if one fails.
"""

import argparse
import contextlib
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from tests.system.checks import Figures, restore
from tests.system.on_the_bus import (
    board_removed,
    bus_blocked,
    error_frames,
    filters_in_the_kernel,
    interface_down,
    moves_by_the_command_line,
    queue_full_of_others,
    starts_without_its_buses,
)  # fmt: skip
from tests.system.under_systemd import (
    has_its_rights_and_no_more,
    is_killed_by_the_watchdog,
    is_restarted_after_a_kill,
    leaves_no_file,
    obeys_the_group_alone,
    stops_as_it_should,
)  # fmt: skip
from tools.rig.bench import Bench

SCENARIOS: Final[tuple[Callable[[Bench], Figures], ...]] = (
    starts_without_its_buses, has_its_rights_and_no_more, obeys_the_group_alone, moves_by_the_command_line,
    filters_in_the_kernel, interface_down, board_removed, bus_blocked, queue_full_of_others, error_frames,
    is_restarted_after_a_kill, is_killed_by_the_watchdog, stops_as_it_should, leaves_no_file,
)  # fmt: skip

_FILL_THE_BUS: Final = frozenset({bus_blocked, queue_full_of_others})
"""Those in which losing commands is what has to happen."""


def go_through(scenario: Callable[[Bench], Figures], bench: Bench) -> Figures:
    """Go through one; return its figures, or why it ``failed``.

    An emulated bus stalls when the host is kept from its processors, and an axis that loses two commands by it trips
    before what the scenario does to it. A scenario that fails after such a trip, and does not itself fill the bus, is
    begun anew, once; its figures tell of it as ``stalled``. Whatever else fails has failed.
    """
    told: Figures = {}
    while True:
        stalls = _stalls(bench)
        try:
            return told | scenario(bench)
        except Exception as error:  # noqa: BLE001 - whatever it is, the others are worth seeing
            text = f"{type(error).__name__}: {error}"
        has_stalled = scenario not in _FILL_THE_BUS and _stalls(bench) > stalls
        restore(bench)
        if told or not has_stalled:
            return told | {"failed": text}
        told = {"stalled": text}


def _stalls(bench: Bench) -> int:
    return sum(entry.get("CODE") == "commands_dropped" for entry in bench.journal())


def main() -> int:
    """Run all, one after another; also behind one that failed, as far as what it leaves can be mended."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    names = [scenario.__name__ for scenario in SCENARIOS]
    parser.add_argument("--only", nargs="+", choices=names, default=names, help="the first one starts the service")
    options = parser.parse_args()
    if not Path(sys.executable).with_name("twostage-servo").exists():
        parser.error(f"{sys.executable} is not that of an environment that has the package")
    results: dict[str, Figures] = {}
    failed: list[str] = []
    with (
        tempfile.TemporaryDirectory(prefix="rig-scenarios-") as folder,
        contextlib.closing(Bench(Path(folder))) as bench,
    ):
        bench.install()
        for scenario in (one for one in SCENARIOS if one.__name__ in options.only):
            begun = time.monotonic()
            figures = go_through(scenario, bench)
            if "failed" in figures:
                failed.append(scenario.__name__)
            results[scenario.__name__] = figures | {"seconds": round(time.monotonic() - begun, 1)}
            if not options.json:
                word = "FAILED" if "failed" in figures else "ok"
                print(word, scenario.__name__, json.dumps(results[scenario.__name__]), flush=True)
        for name in ("service", "drives") if failed else ():
            print(f"--- {name}\n{bench.log(name)[-6000:]}", file=sys.stderr)
    if options.json:
        print(json.dumps({"failed": failed, "scenarios": results}))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
