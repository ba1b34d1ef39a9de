"""Faults of the configuration: each has to be refused before the bus is touched, with file, line and key."""

import importlib.resources
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from twostage_servo.app.build import build_parts
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.loader import Config, LoadedConfig, load
from twostage_servo.control.laws.registry import PAPER
from twostage_servo.faults.cell import Cell, NotApplicable
from twostage_servo.faults.frames import compile_profile, protocol_of
from twostage_servo.faults.phase import Phase
from twostage_servo.faults.table import REFUSED, TOLERATED

_MISSING = "stale_feedback_ms"
_STEPS = 40
_WRONG_UNIT = "a wrong unit"


class ConfigurationFaults:
    """Makes a configuration wrong, one way at a time.

    Parameters
    ----------
    path
        The file; None for the embedded one.
    overrides
        ``KEY=VALUE`` arguments that belong to it.
    """

    def __init__(self, path: Path | None, overrides: Sequence[str]) -> None:
        self._path = path
        self._overrides = list(overrides)

    def cells(self) -> Iterator[Cell]:
        """Run them all."""
        loaded = load(self._path, self._overrides)
        for number, name, attempt, key in (
            (47, "an unknown key", self._override("axis.limits.velocty=100"), "velocty"),
            (47, "a missing key", self._without(_MISSING), _MISSING),
            (47, "a value of the wrong type", self._override("axis.limits.velocity=[1]"), "velocity"),
            (47, _WRONG_UNIT, self._override('axis.unit="furlong"'), "unit"),
            (48, "unstable gains", self._ratio(1e6), "performance_index_ratio"),
            (48, "fragile gains", self._fragile(loaded), "performance_index_ratio"),
        ):
            if name == _WRONG_UNIT and self.unit_is_free(loaded):
                continue
            observed, wrong = _try(attempt, key)
            yield Cell(number, name, Phase.IDLE.value, REFUSED, observed, "", 0.0, 0.0, wrong)

    def not_applicable(self) -> Iterator[NotApplicable]:
        """Yield what cannot be wrong with this configuration."""
        if self.unit_is_free(load(self._path, self._overrides)):
            reason = "the DBC gives no unit, or protocol.feedback.position_scale converts it: any unit may be right"
            yield NotApplicable(47, _WRONG_UNIT, Phase.IDLE.value, reason)

    @staticmethod
    def unit_is_free(loaded: LoadedConfig[Config]) -> bool:
        """Whether the axis' unit can't be compared with one of the DBC."""
        profile = compile_profile(loaded)
        return protocol_of(loaded.config).feedback.position_scale != 1.0 or not profile.traits.position_unit

    def _override(self, *overrides: str) -> Callable[[], LoadedConfig[Config]]:
        return lambda: load(self._path, [*self._overrides, *overrides])

    def _ratio(self, ratio: float) -> Callable[[], LoadedConfig[Config]]:
        """Return an attempt with other gains: those of the paper's law, which alone follow from a key."""
        return self._override(f'axis.law.type="{PAPER}"', f"axis.law.performance_index_ratio={ratio!r}")

    def _without(self, key: str) -> Callable[[], LoadedConfig[Config]]:
        def attempt() -> LoadedConfig[Config]:
            if self._path is None:
                text = (importlib.resources.files("twostage_servo_config") / "demo.toml").read_text(encoding="utf-8")
            else:
                text = self._path.read_text(encoding="utf-8")
            lines = [line for line in text.splitlines() if not re.match(rf"\s*{key}\s*=", line)]
            overrides = [override for override in self._overrides if key not in override]
            with tempfile.TemporaryDirectory(prefix="twostage-servo-") as folder:
                path = Path(folder) / "incomplete.toml"
                path.write_text("\n".join(lines), encoding="utf-8")
                return load(path, overrides)

        return attempt

    def _fragile(self, loaded: LoadedConfig[Config]) -> Callable[[], LoadedConfig[Config]]:
        """Look for the largest Q/R that is not refused as unstable: just below, the loop is fragile."""
        low = loaded.config.axis.law.paper.performance_index_ratio
        high = 1e6
        for _ in range(_STEPS):
            middle = (low * high) ** 0.5
            if "unstable" in _refusal(self._ratio(middle)):
                high = middle
            else:
                low = middle
        return self._ratio(low)


def _refusal(attempt: Callable[[], LoadedConfig[Config]]) -> str:
    """Return the text with which a configuration is refused, or nothing."""
    try:
        build_parts(attempt())
    except ConfigError as error:
        return str(error)
    return ""


def _try(attempt: Callable[[], LoadedConfig[Config]], key: str) -> tuple[str, str]:
    text = _refusal(attempt)
    if not text:
        return TOLERATED, "it was taken"
    return REFUSED, "" if key in text else f"the error does not name {key}: {text}"
