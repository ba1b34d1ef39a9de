"""A value of an axis keeps its kind: a number is never nothing, a flag is never a number or nothing."""

import pytest

from tests.axis.rig import DEMO, PERIOD_S, TRAITS, AxisRig
from tests.kinds import Kinds, assert_kinds, collect
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.state import State

OF_AN_AXIS = {
    "Changeover._smoothing",
    "CountHistory.place",
    "Course.braking",
    "DisabledMotion.anchor",
    "DisabledMotion.moved",
    "DisabledReports.reported",
    "DisabledReports.ticks_told",
    "DriveReport.age_s",
    "DriveReport.backlog",
    "DriveReport.enabled",
    "DriveReport.fault_code",
    "DriveReport.faulted",
    "DriveReport.home_switch",
    "DriveReport.index",
    "DriveReport.negative_limit",
    "DriveReport.position",
    "DriveReport.positive_limit",
    "DriveReport.safe_torque_off",
    "DriveStateComparison.new",
    "FeedbackMonitor._counter",
    "FeedbackMonitor.ticks_since_fresh",
    "Heard.boot_counter",
    "IdentifiedPlant._observer",
    "Latest.enables",
    "Latest.ticks_since",
    "LearnedPlant._identified",
    "LearnedPlant._law",
    "Learning._poor_fit",
    "Motion._shown",
    "Motion._stands_at",
    "Motion._unchanged",
    "Move.reason",
    "Operation.final_target",
    "Operation.homing",
    "Operation.move",
    "Rules.fixed_gains",
    "SpeedOverride._leg",
    "SpeedOverride.kept_target",
    "SpeedStage._smoothing",
    "StatesSeen.claim",
    "TripFile.error",
    "TripFile.path",
    "TripLatch.escalation",
    "TripLatch.trip",
    "Trust.rejection",
    "Unwrapped.near",
}
"""What is nothing at times: it has not been seen, is not there, or has not happened yet."""


@pytest.mark.parametrize("law", ["paper", "adaptive"])
def test_through_moves_a_jog_a_stop_a_trip_and_back(law: str) -> None:
    settings = AxisSettings.model_validate(DEMO | {"law": {"type": law}})
    rig, kinds = AxisRig(Axis(design_axis(settings, PERIOD_S), TRAITS)), Kinds()

    def run(duration_s: float) -> None:
        for _ in range(round(duration_s / PERIOD_S)):
            rig.tick()
            collect(rig.axis, kinds)

    collect(rig.axis, kinds)
    run(0.05)
    rig.axis.arm()
    run(0.1)
    rig.axis.move_to(30.0, 100.0)
    run(0.3)
    rig.axis.set_override(50.0)
    run(4.0)
    rig.axis.jog(-40.0)
    run(0.2)
    rig.axis.stop()
    run(0.5)
    rig.silent = True
    run(0.3)
    rig.silent = False
    run(0.5)
    assert rig.state() is State.TRIPPED
    rig.axis.reset()
    run(0.1)
    assert_kinds(kinds, OF_AN_AXIS)
