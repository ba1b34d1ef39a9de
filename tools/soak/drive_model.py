"""The drive of a soaked axis, tick by tick: its plant, its encoder, its power stage, and what may fail in each."""

from random import Random

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.messages import Command, Feedback
from twostage_servo.control.plant import MODEL_ERROR, Plant

COUNTER_MODULUS = 16


class EncoderModel:
    """An encoder with steps and noise, which may count wrongly from a place on.

    Parameters
    ----------
    quantum
        Its step in axis unit.
    noise
        Standard deviation of its noise in axis unit.
    random
        Of the noise.

    Attributes
    ----------
    factor
        How many units it counts for one: -1 turned round, 0 frozen, 1 sound.
    """

    def __init__(self, quantum: float, noise: float, random: Random) -> None:
        self._quantum = quantum
        self._noise = noise
        self._random = random
        self.factor = 1.0
        self._place = self._counted = 0.0  # where the factor began to count, and what was counted there

    def count(self, position: float) -> float:
        """Return what it counts at a true position, both in axis unit."""
        counted = self._counted + self.factor * (position - self._place)
        if self._noise and self.factor:  # one that is frozen repeats itself
            counted += self._random.gauss(0.0, self._noise)
        return self._quantum * round(counted / self._quantum)

    def fail(self, factor: float, position: float) -> None:
        """Count by another factor from a true position (axis unit) on, from what is counted there."""
        self._counted += self.factor * (position - self._place)
        self._place, self.factor = position, factor

    def mend(self, position: float, *, absolute: bool) -> None:
        """Count rightly again; an absolute encoder counts the true position (axis unit) then, another goes on."""
        self.fail(1.0, position)
        if absolute:
            self._counted = self._place


class DriveModel:
    """A drive and its plant, which is off the model by up to :data:`MODEL_ERROR`.

    Parameters
    ----------
    design
        The axis that it is the drive of.
    quantum, noise
        Of the encoder, in axis unit.
    switch_from
        True position (axis unit) from which on down its home switch is active; None: it has no such switch.
    random
        Of everything.

    Attributes
    ----------
    encoder
        Its encoder.
    position, velocity
        The true axis, in axis unit and axis unit/s.
    enabled
        Whether its power stage is on.
    effort
        What acts, in effort unit; without the load.
    load
        What acts against it while the drive is enabled, in effort unit: an axis that can fall has a brake.
    limit_switch
        The limit switch that is active, by its sign; 0: none.
    silent_until, fault_until, sto_until, heartbeat_silent_until, spike_at, spike
        Until which tick it is silent, has a fault, has safe torque off, or has no heartbeat; and the tick and the
        height (axis unit) of a spike.
    stuck_until
        Until which tick its power stage, once it is on, stays on, whatever it is told.
    creeping_until, creeping
        Until which tick it gives an effort though its power stage is said to be off, and which.
    boots
        What its heartbeat counts.
    gain, pole
        The plant's gain and pole, as multiples of the model's.
    """

    def __init__(
        self, design: AxisDesign, quantum: float, noise: float, switch_from: float | None, random: Random
    ) -> None:
        self.encoder = EncoderModel(quantum, noise, random)
        self._design = design
        self._random = random
        self._switch_from = switch_from
        self._counter = 0
        self._sample = 0.0
        self.position = self.velocity = 0.0
        self.enabled = False
        self.effort = self.load = 0.0
        self.limit_switch = 0.0
        self.silent_until = self.fault_until = self.sto_until = self.heartbeat_silent_until = 0
        self.spike_at, self.spike = -1, 0.0
        self.stuck_until = self.creeping_until = 0
        self.creeping = 0.0
        self.boots = 0
        self.change_plant()

    def change_plant(self) -> None:
        """Let gain and pole be others, off the model by up to :data:`MODEL_ERROR`."""
        plant, random = self._design.settings.plant, self._random
        self.gain = random.uniform(1.0 - MODEL_ERROR, 1.0 + MODEL_ERROR)
        self.pole = random.uniform(1.0 - MODEL_ERROR, 1.0 + MODEL_ERROR)
        self._plant = Plant(plant.gain * self.gain, plant.pole * self.pole).discretise(self._design.period_s)

    def place(self, position: float) -> None:
        """Move the axis by hand to a true position in axis unit, where it rests."""
        self.position, self.velocity = position, 0.0
        self._sample = self.encoder.count(position)

    def mend_encoder(self, *, absolute: bool) -> None:
        """Let the encoder count rightly again, from the sample on that is reported next; see :class:`EncoderModel`.

        Who says where the axis is takes a report for the present one: the count must not change behind it.
        """
        self.encoder.mend(self.position, absolute=absolute)
        self._sample = self.encoder.count(self.position)

    def feedback(self, tick: int) -> Feedback | None:
        """Return what it reports in a tick; None while it is silent."""
        if tick < self.silent_until:
            return None
        self._counter = (self._counter + 1) % COUNTER_MODULUS
        sto = tick < self.sto_until
        return Feedback(
            self._sample + (self.spike if tick == self.spike_at else 0.0),
            self._counter,
            self.enabled and not sto,
            fault_code=7 if tick < self.fault_until else None,
            safe_torque_off=sto,
            positive_limit=self.limit_switch > 0.0,
            negative_limit=self.limit_switch < 0.0,
            home_switch=None if self._switch_from is None else self.position <= self._switch_from,
        )

    def obey(self, command: Command, tick: int) -> None:
        """Take a command, sample, and move for a period."""
        can_be_enabled = tick >= self.fault_until and tick >= self.sto_until
        if command.enable and can_be_enabled:
            self.enabled, self.effort = True, command.effort
        elif not (
            self.enabled and tick >= self.sto_until and tick < self.stuck_until
        ):  # stuck, it keeps the effort that it had
            self.enabled, self.effort = False, 0.0
        if not self.enabled and tick < self.creeping_until:
            self.effort = self.creeping
        self._sample = self.encoder.count(self.position)
        self.move()

    def miss(self) -> None:
        """Move for a period in which no command came: the last one goes on acting."""
        self._sample = self.encoder.count(self.position)
        self.move()

    def move(self) -> None:
        """Move for a period."""
        plant = self._plant
        total = self.effort - (self.load if self.enabled else 0.0)
        self.position += plant.a12 * self.velocity + plant.b1 * total
        self.velocity = plant.a22 * self.velocity + plant.b2 * total
