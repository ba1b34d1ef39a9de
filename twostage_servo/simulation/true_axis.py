"""The true axis behind the drive: plant, load, hard stops, switches, and the marks that its encoder passes."""

from math import ceil, floor, inf

from twostage_servo.simulation.coupling import Coupling
from twostage_servo.simulation.faults import DriveFaults
from twostage_servo.simulation.plant import TruePlant
from twostage_servo.simulation.settings import SimulationSettings


class TrueAxis:
    """Moves exactly as effort and load have it; knows nothing of commands and frames.

    Position and velocity are those of the encoder, and so are switches and marks. With a resonance or backlash the
    encoder is on the load, behind them; effort, friction, load and hard stops act on the drive's side.

    Parameters
    ----------
    settings : SimulationSettings
        The true plant and where its stops, switches and marks are.
    start_s : float
        Present time, s.
    """

    def __init__(self, settings: SimulationSettings, start_s: float) -> None:
        self._settings = settings
        self._coupling = _coupling(settings)
        self._plant = TruePlant(
            settings.gain,
            settings.pole,
            settings.coulomb_friction,
            settings.initial_position,
            -inf if settings.hard_stop_minimum is None else settings.hard_stop_minimum,
            inf if settings.hard_stop_maximum is None else settings.hard_stop_maximum,
            self._coupling,
        )
        self._encoder_side = self._plant if self._coupling is None else self._coupling
        self._now_s = start_s
        self._load = 0.0
        self._load_due_s = start_s + settings.load_at_s
        self._faults = DriveFaults()
        self._passed_mark: float | None = None

    @property
    def position(self) -> float:
        """True position, axis unit."""
        return self._encoder_side.position

    @property
    def velocity(self) -> float:
        """True velocity, axis unit/s."""
        return self._encoder_side.velocity

    def advance(self, until_s: float, effort: float) -> None:
        """Move on to a time at constant effort.

        Raises
        ------
        ValueError
            If the time is before that of the last call.
        """
        if self._load_due_s <= until_s:
            self._move(self._load_due_s, effort)
            self._load = self._settings.load
            self._load_due_s = inf
        self._move(until_s, effort)

    def change(self, faults: DriveFaults) -> None:
        """Let other faults act from the time of the last :meth:`advance` on.

        Raises
        ------
        ValueError
            If no plant is left with them. Nothing has then changed.
        """
        friction = self._settings.coulomb_friction if faults.coulomb_friction is None else faults.coulomb_friction
        self._plant.change(self._settings.gain * faults.gain_factor, self._settings.pole * faults.pole_factor, friction)
        if faults.stalled:
            self._plant.halt()
        self._faults = faults

    @property
    def positive_limit(self) -> bool:
        """Whether the limit switch of larger positions is active."""
        forced, begins = self._faults.positive_limit, self._settings.positive_limit_from
        return begins is not None and self.position >= begins if forced is None else forced

    @property
    def negative_limit(self) -> bool:
        """Whether the limit switch of smaller positions is active."""
        forced, begins = self._faults.negative_limit, self._settings.negative_limit_from
        return begins is not None and self.position <= begins if forced is None else forced

    @property
    def home_switch(self) -> bool:
        """Whether the home switch is active."""
        forced, begins, ends = self._faults.home_switch, self._settings.home_switch_from, self._settings.home_switch_to
        if forced is not None:
            return forced
        return begins is not None and ends is not None and begins <= self.position <= ends

    def pop_passed_mark(self) -> float | None:
        """Return the true position of the index mark that was passed last, once; None when none was passed."""
        mark, self._passed_mark = self._passed_mark, None
        return mark

    def _move(self, until_s: float, effort: float) -> None:
        if until_s == self._now_s:
            return
        if not self._faults.stalled:
            start = self.position
            stop = self._plant.advance(until_s - self._now_s, effort - self._load - self._faults.load)
            if self._settings.index_at is not None:
                if self._coupling is None:
                    self._look_for_mark(self._settings.index_at, start, stop)
                    start = stop
                self._look_for_mark(self._settings.index_at, start, self.position)  # a load's turn between is not seen
        self._now_s = until_s

    def _look_for_mark(self, first_mark: float, start: float, end: float) -> None:
        """Note a mark on the way from start to end, the start excluded: a mark that it stopped at counts once."""
        pitch = self._settings.index_pitch
        if not pitch:
            if start < first_mark <= end or end <= first_mark < start:
                self._passed_mark = first_mark
            return
        # The same function of both ends: however a quotient is rounded, no mark counts twice in one direction.
        round_back = floor if end > start else ceil
        number = round_back((end - first_mark) / pitch)
        if number != round_back((start - first_mark) / pitch):
            self._passed_mark = first_mark + number * pitch


def _coupling(settings: SimulationSettings) -> Coupling | None:
    """Return what lies between drive and load; None where the load is fixed to the drive."""
    if not (settings.resonance_hz or settings.backlash):
        return None
    return Coupling(settings.resonance_hz, settings.resonance_damping, settings.backlash, settings.initial_position)
