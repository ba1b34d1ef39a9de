"""Compares what a drive says of its state in two messages: the heartbeat's state and the bits of the feedback."""

import math
from typing import NamedTuple

from twostage_servo.axis.settings import AxisSettings

_KNOWLEDGE = (
    "_claim", "_first_ticks_ago", "_heard", "_report_since_heartbeat", "_reported", "_ticks_since_change", "state",
)  # fmt: skip


class DriveState(NamedTuple):
    """What the state of a heartbeat claims, in the terms of CiA 402 (IEC 61800-7-201).

    Attributes
    ----------
    text
        The state's name.
    enabled
        Whether the drive is enabled in it; None where that differs from drive to drive.
    faulted
        Whether it has a fault; None if the name says nothing about that.
    """

    text: str
    enabled: bool | None
    faulted: bool | None


_CLAIMS: dict[str, tuple[bool | None, bool | None]] = {
    "not ready to switch on": (False, False),
    "switch on disabled": (False, False),
    "ready to switch on": (False, False),
    # The power may be on already, and what a drive's own bit says then differs.
    "switched on": (None, False),
    "operation enabled": (True, False),
    "quick stop active": (None, False),
    "fault reaction active": (None, True),
    "fault": (False, True),
}


def interpret(text: str) -> DriveState | None:
    """Return what the name of a state claims; None if it is none of CiA 402's."""
    claims = _CLAIMS.get(" ".join(text.replace("_", " ").lower().split()))
    return None if claims is None else DriveState(text, *claims)


class DriveStateComparison:
    """Finds out whether heartbeat and feedback contradict each other for longer than any change of state takes.

    Either may be a little behind the other, so a contradiction counts from the first heartbeat that says so, as long as
    the feedback says the same all the time and each heartbeat contradicts it. It lasts when that has gone on for
    ``axis.limits.heartbeat_ms``, in which a heartbeat comes for certain, and three heartbeats have said so. A heartbeat
    counts only if feedback has come since the one before.

    A drive without a bit that says whether it is enabled is taken at what it was told, for as long as it has to follow.

    Parameters
    ----------
    settings
        Time-outs of the axis.
    period_s
        Length of a tick in s.

    Attributes
    ----------
    state
        What the latest heartbeat claims; None before the first, and where the drive's states are not CiA 402's.
    new
        What a heartbeat of this tick claims, if there was one.
    """

    def __init__(self, settings: AxisSettings, period_s: float) -> None:
        period_ms = 1e3 * period_s
        self._period_ms = period_ms
        self._patience = math.ceil(settings.limits.heartbeat_ms / period_ms)
        self._patience_told = math.ceil(settings.arming_timeout_ms / period_ms)
        self.state: DriveState | None = None
        self.new: DriveState | None = None
        self._reported: tuple[bool | None, bool | None] = (None, None)
        self._ticks_since_change = 0
        self._claim: DriveState | None = None  # that contradicts the feedback
        self._heard = 0  # heartbeats that did
        self._first_ticks_ago = 0
        self._report_since_heartbeat = False

    def begin_tick(self) -> None:
        """Open a tick, in which no heartbeat has come yet."""
        self.new = None

    def record(self, state: DriveState | None) -> None:
        """Record the state of a heartbeat; the newest of a tick counts."""
        self.state = self.new = state

    def forget(self) -> None:
        """Start afresh, as after the bus was lost."""
        self.state = self.new = self._claim = None
        self._heard = self._first_ticks_ago = self._ticks_since_change = 0
        self._report_since_heartbeat = False

    def continue_from(self, former: "DriveStateComparison") -> None:
        """Continue from the state of a former comparison of the same drive."""
        for name in _KNOWLEDGE:
            setattr(self, name, getattr(former, name))

    def compare(
        self, missed: int, enabled: bool | None, faulted: bool | None, *, has_reported: bool, told_enabled: bool
    ) -> None:
        """Compare, once a tick.

        Parameters
        ----------
        missed
            Ticks that were missed just before it.
        enabled, faulted
            What the feedback says; None where the drive has no such bit.
        has_reported
            Whether feedback has come in this tick.
        told_enabled
            Whether the drive is told to be enabled.
        """
        self._ticks_since_change += 1 + missed
        self._first_ticks_ago += 1 + missed
        # A drive without the bit that is told to be off has other means to say that it is not: the watch on it.
        reported = (told_enabled or None) if enabled is None else enabled, faulted
        if reported != self._reported:
            self._reported, self._ticks_since_change = reported, 0
            self._claim, self._heard = None, 0
        self._report_since_heartbeat = self._report_since_heartbeat or has_reported
        state = self.new
        if state is None or not self._report_since_heartbeat:
            return
        self._report_since_heartbeat = False
        if enabled is None and self._ticks_since_change <= self._patience_told:
            return
        if not _contradicts(state, *reported):
            self._claim, self._heard = None, 0
            return
        if self._claim is None:
            self._first_ticks_ago = 0
        self._claim = state
        self._heard += 1

    @property
    def contradiction(self) -> str | None:
        """What the two messages say, if they contradict each other lastingly; else None."""
        if self._claim is None or self._heard < 3 or self._first_ticks_ago < self._patience:
            return None
        enabled, faulted = self._reported
        told = {True: "enabled", False: "disabled", None: "in no known state"}[enabled]
        fault = {True: " with a fault", False: " without a fault", None: ""}[faulted]
        return (
            f"for {self._first_ticks_ago * self._period_ms:g} ms the drive's heartbeat has said {self._claim.text!r}, "
            f"and its feedback {told}{fault}"
        )


def _contradicts(state: DriveState, enabled: bool | None, faulted: bool | None) -> bool:
    if state.enabled is not None and enabled is not None and state.enabled is not enabled:
        return True
    if state.faulted and faulted is False:
        return True
    # Beside a fault that is over but not yet acknowledged, a drive may be in any state but an enabled one.
    return bool(state.enabled and faulted)
