"""The gains that the campaign's bounds are made of."""

from twostage_servo.axis.design import AxisDesign
from twostage_servo.control.laws.paper_design import PaperDesign
from twostage_servo.control.optimal import ServoGains


def servo_gains_of(design: AxisDesign) -> ServoGains:
    """Return f11, f12 and f22 of an axis.

    Raises
    ------
    TypeError
        If its law is another than the paper's, of which the campaign has no bounds.
    """
    if not isinstance(design.law, PaperDesign):
        raise TypeError("the campaign's bounds are those of the paper's law: set axis.law.type to paper")
    return design.law.servo_gains
