"""A plant that a law has identified: accepted beside those that the model allows, bounded, and as it was found."""

from math import inf

from twostage_servo.control.estimate import Estimate
from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.control.plant import DiscretePlant, Plant, Triple


class IdentifiedPlant:
    """The hypothesis that the samples are those of this plant; it explains nothing while there is none.

    Parameters
    ----------
    model
        The observer of the model's own plant, as the hypotheses have it: this one's error dies down as that one's does.
    period_s
        The tick, in s.
    memory
        Of the disturbance, as in :class:`~twostage_servo.control.observer.NoiseModel`.
    """

    __slots__ = ("_is_late", "_last_effort", "_memory", "_model", "_observer", "_period_s")

    def __init__(self, model: DisturbanceObserver, period_s: float, memory: float) -> None:
        self._model, self._period_s, self._memory = model, period_s, memory
        self._observer: DisturbanceObserver | None = None
        self._is_late = False
        self._last_effort = 0.0

    def accept(self, plant: Plant, estimate: Estimate, *, is_late: bool) -> None:
        """Accept a plant in place of one before it; see :meth:`.ModelMonitor.accept`."""
        self._observer = slow_observer_like(self._model, plant.discretise(self._period_s), self._memory)
        self._observer.go_on_from(estimate.position, estimate.velocity, estimate.disturbance)
        self._is_late = is_late

    def forget(self) -> None:
        """Accept it no more."""
        self._observer = None

    def start(self, model: DisturbanceObserver, effort: float) -> None:
        """Begin afresh from the estimate of the law's observer, and the effort (effort unit) that has acted."""
        self._last_effort = effort
        if self._observer is not None:
            self._observer.continue_from(model)

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        if self._observer is not None:
            self._observer.shift(distance)

    def predict(self, effort: float) -> None:
        """Account for a period without a sample, in which `effort` (effort unit) acted."""
        acted, self._last_effort = self._last_effort if self._is_late else effort, effort
        if self._observer is not None:
            self._observer.predict(acted)

    def update(self, sample: float, effort: float, lag_s: float) -> float:
        """Take a tick, and return the squared innovation in (axis unit)²; infinity while there is no such plant.

        Parameters
        ----------
        sample, effort, lag_s
            As in :meth:`.ModelMonitor.update`.
        """
        acted, self._last_effort = self._last_effort if self._is_late else effort, effort
        if (observer := self._observer) is None:
            return inf
        observer.update(sample + observer.velocity * lag_s, acted)
        return observer.innovation * observer.innovation


def slow_observer_like(observer: DisturbanceObserver, plant: DiscretePlant, memory: float) -> DisturbanceObserver:
    """Return an observer of another plant whose error dies down as that of an observer of the model does.

    In closed form, in the tick in which the plant is found. The error's polynomial is ``D(z) = (z - m)(z - a22)(z - 1 +
    L1) + a12 L2 (z - m) + (b1 (z - a22) + a12 b2) L3`` with the disturbance's memory m: L3 follows from its value at m,
    L2 from that at a22, and L1 from the sum of its roots.

    Parameters
    ----------
    observer
        Of the model.
    plant
        The other plant, sampled.
    memory
        Of the disturbance, as in :class:`~twostage_servo.control.observer.NoiseModel`.
    """

    def at(plant: DiscretePlant, gain: Triple, z: float) -> float:
        l1, l2, l3 = gain
        return (
            (z - memory) * (z - plant.a22) * (z - 1.0 + l1)
            + plant.a12 * l2 * (z - memory)
            + (plant.b1 * (z - plant.a22) + plant.a12 * plant.b2) * l3
        )

    model, gain = observer.plant, observer.gain
    l3 = at(model, gain, memory) / (plant.b1 * (memory - plant.a22) + plant.a12 * plant.b2)
    l2 = (at(model, gain, plant.a22) - plant.a12 * plant.b2 * l3) / (plant.a12 * (plant.a22 - memory))
    l1 = gain[0] + plant.a22 - model.a22
    return DisturbanceObserver(plant, (l1, l2, l3), memory)
