"""What an axis' law finds out of its plant: kept or forgotten, and told to the test that watches the encoder."""

from twostage_servo.axis.design import AxisDesign
from twostage_servo.control.laws.law import Law, Learned, LearningLaw
from twostage_servo.control.model_monitor.monitor import ModelMonitor
from twostage_servo.control.plant import Plant  # noqa: TC001 - the class of an attribute


class LearnedPlant:
    """What is known of the plant; nothing of a law that learns nothing.

    Parameters
    ----------
    design
        The axis.
    law
        The law that drives it.

    Attributes
    ----------
    times_forgotten
        How often :meth:`forget` was called.
    """

    __slots__ = ("_identified", "_keeps", "_law", "times_forgotten")

    def __init__(self, design: AxisDesign, law: Law) -> None:
        self._law = law if isinstance(law, LearningLaw) and law.learns else None
        self._keeps = design.settings.law.memory != "none"
        self._identified: Plant | None = None  # as the model monitor has it
        self.times_forgotten = 0

    @property
    def learned(self) -> Learned | None:
        """What the law has found out of the plant; None of a law that learns nothing."""
        return None if self._law is None else self._law.learned

    def forget(self) -> None:
        """Forget it: a fault may have been taken for it."""
        self.times_forgotten += 1
        if self._law is not None:
            self._law.forget()

    def forget_former_moves(self) -> None:
        """Begin a move with the configured plant, unless what other moves have shown is kept."""
        if self._law is not None and not self._keeps:
            self._law.forget()

    def recall(self, learned: Learned) -> None:
        """Go on from what was learned before; see :meth:`~twostage_servo.control.laws.law.LearningLaw.recall`."""
        if self._law is not None:
            self._law.recall(learned)

    @property
    def expected_position(self) -> float | None:
        """Where the plant that is known says that the axis is at the next sample, in axis unit; None while none is."""
        law = self._law
        return None if law is None or law.identified is None else law.plant_estimate.position

    def tell(self, monitor: ModelMonitor) -> None:
        """Let the model monitor accept what the law has identified, from the estimate that goes with it.

        The plant is bounded, and stays as it was found: what the encoder does from here on is compared with it.
        """
        law = self._law
        if law is None or law.identified is self._identified:
            return
        self._identified = law.identified
        if self._identified is None:
            monitor.forget_identified()
        else:
            monitor.accept(self._identified, law.plant_estimate, is_late=law.learned.delay_ticks > 0)
