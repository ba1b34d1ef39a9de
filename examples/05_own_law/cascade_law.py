"""A law as another package brings it: proportional feedback of position and speed, placed by its bandwidth.

Install it beside twostage-servo (``pip install examples/05_own_law``), then try it:
``twostage-servo demo --fast --set axis.law.type=cascade``.
"""

from twostage_servo.control.laws.law import ControlTask, LawDesign
from twostage_servo.control.laws.registry import LawType
from twostage_servo.control.laws.tracking import TrackingDesign
from twostage_servo.settings.base import Settings, quantity


class CascadeSettings(Settings):
    """The keys of ``[axis.law.cascade]``."""

    bandwidth: float = quantity(6.0, unit="1/s", description="Both closed-loop poles", gt=0.0, le=1e3)


def design(settings: CascadeSettings, task: ControlTask) -> LawDesign:
    """Place both poles of ``s² + (pole + gain kv) s + gain kp`` at the bandwidth."""
    kp = settings.bandwidth**2 / task.plant.gain
    kv = (2.0 * settings.bandwidth - task.plant.pole) / task.plant.gain
    return TrackingDesign(
        task,
        feedback=lambda position_error, speed_error: kp * position_error + kv * speed_error,
        time_constant_s=1.0 / settings.bandwidth,
        named_gains={"kp": kp, "kv": kv},
        what_from=f"bandwidth {settings.bandwidth:g}/s",
    )


LAW = LawType(CascadeSettings, design)
