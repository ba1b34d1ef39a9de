"""An axis and its plant, without a bus: random requests, faults and loads by seed, tick by tick."""

import math
from collections.abc import Callable
from random import Random
from typing import TYPE_CHECKING

from invariants import Invariants

from twostage_servo.axis.design import MODEL_ERROR
from twostage_servo.axis.messages import Feedback, Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.config import load
from twostage_servo.control.plant import Plant
from twostage_servo.service.assembly import build_axis, compile_profile

if TYPE_CHECKING:
    from twostage_servo.axis.axis import Axis

_PLANT_LIFE_TICKS = 200_000
"""How long a plant keeps its parameters."""

_HEARTBEAT_TICKS = 10
_OPERATED = 0.7
"""Share of events that an operator causes; the others are mishaps."""
_CHANGE_OF_PACE = 0.03
"""Share of events at which the operation becomes busier or calmer."""


class AxisSoak:
    """One axis in random operation.

    Parameters
    ----------
    seed
        Of everything.
    """

    def __init__(self, seed: int) -> None:
        loaded = load(None)
        profile = compile_profile(loaded)
        self.random = Random(seed)  # noqa: S311 - a soak, no secret
        self.axis: Axis = build_axis(loaded, profile, loaded.config.service.tick_ms / 1e3)
        self.invariants = Invariants(self.axis)
        self.requests = self.refusals = self.trips = self.moves_reached = 0
        self._modulus = profile.counter_modulus
        self._period_s = self.axis.design.period_s
        self._position = self._velocity = self._sample = 0.0
        self._counter = self._tick = 0
        self._pace_ticks = 100.0
        self._enabled = False
        self._effort = 0.0
        # Faults that last: until which tick.
        self._silent_until = self._fault_until = self._sto_until = self._spike_at = 0
        self._boots = self._heartbeat_silent_until = 0
        self._switch = 0.0
        self._load = 0.0
        self._reported_trip: object = None
        self._mishaps = (
            *[self._fall_silent] * 6, *[self._load_the_axis] * 6, *[self._spike] * 4, *[self._stall] * 3,
            *[self._fault] * 2, *[self._emergency_stop] * 2, self._reboot_or_hang, self._trip, self._knock,
            self._foreign_command, self._limit_switch,
        )  # fmt: skip
        self._commands: tuple[Callable[[], object], ...] = (
            *[self._move] * 6, *[self._move_nearby] * 5, *[self._step] * 2, *[self._jog] * 2, self.axis.stop,
            self._quick_stop, self.axis.disarm, self.axis.arm, self._say_where, self._ask_nonsense,
        )  # fmt: skip
        self._new_plant()

    def run(self, ticks: int) -> None:
        """Run so many ticks more."""
        end = self._tick + ticks
        random = self.random
        while self._tick < end:
            if random.random() < _CHANGE_OF_PACE:
                self._pace_ticks = random.choice((10.0, 50.0, 200.0, 500.0))
            quiet = min(end - self._tick, 1 + int(random.expovariate(1.0 / self._pace_ticks)))
            for _ in range(quiet):
                self._one_tick(0)
            self._something_happens()

    def _one_tick(self, missed: int) -> None:
        axis, plant = self.axis, self._plant
        self._tick += 1 + missed
        axis.begin_tick(self._tick, missed)
        if self._tick >= self._silent_until:
            self._counter = (self._counter + 1) % self._modulus
            sample = self._sample
            if self._tick == self._spike_at:
                sample += self.random.uniform(-100.0, 100.0)
            fault = 7 if self._tick < self._fault_until else None
            sto = self._tick < self._sto_until
            axis.take_feedback(
                Feedback(
                    round(sample, 3),
                    self._counter,
                    self._enabled and not sto,
                    fault,
                    sto,
                    self._switch > 0.0,
                    self._switch < 0.0,
                )
            )
        if self._tick % _HEARTBEAT_TICKS == 0 and self._tick >= self._heartbeat_silent_until:
            axis.take_heartbeat(self._boots)
        command = axis.step()
        self._enabled = command.enable and self._tick >= self._fault_until and self._tick >= self._sto_until
        self._effort = command.effort if self._enabled else 0.0
        self._sample = self._position
        # The load acts while the drive is enabled: an axis that can fall has a brake.
        total = self._effort - (self._load if self._enabled else 0.0)
        self._position += plant.a12 * self._velocity + plant.b1 * total
        self._velocity = plant.a22 * self._velocity + plant.b2 * total
        self.invariants.look(command, self._position)
        if axis.trip is not self._reported_trip:
            self._reported_trip = axis.trip
            self.trips += axis.trip is not None

    def _something_happens(self) -> None:
        if self.random.random() < _OPERATED:
            self._operate()
        else:
            self.random.choice(self._mishaps)()
        if self._tick > self._plant_ends:
            self._new_plant()

    # Mishaps ---------------------------------------------------------------------------------------------------------

    def _fall_silent(self) -> None:
        self._silent_until = self._tick + self.random.choice((1, 1, 2, 2, 3, 8, 60))

    def _load_the_axis(self) -> None:
        random = self.random
        self._load = random.choice((0.0, random.uniform(-3.0, 3.0), random.uniform(-12.0, 12.0)))

    def _spike(self) -> None:
        self._spike_at = self._tick + 1 + self.random.randrange(3)

    def _stall(self) -> None:
        self._miss(self.random.choice((1, 1, 2, 3, 10)))

    def _fault(self) -> None:
        self._fault_until = self._tick + self.random.randrange(1, 200)

    def _emergency_stop(self) -> None:
        self._sto_until = self._tick + self.random.randrange(1, 200)

    def _reboot_or_hang(self) -> None:
        self._boots = (self._boots + self.random.randrange(2)) % 256
        self._heartbeat_silent_until = self._tick + self.random.randrange(1, 100)

    def _trip(self) -> None:
        self.axis.raise_trip(self.random.choice(list(TripCode)), "soaked")

    def _knock(self) -> None:
        self._velocity += self.random.uniform(-20.0, 20.0)

    def _foreign_command(self) -> None:
        self.axis.notice_foreign_command("soaked")

    def _limit_switch(self) -> None:
        self._switch = 0.0 if self._switch else self.random.choice((-1.0, 1.0))

    # The operator ----------------------------------------------------------------------------------------------------

    def _operate(self) -> None:
        """Do what an operator might: mostly sensible things, some that are not."""
        axis = self.axis
        if axis.trip is not None:
            self._ask(axis.reset)
        elif axis.state is State.DISARMED:
            self._arm()
        else:
            self._ask(self.random.choice(self._commands))

    def _arm(self) -> None:
        axis = self.axis
        if not axis.referenced or self.random.random() < 0.05:
            self._ask(self._say_where)
        obstacle = axis.obstacle_to_arming()
        if obstacle is not None and obstacle[0] == "position_limit":  # moved back by hand
            self._position = self._sample = 0.9 * math.copysign(axis.settings.limits.position_maximum, self._position)
            self._velocity = 0.0
        self._ask(axis.arm)

    def _say_where(self) -> None:
        self.axis.set_position(round(self._position, 3))

    def _move(self) -> None:
        move = self.axis.move
        self.moves_reached += move is not None and move.outcome == "reached"
        limits = self.axis.settings.limits
        self.axis.move_to(self.random.uniform(limits.position_minimum, limits.position_maximum), self._velocity_asked())

    def _move_nearby(self) -> None:
        limits = self.axis.settings.limits
        target = self._position + self.random.uniform(-50.0, 50.0)
        self.axis.move_to(min(max(target, limits.position_minimum), limits.position_maximum), self._velocity_asked())

    def _step(self) -> None:
        self.axis.move_by(self.random.uniform(-5.0, 5.0), self._velocity_asked())

    def _jog(self) -> None:
        self.axis.jog(self.random.choice((-1.0, 1.0)) * self._velocity_asked())

    def _ask_nonsense(self) -> None:
        beyond = self.axis.settings.limits.position_maximum + 1.0
        self.axis.move_to(self.random.choice((math.nan, math.inf, -math.inf, 1e300, beyond)), self._velocity_asked())

    def _quick_stop(self) -> None:
        self.axis.stop(quick=True)

    def _velocity_asked(self) -> float:
        return self.random.uniform(0.1, 1.0) * self.axis.settings.limits.velocity

    def _ask(self, request: Callable[[], object]) -> None:
        """Ask for something: it is carried out or refused; anything else ends the soak."""
        self.requests += 1
        try:
            request()
        except Refused:
            self.refusals += 1

    def _miss(self, ticks: int) -> None:
        """Let some ticks be missed: the last effort goes on acting, and nobody looks."""
        plant, total = self._plant, self._effort - (self._load if self._enabled else 0.0)
        for _ in range(ticks):
            self._sample = self._position
            self._position += plant.a12 * self._velocity + plant.b1 * total
            self._velocity = plant.a22 * self._velocity + plant.b2 * total
        self._one_tick(ticks)

    def _new_plant(self) -> None:
        plant, random = self.axis.settings.plant, self.random
        self._plant = Plant(
            plant.gain * random.uniform(1.0 - MODEL_ERROR, 1.0 + MODEL_ERROR),
            plant.pole * random.uniform(1.0 - MODEL_ERROR, 1.0 + MODEL_ERROR),
        ).discretise(self._period_s)
        self._plant_ends = self._tick + _PLANT_LIFE_TICKS
