"""The gains that the campaign's bounds are made of."""

from twostage_servo.axis.design import AxisDesign
from twostage_servo.control.laws.paper_design import PaperDesign
from twostage_servo.control.optimal import ServoGains, servo_gains


def servo_gains_of(design: AxisDesign) -> ServoGains:
    """Return f11, f12 and f22 of the paper's law for an axis.

    Whatever law drives it: the bounds of the campaign are those that this law keeps, and no other may need more.
    """
    if isinstance(design.law, PaperDesign):
        return design.law.servo_gains
    return servo_gains(design.plant, design.settings.law.paper.performance_index_ratio)
