"""What the optimiser may choose, as docs/control-quality.md has it."""

import re
from pathlib import Path

import pytest

from twostage_servo.control.baselines.active_disturbance_rejection import ACTIVE_DISTURBANCE_REJECTION
from twostage_servo.control.baselines.composite_nonlinear import COMPOSITE_NONLINEAR
from twostage_servo.control.baselines.initial_value import INITIAL_VALUE
from twostage_servo.control.baselines.optimal_two_stage import OPTIMAL_TWO_STAGE
from twostage_servo.control.baselines.profile_pid import PROFILE_PID
from twostage_servo.control.baselines.proximate_time_optimal import PROXIMATE_TIME_OPTIMAL
from twostage_servo.control.baselines.trapezoid import TRAPEZOID
from twostage_servo.control.baselines.tunable import TunableLawType

LAWS = {
    "trapezoid": TRAPEZOID,
    "ptos": PROXIMATE_TIME_OPTIMAL,
    "cnf": COMPOSITE_NONLINEAR,
    "initial_value_compensation": INITIAL_VALUE,
    "adrc": ACTIVE_DISTURBANCE_REJECTION,
    "pid": PROFILE_PID,
    "paper_tuned": OPTIMAL_TWO_STAGE,
}
PAGE = Path(__file__).parents[3] / "docs" / "control-quality.md"
ROW = re.compile(r"\| `(\w+)`: (.+) \| (\S+) \| (\S+) \| (\S+) \| (.+) \|")


def documented(law: str) -> dict[str, tuple[float, float, float, str]]:
    text = PAGE.read_text(encoding="utf-8")
    section = text[text.index("### What the optimiser may choose") : text.index("## Results")]
    return {
        name: (float(low), float(start), float(high), meaning)
        for name, meaning, low, start, high, laws in ROW.findall(section)
        if f"`{law}`" in laws.split(", ")
    }


def ranges(law_type: TunableLawType) -> dict[str, tuple[float, float, float, str]]:
    return {name: (one.low, one.start, one.high, one.meaning) for name, one in law_type.parameters.items()}


@pytest.mark.parametrize("law", LAWS)
def test_the_page_has_each_parameter_with_its_bounds(law: str) -> None:
    assert documented(law) == ranges(LAWS[law])


def test_the_page_has_those_of_the_profile_of_limited_jerk() -> None:
    pytest.importorskip("ruckig")
    from twostage_servo.control.baselines.jerk_limited import JERK_LIMITED  # noqa: PLC0415 - it needs ruckig

    assert documented("jerk_limited") == ranges(JERK_LIMITED)
