"""What an axis under control is held to on every tick: limits, position window, and the response it is designed for."""

import math
from collections.abc import Iterator

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.two_stage import TwoStageLaw


class Supervision:
    """Compares the axis with its limits and with its nominal law, which runs on a model of the plant beside it.

    The following error is the distance between the two. It may be as large as the minimum, or proportional to the
    speed of the move: in the speed stage, which does not feed the position back, a plant that differs from its model
    drifts off in proportion to the speed.

    Parameters
    ----------
    design
        Limits, position window, units and gains.
    law, nominal
        The law that drives the axis, and the same law on the model.
    """

    __slots__ = (
        "_changeover_time_s", "_law", "_nominal", "_saturation_ticks", "_settings", "_speed_of_move",
        "_ticks_in_window", "_ticks_saturated", "_window_ticks",
    )  # fmt: skip

    def __init__(self, design: AxisDesign, law: TwoStageLaw, nominal: TwoStageLaw) -> None:
        settings = self._settings = design.settings
        self._law = law
        self._nominal = nominal
        self._saturation_ticks = math.ceil(settings.limits.effort_saturation_ms / (1e3 * design.period_s))
        self._window_ticks = math.ceil(settings.window.time_ms / (1e3 * design.period_s))
        self._changeover_time_s = design.gains.changeover_time_s(design.period_s)
        self._ticks_in_window = 0
        self.start()

    def start(self) -> None:
        """Begin afresh: at arming, and when a quick stop takes over."""
        self._ticks_saturated = 0
        self.forget_move()

    def forget_move(self) -> None:
        """Allow no more than at standstill from here on: the axis has arrived or come to rest."""
        self._speed_of_move = 0.0

    def begin_move(self) -> None:
        """Begin to wait for the position window anew."""
        self._ticks_in_window = 0

    def has_arrived(self, position: float) -> bool:
        """Whether a fresh measured position (axis unit) has been in the position window for its time; once a tick."""
        window = self._settings.window.position
        target, designed = self._law.target, self._nominal.observer
        # A slow response may cross the window for longer than its dwell: the designed one has to be at rest there too.
        inside = (
            abs(target - position) <= window
            and abs(target - designed.position) <= window
            and abs(designed.velocity) * self._changeover_time_s <= window
        )
        self._ticks_in_window = self._ticks_in_window + 1 if inside else 0
        return self._ticks_in_window > self._window_ticks

    @property
    def following_error(self) -> float:
        """Estimated position minus the position that the axis is designed to have now, in axis unit."""
        return self._law.observer.position - self._nominal.observer.position

    def is_inside(self, position: float, overrun: float) -> bool:
        """Whether a position (axis unit) is within the position limits, or past them by no more than the overrun."""
        limits = self._settings.limits
        return limits.position_minimum - overrun <= position <= limits.position_maximum + overrun

    def violations(self) -> Iterator[tuple[TripCode, str]]:
        """Yield code and cause of each limit that the axis breaks in this tick; call it once a tick."""
        limits, unit = self._settings.limits, self._settings.unit
        position, velocity = self._law.observer.position, self._law.observer.velocity
        if not abs(velocity) <= limits.overspeed:
            yield (
                TripCode.OVERSPEED,
                f"the estimated velocity is {velocity:.4g} {unit}/s; axis.limits.overspeed is {limits.overspeed:g}",
            )
        if not self.is_inside(position, limits.position_overrun):
            yield (
                TripCode.POSITION_LIMIT,
                (
                    f"the axis is at {position:.6g} {unit}; its limits are {limits.position_minimum:g} and "
                    f"{limits.position_maximum:g} {unit} with an overrun of {limits.position_overrun:g} {unit}"
                ),
            )
        error = self.following_error
        self._speed_of_move = max(self._speed_of_move, abs(self._nominal.observer.velocity))
        allowed = max(limits.following_error_minimum, limits.following_error_time_s * self._speed_of_move)
        if not abs(error) <= allowed:
            yield (
                TripCode.FOLLOWING_ERROR,
                (
                    f"at {position:.6g} {unit} the axis is {error:.4g} {unit} from where it is designed to be; "
                    f"{allowed:.4g} {unit} is allowed in a move at {self._speed_of_move:.4g} {unit}/s"
                ),
            )
        self._ticks_saturated = self._ticks_saturated + 1 if self._law.saturated else 0
        if self._ticks_saturated >= self._saturation_ticks:
            yield (
                TripCode.EFFORT_SATURATED,
                (
                    f"the effort has stood at its limit of {limits.effort:g} {self._settings.effort_unit} for "
                    f"{limits.effort_saturation_ms:g} ms at {velocity:.4g} {unit}/s: an unreachable speed, or a jam"
                ),
            )
