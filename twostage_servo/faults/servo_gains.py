"""The gains that the campaign's bounds are made of."""

from twostage_servo.axis.design import AxisDesign
from twostage_servo.control.laws.paper_design import PaperDesign
from twostage_servo.control.optimal import ServoGains, servo_gains


def servo_gains_of(design: AxisDesign) -> ServoGains:
    """Return f11, f12 and f22 of the paper's law for an axis.

    Whatever law drives it: no distance that a fault may cost is larger for another. What the effort may do at a stall
    and at a new set-point follows from its plan where a law has one: :func:`follows_a_plan`.
    """
    if isinstance(design.law, PaperDesign):
        return design.law.servo_gains
    return servo_gains(design.plant, design.settings.law.paper.performance_index_ratio)


def follows_a_plan(design: AxisDesign) -> bool:
    """Whether the law of an axis plans its efforts ahead; the paper's only feeds back."""
    return not isinstance(design.law, PaperDesign)
