"""The estimate that the adaptive law controls by: its own observer, the plant that it believes in, and what it learns.

The axis' observer stays as it is configured, and with it everything that watches the axis: what has been identified
while an encoder may lie must not decide whether it does. This one is quicker, and goes on with each model that is
found. Between the two, what is kept is the acceleration that is predicted: a disturbance means something else of
another plant.
"""

from typing import Final

from twostage_servo.control.laws.adaptive.encoder_noise import EncoderNoise
from twostage_servo.control.laws.adaptive.identification import Acted
from twostage_servo.control.laws.adaptive.learning import Learning
from twostage_servo.control.laws.adaptive.memory import check_learned
from twostage_servo.control.laws.adaptive.model import Model
from twostage_servo.control.laws.adaptive.rules import (
    FINEST_SPREAD,
    LOAD_DEVIATIONS,
    SPREAD_SHARE,
    LearningRules,
    Rules,
    encoder_gains,
    is_noisy,
    noise_unit,
)
from twostage_servo.control.laws.adaptive.untimeliness import Untimeliness
from twostage_servo.control.laws.law import ControlTask, Learned
from twostage_servo.control.laws.timing import IN_TIME, Timing
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver
from twostage_servo.control.plant import Plant

_DATE_SHARE: Final = 0.3
"""Share of its age beyond the usual one by which the date of a sample may be off: a drive takes a command that comes at
another time than usual in a cycle of its own, and the observer that brings the sample to its instant may be wrong."""

_LARGEST_SPREAD: Final = 30.0
"""Largest spread of a sample that identification supposes, as a multiple of the least: more is no encoder's noise."""


class ControlEstimate:
    """Position, velocity and disturbance at the instant at which the next effort begins to act.

    Parameters
    ----------
    task
        What the law is designed for.
    rules, learning_rules
        How the law shapes a move, and when it believes what it identifies.
    noise
        Standard deviation of the encoder in axis unit, as far as it is known; more is measured at rest.
    learns
        Whether plants are identified.

    Attributes
    ----------
    model
        The plant that is believed in at present, and its gains.
    learning
        What has been identified of the plant.
    position, velocity, disturbance
        In axis unit, axis unit/s and effort unit.
    is_misled
        Whether the last sample has shown that what it went by in this move was nonsense: :meth:`resume` is due.
    """

    __slots__ = (
        "_direction", "_efforts", "_friction", "_is_to_begin", "_learning_rules", "_learns", "_load_at_rest",
        "_more_ways", "_noise", "_observer", "_origin", "_rules", "_task", "_unit", "_untimeliness", "disturbance",
        "is_misled", "learning", "model", "position", "velocity",
    )  # fmt: skip

    def __init__(
        self, task: ControlTask, rules: Rules, learning_rules: LearningRules, noise: float, *, learns: bool
    ) -> None:
        self._task = task
        self._rules = rules
        self._learning_rules = learning_rules
        self._learns = learns
        self._unit = noise_unit(task)
        self._noise = EncoderNoise(noise)
        memory = encoder_gains(task, noise, rules).memory
        self._observer = DisturbanceObserver(task.sampled, NO_CORRECTION, memory)
        self.learning = Learning(task.plant, learning_rules, task.period_s, task.effort_limit)
        self._efforts = 0.0, 0.0, 0.0
        self._more_ways = 0.0, 0.0  # of the last two periods
        self._untimeliness = Untimeliness(task.period_s)
        self._direction, self._origin = 1.0, 0.0
        self._is_to_begin = False  # a move, with its first sample
        self._load_at_rest = 0.0  # against the move, before it
        self.is_misled = False
        self._friction = 0.0  # what ends with the move of what acts against it
        self.position = self.velocity = self.disturbance = 0.0
        self._adopt(self.learning.believed)

    # What is told -----------------------------------------------------------------------------------------------------

    @property
    def noise(self) -> float:
        """Standard deviation of a sample, in axis unit: as configured, or as measured at rest where that is more."""
        return self._noise.deviation

    @property
    def spread(self) -> float:
        """Spread of a sample, in axis unit: its noise, within what an encoder may have."""
        least = FINEST_SPREAD * self._unit
        return min(max(self.noise, least), _LARGEST_SPREAD * least)

    @property
    def is_identifying(self) -> bool:
        """Whether a move is being looked at."""
        return self.learning.active

    @property
    def learned(self) -> Learned:
        """What is known of the plant by now."""
        return self.learning.learned

    @property
    def learns(self) -> bool:
        """Whether moves are looked at."""
        return self._learns

    @property
    def observer(self) -> DisturbanceObserver:
        """Its observer, whose estimate is that of a tick after the last sample."""
        return self._observer

    # What it is given -------------------------------------------------------------------------------------------------

    def start(self, axis: DisturbanceObserver, effort: float) -> None:
        """Go on from the estimate of the axis' observer, as if an effort (effort unit) had acted so far."""
        self._efforts = effort, effort, effort
        self._take(axis)

    def resume(self, axis: DisturbanceObserver) -> None:
        """Go on from the estimate of the axis' observer, which knows nothing of what was identified."""
        self.is_misled = False
        self._take(axis)

    def continue_from(self, other: "ControlEstimate", axis: DisturbanceObserver) -> None:
        """Go on where another one stands, with the axis' estimate and what is believed here."""
        self._efforts = other.efforts
        self._take(axis)

    def _take(self, axis: DisturbanceObserver) -> None:
        """Take over the axis' estimate; the acceleration that it predicts stays."""
        self.give_up()
        self._friction = 0.0
        configured, effort = self._task.plant, self._efforts[0]
        acceleration = configured.gain * (effort + axis.disturbance) - configured.pole * axis.velocity
        self._observer.go_on_from(axis.position, axis.velocity, 0.0)
        self._keep_acceleration(acceleration)
        self._tell()

    @property
    def efforts(self) -> tuple[float, float, float]:
        """The last three efforts, the latest first, in effort unit."""
        return self._efforts

    def update(self, sample: float | None, effort: float, timing: Timing = IN_TIME) -> None:
        """Take the sample of the last effort's instant (axis unit), None if there is none, and the effort that acted.

        What is told then holds where the next effort begins to act.

        Parameters
        ----------
        sample, effort
            As above.
        timing
            What was not in time in that period.
        """
        observer = self._observer
        last, before, _ = self._efforts
        self._efforts = effort, last, before
        observer.update(observer.position if sample is None else sample, last if self.model.is_late else effort)
        if self._is_to_begin:
            self._begin(sample)
        if self.learning.active:
            self._learn(sample, timing.lag_s)
        self._more_ways = timing.more_way, self._more_ways[0]
        if self._untimeliness.update(timing):
            self._adopt(self.model.plant)
        self._tell()

    def skip(self, effort: float) -> None:
        """Account for a tick that was missed, in which an effort (effort unit) acted on."""
        self.give_up()
        last, before, _ = self._efforts
        self._efforts = effort, last, before
        self._observer.predict(self._acted)
        self._tell()

    def shift(self, distance: float) -> None:
        """Count positions from an origin that lies `distance` (axis unit) lower."""
        self._observer.shift(distance)
        self._origin += distance
        self.position += distance
        self._noise.clear()

    def rest(self, sample: float | None) -> None:
        """Take a sample (axis unit) of an axis that holds: what moves it is noise."""
        self._noise.update(sample)

    # What is learned --------------------------------------------------------------------------------------------------

    def begin_move(self, direction: float) -> None:
        """Begin to look at a move from rest, in a direction (1 or -1).

        What acted against the last move in this direction, friction included, is expected again.
        """
        learning, observer = self.learning, self._observer
        self._direction, self._origin = direction, observer.position
        self._friction = 0.0
        if not self._learns:
            return
        self._adopt(learning.believed)  # with the poles that the noise asks for
        self._load_at_rest = held = -direction * observer.disturbance
        for known, here in ((direction, held), (-direction, -held)):
            if known in learning.loads and abs(learning.loads[known] - here) > self._largest_friction:
                del learning.loads[known]  # it has gone since, or was never there: it would drive the axis off
        if direction in learning.loads:
            observer.correct(observer.velocity, -direction * learning.loads[direction])
        self._is_to_begin = True
        self._tell()

    def _begin(self, sample: float | None) -> None:
        """Begin to identify with the first sample of the move: a model that runs by itself gets none."""
        if sample is None:
            self.give_up()
            return
        self._is_to_begin = False
        self.learning.begin(self._direction, self._load_at_rest, SPREAD_SHARE * self.spread)

    def finish(self) -> None:
        """End to look, and go on with what is believed."""
        only_watched = self.learning.only_watches
        if self.learning.finish():
            if only_watched:
                self._return_to_believed()
            else:
                self._adopt(self.learning.believed)
            # Quick loops behind a quiet encoder find it within two ticks.
            if self._rules.ends_friction and (self._untimeliness.is_large or is_noisy(self._task, self.noise)):
                self._friction = self.learning.friction(self._load_at_rest, self._largest_friction)
        else:
            self._return_to_believed()
        self._tell()

    def come_to_rest(self, direction: float) -> None:
        """End a motion in a direction (1 or -1): what acted against it as long as it lasted no longer does.

        Otherwise it would push the axis on from where it has come to rest, until the observer has found it out. With
        the poles for a noisy encoder that takes half a second.
        """
        if direction == self._direction:
            self._observer.correct(self._observer.velocity, self._observer.disturbance + direction * self._friction)
            self._tell()
        self._friction = 0.0

    def give_up(self) -> None:
        """End to look, because something else happens; go on with the model of this move only if it is known well."""
        self._is_to_begin = False
        self._noise.clear()  # what was seen at one place says nothing of the noise at another
        if not self.learning.active:
            return
        if self.learning.give_up():
            self._adopt(self.model.plant, is_known=True)
        else:
            self._return_to_believed()

    def forget(self) -> None:
        """Believe what is configured, and nothing else."""
        self.learning.forget()
        self._return_to_believed()
        self._tell()

    def recall(self, learned: Learned) -> None:
        """Believe what has been learned before; see :meth:`~twostage_servo.control.laws.law.LearningLaw.recall`."""
        check_learned(learned, self._task, self._learning_rules)
        self.learning.recall(learned)
        self._return_to_believed()
        self._tell()

    def _learn(self, sample: float | None, lag_s: float) -> None:
        learning, direction = self.learning, self._direction
        way = None if sample is None else direction * (sample - self._origin)
        _, before, before_that = self._efforts
        more, more_before = self._more_ways
        soon = Acted(direction * before, direction * more)
        late = Acted(direction * before_that, direction * more_before)
        found = learning.update(way, soon, late, _DATE_SHARE * lag_s)
        if learning.contradicted:
            self.give_up()
            self.is_misled = learning.trust.has_no_plant and not learning.only_watches
        elif found is not None:
            self._adopt(found.plant)
            plant, net = self.model.sampled, direction * self._acted - found.load
            self._observer.go_on_from(
                self._origin + direction * (found.position + plant.a12 * found.velocity + plant.b1 * net),
                direction * (plant.a22 * found.velocity + plant.b2 * net),
                -direction * found.load,
            )

    @property
    def _largest_friction(self) -> float:
        """By how much what acts against a move may differ from what is held at rest, in effort unit."""
        return LOAD_DEVIATIONS * self._learning_rules.prior_load * self._task.effort_limit

    @property
    def _acted(self) -> float:
        """The effort that has acted in the last tick, as far as is believed."""
        last, before, _ = self._efforts
        return before if self.model.is_late else last

    def _return_to_believed(self) -> None:
        observer, plant = self._observer, self.model.plant
        acceleration = plant.gain * (self._acted + observer.disturbance) - plant.pole * observer.velocity
        self._adopt(self.learning.believed)
        self._keep_acceleration(acceleration)

    def _keep_acceleration(self, acceleration: float) -> None:
        """Suppose the disturbance with which the plant that is believed in has an acceleration, in axis unit/s²."""
        observer, plant = self._observer, self.model.plant
        disturbance = (acceleration + plant.pole * observer.velocity) / plant.gain - self._acted
        observer.correct(observer.velocity, disturbance)

    def _adopt(self, plant: Plant, *, is_known: bool = False) -> None:
        """Go on with a plant, by gains that go with what is known of it, or with `is_known` of this one."""
        learning, rules = self.learning, self._rules
        gains = encoder_gains(self._task, self.noise, rules)
        if not (is_known or learning.is_known):
            gains = gains.slower(rules.unknown)
        elif self._untimeliness.is_large:
            gains = gains.slower(rules.untimely)
        elif learning.is_late:
            gains = gains.slower(rules.late)
        self.model = Model(plant, learning.is_late, gains, self._task.period_s)
        self._observer.adopt(self.model.sampled, self.model.observer_gain)

    def _tell(self) -> None:
        """Tell the estimate; where an effort acts a tick later, for the instant at which the next one will."""
        observer = self._observer
        self.position, self.velocity, self.disturbance = observer.position, observer.velocity, observer.disturbance
        if self.model.is_late:
            plant, total = self.model.sampled, self._efforts[0] + observer.disturbance
            self.position += plant.a12 * self.velocity + plant.b1 * total
            self.velocity = plant.a22 * self.velocity + plant.b2 * total
