"""Compares what a drive says of its state in two messages: the heartbeat's state and the bits of the feedback."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from twostage_servo.axis.settings import AxisSettings


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


@dataclass(slots=True)
class StatesSeen:
    """What the two messages have said: all of it goes on when the settings change.

    Attributes
    ----------
    reported
        What the feedback says: whether the drive is enabled, and faulted.
    ticks_since_change
        Ticks since that has changed.
    claim
        What a heartbeat says that contradicts it; None where none does.
    heard
        Heartbeats that do.
    first_ticks_ago
        Ticks since the first of them.
    report_since_heartbeat
        Whether feedback has come since the latest heartbeat.
    """

    reported: tuple[bool | None, bool | None] = (None, None)
    ticks_since_change: int = 0
    claim: DriveState | None = None
    heard: int = 0
    first_ticks_ago: int = 0
    report_since_heartbeat: bool = False


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
    known
        What the two messages have said so far.
    new
        What a heartbeat of this tick claims, if there was one.
    """

    def __init__(self, settings: AxisSettings, period_s: float) -> None:
        period_ms = 1e3 * period_s
        self._period_ms = period_ms
        self._patience = math.ceil(settings.limits.heartbeat_ms / period_ms)
        self._patience_told = math.ceil(settings.arming_timeout_ms / period_ms)
        self.known = StatesSeen()
        self.new: DriveState | None = None

    def begin_tick(self) -> None:
        """Open a tick, in which no heartbeat has come yet."""
        self.new = None

    def record(self, state: DriveState | None) -> None:
        """Record the state of a heartbeat; the newest of a tick counts."""
        self.new = state

    def forget(self) -> None:
        """Start afresh, as after the bus was lost."""
        self.new = self.known.claim = None
        self.known.heard = self.known.first_ticks_ago = self.known.ticks_since_change = 0
        self.known.report_since_heartbeat = False

    def continue_from(self, former: "DriveStateComparison") -> None:
        """Continue from the state of a former comparison of the same drive."""
        self.known = replace(former.known)

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
        known = self.known
        known.ticks_since_change += 1 + missed
        known.first_ticks_ago += 1 + missed
        # A drive without the bit that is told to be off has other means to say that it is not: the watch on it.
        reported = (told_enabled or None) if enabled is None else enabled, faulted
        if reported != known.reported:
            known.reported, known.ticks_since_change = reported, 0
            known.claim, known.heard = None, 0
        known.report_since_heartbeat = known.report_since_heartbeat or has_reported
        state = self.new
        if state is None or not known.report_since_heartbeat:
            return
        known.report_since_heartbeat = False
        if enabled is None and known.ticks_since_change <= self._patience_told:
            return
        if not _contradicts(state, *reported):
            known.claim, known.heard = None, 0
            return
        if known.claim is None:
            known.first_ticks_ago = 0
        known.claim = state
        known.heard += 1

    @property
    def contradiction(self) -> str | None:
        """What the two messages say, if they contradict each other lastingly; else None."""
        known = self.known
        if known.claim is None or known.heard < 3 or known.first_ticks_ago < self._patience:
            return None
        enabled, faulted = known.reported
        told = {True: "enabled", False: "disabled", None: "in no known state"}[enabled]
        fault = {True: " with a fault", False: " without a fault", None: ""}[faulted]
        return (
            f"for {known.first_ticks_ago * self._period_ms:g} ms the drive's heartbeat has said {known.claim.text!r}, "
            f"but its feedback has said {told}{fault}"
        )


def _contradicts(state: DriveState, enabled: bool | None, faulted: bool | None) -> bool:
    if state.enabled is not None and enabled is not None and state.enabled is not enabled:
        return True
    if state.faulted and faulted is False:
        return True
    # Beside a fault that is over but not yet acknowledged, a drive may be in any state but an enabled one.
    return bool(state.enabled and faulted)
