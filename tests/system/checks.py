"""What the scenarios have in common: how an axis is moved, what must hold of it, and how it recovers."""

import contextlib
import time
from collections.abc import Callable
from typing import Any, Final

from tools.rig.bench import Bench, run
from twostage_servo.api.requests import ArmRequest, MoveRequest
from twostage_servo.client.errors import Refused

Figures = dict[str, Any]

_BIT_RATE: Final = "500000"
IDLE_SHARE: Final = 0.5
"""Of a core: more than the ticks of both axes take on a busy host. A loop that does not wait takes a whole one."""


def check(holds: bool, what: str, **seen: Any) -> None:
    """Fail unless something holds."""
    if not holds:
        raise AssertionError(f"{what}: {seen}" if seen else what)


def up(channel: str, restart_ms: int = 0) -> None:
    """Bring a board's interface up."""
    run("ip", "link", "set", channel, "up", "type", "can", "bitrate", _BIT_RATE, "restart-ms", str(restart_ms))


def disarmed(shown: Figures) -> bool:
    """Whether an axis is disarmed, with its drive disabled, its bus open, and hears its drive."""
    return shown["axis"]["state"] == "disarmed" and _is_heard(shown)


def shows(text: str) -> Callable[[Figures], bool]:
    """Return what tells whether an axis shows a text as its bus' error."""
    return lambda shown: text in (shown["bus"]["error"] or "")


def controller_is(state: str) -> Callable[[Figures], bool]:
    """Return what tells whether the controller is in a state."""
    return lambda shown: bool(shown["bus"]["controller"] == state)


def _is_heard(shown: Figures) -> bool:
    return shown["bus"]["open"] and shown["axis"]["position"] is not None


def recover(bench: Bench, axis: str) -> Figures:
    """Reset a tripped axis, and see that it is disarmed then and stays where it is."""
    bench.until(axis, "the bus is open and the drive heard", _is_heard)
    try:
        answer = bench.request(ArmRequest(axis=axis))
    except Refused:
        answer = None
    check(answer is None, "a tripped axis cannot be armed", answer=answer and answer["axis"])
    bench.operate("reset", "--axis", axis)
    bench.until(axis, "disarmed after reset", disarmed)
    before = bench.ask(axis)["axis"]["position"]
    time.sleep(1.0)
    after = bench.ask(axis)["axis"]
    check(after["state"] == "disarmed" and abs(after["position"] - before) < 0.01, "nothing moves", **after)
    return {"position_mm": after["position"]}


def move(bench: Bench, axis: str, position: float) -> None:
    """Arm an axis and let it set out."""
    bench.request(ArmRequest(axis=axis))
    bench.until(axis, "holding", lambda one: one["axis"]["state"] == "holding")
    bench.request(MoveRequest(axis=axis, position=position))
    bench.until(axis, "moving", lambda one: abs(one["axis"]["velocity"] or 0.0) > 50.0)


def tripped(bench: Bench, axis: str, code: str, cause: str) -> float:
    """Wait for a trip, and see what it says; return how long it took, s."""
    took = bench.until(axis, f"trips as {code}", lambda one: bool(one["trip"]))
    trip = bench.ask(axis)["trip"]
    check(trip["code"] == code and cause in trip["cause"], f"trips as {code}: {cause}", **trip)
    return took


def restore(bench: Bench) -> None:
    """Mend what a scenario that failed has left, as far as it can be."""
    for act in (
        lambda: run("tc", "qdisc", "del", "dev", "can0", "root"),
        lambda: up("can0"),
        lambda: bench.operate("stop"),
        lambda: bench.operate("reset"),
        lambda: bench.operate("disarm"),
    ):
        with contextlib.suppress(AssertionError):  # it was not needed, or does not help: the next scenario will tell
            act()
    time.sleep(3.0)
