"""The paper's law as one that an axis may have: its keys, and how it is designed."""

from typing import Final

from twostage_servo.control.laws.law import ControlTask, LawDesign
from twostage_servo.control.laws.paper_design import design_paper
from twostage_servo.control.laws.registry import LawType
from twostage_servo.settings.base import Settings, quantity


class PaperSettings(Settings):
    """How the gains of the two-stage law are found."""

    performance_index_ratio: float = quantity(
        5.0e-5, unit="1", description="Q/R of the optimal design, larger is faster", ge=1e-12, le=1e6
    )


def _design(settings: PaperSettings, task: ControlTask) -> LawDesign:
    return design_paper(settings.performance_index_ratio, task)


PAPER: Final = LawType(PaperSettings, _design)
