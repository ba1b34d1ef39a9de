"""What every baseline is before its first step, what it does without a set-point, and in its second move."""

from collections.abc import Callable

import numpy as np
import pytest

from tests.control.baselines.rig import MODEL, PERIOD_S, SAMPLED, SLOW, Axis
from twostage_servo.control.baselines.compared_law import ComparedLaw
from twostage_servo.control.baselines.conventional import ConventionalTwoStage
from twostage_servo.control.baselines.optimal_servo import OptimalServo
from twostage_servo.control.baselines.pid import Pid
from twostage_servo.control.baselines.transcription import TranscribedLaw
from twostage_servo.control.baselines.velocity import Differentiator
from twostage_servo.control.laws.law import Stage

LAWS: dict[str, Callable[[], ComparedLaw]] = {
    "conventional": lambda: ConventionalTwoStage(SAMPLED, SLOW, Differentiator(PERIOD_S)),
    "optimal servo": lambda: OptimalServo(SLOW, Differentiator(PERIOD_S)),
    "pid": lambda: Pid(SLOW, PERIOD_S),
    "transcribed": lambda: TranscribedLaw(SAMPLED, 5e-5, 0.01),
}


@pytest.mark.parametrize("name", LAWS)
def test_a_new_law_is_at_rest_and_has_changed_nothing_over(name: str) -> None:
    law = LAWS[name]()
    assert law.velocity == 0.0
    assert law.changeovers == 0
    assert type(law.changeovers) is int
    if isinstance(law, ConventionalTwoStage | TranscribedLaw):
        assert law.stage is Stage.SPEED


@pytest.mark.parametrize("name", ["optimal servo", "pid"])
def test_without_a_set_point_it_holds_the_origin(name: str) -> None:
    law = LAWS[name]()
    assert [law.step(0.0) for _ in range(5)] == [0.0] * 5


def test_the_optimal_servo_begins_without_effort_wherever_it_stands() -> None:
    """It is incremental: where it stands at the first sample is no step."""
    law = LAWS["optimal servo"]()
    law.set_target(300.0, 100.0)
    assert [law.step(300.0) for _ in range(5)] == [0.0] * 5


def test_the_optimal_servo_measures_the_velocity_of_the_sample() -> None:
    seen: list[float] = []

    def at_rest(sample: float) -> float:
        seen.append(sample)
        return 0.0

    law = OptimalServo(SLOW, at_rest)
    law.step(1.5)
    law.step(2.5)
    assert seen == [1.5, 2.5]


@pytest.mark.parametrize("name", ["conventional", "transcribed"])
def test_each_move_has_a_changeover_of_its_own(name: str) -> None:
    law, axis = LAWS[name](), Axis()
    for number, target in enumerate((400.0, 800.0), 1):
        law.set_target(target, 100.0)
        assert isinstance(law, ConventionalTwoStage | TranscribedLaw)
        assert law.stage is Stage.SPEED
        axis.drive(law, 1200)
        assert law.changeovers == number
        assert axis.position == pytest.approx(target, abs=0.1)


@pytest.mark.parametrize(("target", "stage"), [(440.0, Stage.POSITION), (360.0, Stage.POSITION), (0.0, Stage.SPEED)])
def test_a_second_move_of_the_transcribed_law_is_measured_from_where_the_axis_is(target: float, stage: Stage) -> None:
    """40 mm are less than the change-over distance of 54.5 mm, so there is no speed stage; 400 mm back are more."""
    law, axis = TranscribedLaw(SAMPLED, 5e-5, 0.01), Axis()
    law.set_target(400.0, 100.0)
    axis.drive(law, 1200)
    law.set_target(target, 100.0)
    assert law.stage is stage
    axis.drive(law, 1200)
    assert axis.position == pytest.approx(target, abs=0.1)


def test_by_default_the_conventional_law_is_that_of_section_3_with_its_erratum_corrected() -> None:
    """No difference is fed back, and the sum begins at the change-over: on its own model the effort has no step there.

    Off its model, without feedback of the difference, an error of ``f11 v_m T_s / f22`` remains.
    """
    law, axis = LAWS["conventional"](), Axis(MODEL, load=1.0)
    law.set_target(400.0, 100.0)
    axis.drive(law, 2500)
    velocity = law.velocity
    assert abs(velocity) > 1.0
    remaining = 400.0 - axis.position
    assert remaining == pytest.approx(SLOW.f11 * velocity * PERIOD_S / SLOW.f22, rel=0.02)


def test_at_the_changeover_of_the_conventional_law_the_effort_goes_on() -> None:
    law, axis = LAWS["conventional"](), Axis()
    law.set_target(400.0, 100.0)
    efforts: list[float] = []
    while not law.changeovers:
        efforts.extend(axis.drive(law, 1)[2])
    efforts.extend(axis.drive(law, 2)[2])
    # A sum that began a tick late would be short of f22 times 54 mm, 0.37.
    assert np.abs(np.diff(efforts[-4:])).max() < 0.02
