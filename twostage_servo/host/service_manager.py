"""Check of the service manager: whether it waits until the axes are at rest."""

import re
from typing import Final

from twostage_servo.host.findings import Finding, Host, Status

UNIT: Final = "twostage-servo.service"

_NAME: Final = "service manager"
_PROPERTIES: Final = ("LoadState", "NotifyAccess", "TimeoutStopUSec")
_UNITS_S: Final = {
    "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0, "month": 2_629_800.0,
    "y": 31_557_600.0,
}  # fmt: skip


def service_manager_finding(host: Host, longest_end_s: float) -> Finding:
    """Check how long systemd waits for the service to end.

    Parameters
    ----------
    host
        Where to look.
    longest_end_s
        How long the service may take to end, in s.
    """
    command = ["systemctl", "show", UNIT, *(f"--property={name}" for name in _PROPERTIES)]
    try:
        shown = dict(line.partition("=")[::2] for line in host.run(command).splitlines())
    except OSError as error:
        why = "this host has no systemd" if isinstance(error, FileNotFoundError) else f"systemctl failed: {error}"
        return Finding(_NAME, Status.SKIP, why)
    if shown.get("LoadState") != "loaded":
        return Finding(_NAME, Status.SKIP, f"{UNIT} is not installed")
    waits_s = seconds(shown.get("TimeoutStopUSec", ""))
    if waits_s is None:
        return Finding(_NAME, Status.SKIP, f"systemd does not report how long it waits for {UNIT} to end")
    found = f"{UNIT} may take {longest_end_s:g} s to end; systemd waits for {waits_s:g} s (TimeoutStopSec=)"
    if waits_s >= longest_end_s:
        return Finding(_NAME, Status.OK, found)
    if shown.get("NotifyAccess") not in {"none", "", None}:
        return Finding(_NAME, Status.OK, f"{found}, and longer if the service asks for it")
    return Finding(
        _NAME, Status.WARN, f"{found}, then kills it, and ignores its requests for more time",
        f"`systemctl edit {UNIT}`: [Service] NotifyAccess=main, or TimeoutStopSec={longest_end_s:g}; or lower "
        "service.shutdown_timeout_ms",
    )  # fmt: skip


def seconds(text: str) -> float | None:
    """Return a time span as systemd shows it, such as ``1min 30s``, in s; None if it is none."""
    if text == "infinity":
        return float("inf")
    parts = re.findall(r"(\d+(?:\.\d+)?)([a-z]+)", text)
    if not parts or "".join("".join(part) for part in parts) != text.replace(" ", ""):
        return None
    if any(unit not in _UNITS_S for _, unit in parts):
        return None
    return sum(float(number) * _UNITS_S[unit] for number, unit in parts)
