"""Random and mutated configurations: each is either loaded and runs, or refused with file and key or line."""

import asyncio
import random
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

from tools.fuzz.bench import Bench
from tools.fuzz.config_maker import ConfigMaker
from tools.fuzz.drives import Drive
from tools.fuzz.outcome import Failed, Outcome
from tools.fuzz.reproducible import reproducible
from twostage_servo.app.build import build_parts
from twostage_servo.axis.state import State
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.loader import Config, LoadedConfig, load

PER_EPISODE = 25
"""Configurations of one episode."""

SLOW_S = 5.0
"""Time at which a configuration counts as one that hangs."""

_WHOLE_FILE = (
    "there are no settings in this file",
    "is larger than",
    "nested too deeply",
    " more; check that this is a configuration",
)
"""What is said of a whole file, where there is no key or line to name."""

KNOWN: tuple[str, ...] = ()
"""What is known to be said without key or line, although there is one; to be emptied as that is put right."""

_TICKS = 60


def try_config(data: bytes, dbc: bytes | None, folder: Path, rng: random.Random) -> str:
    """Load a configuration and build its service; let it run for a while if it can be built.

    Returns
    -------
    str
        ``refused``, ``refused_by_service``, ``ran`` or ``tripped``.

    Raises
    ------
    Failed
        If it is refused without file and key or line, takes too long, or does not run as it has to.
    """
    path = folder / "fuzz.toml"
    path.write_bytes(data)
    if dbc is not None:
        (folder / "drive.dbc").write_bytes(dbc)
    begun = time.perf_counter()
    stage = "refused"
    try:
        loaded = load(path)
        stage = "refused_by_service"
        build_parts(loaded)
    except ConfigError as error:
        check_problems(error, str(path))
        return stage
    finally:
        took_s = time.perf_counter() - begun
        if took_s > SLOW_S:
            raise Failed(f"it took {took_s:.1f} s to load")
    return ride(loaded, rng)


def check_problems(error: ConfigError, source: str) -> None:
    """Check that every problem names its file, and key or line, in a text that can be printed."""
    if not error.problems:
        raise Failed("a ConfigError without a problem")
    for problem in error.problems:
        text = str(problem)
        text.encode("utf-8")
        if not text.startswith(source):
            raise Failed(f"does not name its file: {text[:300]!r}")
        if not problem.message.strip():
            raise Failed(f"says nothing: {text[:300]!r}")
        if (
            problem.line is None
            and not problem.key
            and not any(words in problem.message for words in _WHOLE_FILE + KNOWN)
        ):
            raise Failed(f"names neither key nor line: {text[:300]!r}")


class _Given(Drive):
    """A drive of a configuration that is loaded already."""

    def __init__(self, loaded: LoadedConfig[Config]) -> None:
        super().__init__("given", ())
        self.loaded = loaded


def ride(loaded: LoadedConfig[Config], rng: random.Random) -> str:
    """Let an axis of this configuration be armed and moved on the bench; return ``ran`` or ``tripped``."""
    bench = Bench(_Given(loaded), rng)
    axis, limits = bench.axis_loop.axis, loaded.config.axis.limits
    ticks = 0

    async def prepare() -> None:
        nonlocal ticks
        ticks += 1
        bench.answer_as_drive()
        if ticks == _TICKS:
            bench.service.shut_down()
        elif ticks < _TICKS and axis.state is State.DISARMED:
            bench.ask(op="arm")
        elif ticks < _TICKS and axis.state is State.HOLDING:
            bench.ask(op="move", position=rng.uniform(limits.position_minimum, limits.position_maximum))
        elif ticks > 100_000:
            raise Failed("the service does not end")
        if ticks % 1000 == 0:
            await asyncio.sleep(0)

    bench.run(prepare)
    return "tripped" if bench.trips else "ran"


def run_episode(seed: int, episode: int, configs: int) -> Outcome:
    """Try some configurations; raises whatever goes wrong.

    Parameters
    ----------
    seed, episode
        Decide on everything.
    configs
        How many to try.
    """
    rng = reproducible("tomls", seed, episode)
    maker = ConfigMaker(rng)
    became: Counter[str] = Counter()
    findings = []
    with tempfile.TemporaryDirectory(prefix="fuzz") as name, warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for number in range(configs):
            data, dbc = maker.config()
            try:
                became[try_config(data, dbc, Path(name), reproducible("ride", seed, episode, number))] += 1
            except Exception as error:  # noqa: BLE001 - each is a finding, and the rest is tried as well
                findings.append(_finding(number, data, dbc, error))
    became["warnings"] = len(warned)
    findings += [f"warning: {one.category.__name__}: {one.message} ({one.filename}:{one.lineno})" for one in warned]
    return Outcome(configs, dict(became), findings)


def _finding(number: int, data: bytes, dbc: bytes | None, error: Exception) -> str:
    where = error.__traceback__
    while where is not None and where.tb_next is not None:
        where = where.tb_next
    place = "" if where is None else f" ({Path(where.tb_frame.f_code.co_filename).name}:{where.tb_lineno})"
    beside = "" if dbc is None else f"\n--- drive.dbc ---\n{dbc.decode('cp1252', 'backslashreplace')}"
    text = data.decode("utf-8", "backslashreplace")
    return f"{type(error).__name__}: {error}{place}\n--- config {number} ---\n{text}{beside}"
