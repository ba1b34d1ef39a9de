"""When a sample was taken, and what it would have been at the instant for which the observer wants it."""

from twostage_servo.axis.drive_report import DriveReport
from twostage_servo.control.observer import DisturbanceObserver


class SampleDate:
    """Dates the sample of each tick by the age that the drive's report has.

    Parameters
    ----------
    observer
        The estimate.
    drive
        What the drive reports.
    period_s
        Length of a tick in s.

    Attributes
    ----------
    lag_s
        How much older than usual this tick's sample is, where that is less than a period; in s.
    dating
        What is added to it for that, in axis unit.
    lag_periods
        How much older it is where it was taken before missed ticks, in periods.
    """

    __slots__ = ("_drive", "_missed", "_observer", "_path", "_period_s", "dating", "lag_periods", "lag_s")

    def __init__(self, observer: DisturbanceObserver, drive: DriveReport, period_s: float) -> None:
        self._observer = observer
        self._drive = drive
        self._period_s = period_s
        self._missed = 0
        self._path: list[float] = []  # the estimate before the ticks that were missed just now, and after each of them
        self.lag_s = self.dating = 0.0
        self.lag_periods = 0

    def begin_tick(self, missed: int) -> None:
        """Open a tick, before which some were missed."""
        self._missed = missed
        if not missed:
            self._path.clear()

    def begin_gap(self) -> None:
        """Remember the estimate before ticks that were missed."""
        self._path = [self._observer.position]
        self.lag_s = self.dating = 0.0

    def record_missed(self) -> None:
        """Remember the estimate after one of them."""
        self._path.append(self._observer.position)

    def sample(self, effort: float) -> float | None:
        """Return this tick's sample as it was at the deadline of the last command, which is when the observer wants it.

        Parameters
        ----------
        effort
            What acted around that instant, before that command: in effort unit.
        """
        drive = self._drive
        self.lag_periods, self.lag_s, self.dating = 0, 0.0, 0.0
        if not drive.fresh or drive.position is None:
            return None
        if drive.age_s is None:
            # After missed ticks nobody knows which of them a sample without a date belongs to.
            return None if self._missed else drive.position
        lag = drive.age_s / self._period_s - 1.0
        if not self._missed or lag <= 0.5:
            self.lag_s = lag_s = self._period_s * lag
            observer = self._observer
            plant, velocity = observer.plant, observer.velocity
            change = plant.b2 * (effort + observer.disturbance) - (1.0 - plant.a22) * velocity  # in a period
            self.dating = (velocity - 0.5 * change * lag) * lag_s
            return drive.position + self.dating
        self.lag_periods = min(round(lag), len(self._path) - 1)
        return drive.position + self._observer.position - self._estimate_before(lag)

    def _estimate_before(self, periods: float) -> float:
        """Return where the estimate was some periods ago, among the ticks that were missed; in axis unit.

        In that time the speed may have changed by much, so that it would not do to go back by the present one.
        """
        place = max(0.0, len(self._path) - 1 - periods)
        before = int(place)  # never the last: such a sample is of before the last tick that was missed
        return self._path[before] + (place - before) * (self._path[before + 1] - self._path[before])
