"""The adaptive law as one that an axis may have: its keys, and how it is designed."""

from typing import Final

from pydantic import Field

from twostage_servo.control.laws.adaptive.design import AdaptiveDesign, design_adaptive
from twostage_servo.control.laws.law import ControlTask
from twostage_servo.control.laws.registry import LawType
from twostage_servo.settings.base import Settings, quantity


class AdaptiveSettings(Settings):
    """Whether the adaptive law identifies its plant, and how noisy its encoder is."""

    identification: bool = Field(
        True, description="Whether moves from rest identify gain, pole, load and delay of the plant"
    )
    encoder_noise: float = quantity(
        0.0,
        unit="axis unit",
        description="Standard deviation of a measured position, or a third of the encoder's step where that is more; "
        "more is measured at rest",
        ge=0.0,
        le=1e12,
    )


def _design(settings: AdaptiveSettings, task: ControlTask) -> AdaptiveDesign:
    return design_adaptive(task, settings.encoder_noise, learns=settings.identification)


ADAPTIVE: Final = LawType(AdaptiveSettings, _design, smooths=True)
