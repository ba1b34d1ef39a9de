"""What has to be true after a fault, beside reaction and travel; each check returns what is wrong, or None."""

import itertools
from collections.abc import Callable

from twostage_servo.axis.messages import Refused
from twostage_servo.axis.state import LATCHED, State
from twostage_servo.faults.world import World

Check = Callable[[World], str | None]


def arrived(world: World) -> str | None:
    """Check that the move was carried out."""
    move = world.axis.move
    return None if move is None or move.outcome == "reached" else f"the move was {move.outcome}"


def bus_error_reported(world: World) -> str | None:
    """Check that the controller's state is known."""
    state = world.station.port.link.controller_state
    return None if state == "passive" else f"the controller's state is reported as {state}"


def came_back_disarmed(world: World) -> str | None:
    """Check that the bus is open again, and nothing has been armed by that."""
    if world.station.port.error is not None:
        return f"the bus is not open again: {world.station.port.error}"
    if world.axis.state not in {State.TRIPPED, State.DISARMED, State.HOLDING}:
        return f"the axis is {world.axis.state}"
    return "the drive is enabled" if world.axis.state is State.TRIPPED and world.drive.enabled else None


def rejected_some(world: World) -> str | None:
    """Check that the frames were counted, each with a reason."""
    counters = world.station.port.link.counters
    if counters.rejected == 0:
        return "no frame was counted as rejected"
    by_reason = sum(counters.rejected_by_reason.values())
    return None if by_reason == counters.rejected else f"{counters.rejected} rejected, {by_reason} with a reason"


def needs_homing(world: World) -> str | None:
    """Check that positions are no longer trusted, if the axis was armed."""
    if world.axis.trip is None:
        return None
    return "the axis still trusts its position" if world.axis.referenced else None


def noticed_early(world: World) -> str | None:
    """Check that the trip came before the axis had gone ten times the innovation limit: 5 mm with 0.5 mm."""
    latched = {state.value for state in LATCHED}
    allowed = 10.0 * world.axis.settings.limits.innovation
    tripped = list(itertools.takewhile(lambda sample: sample.state in latched, reversed(world.samples)))
    if not tripped:
        return None
    distance = abs(tripped[-1].position - world.fault_place)
    return None if distance <= allowed else f"it was noticed after {distance:.3g}, {allowed:.3g} is allowed"


def within_jam_effort(world: World) -> str | None:
    """Check that the effort against the jam stayed below that of the cruise, the jam and the braking together."""
    settings = world.axis.settings
    limits = settings.limits
    cruise = abs(world.velocity * settings.plant.pole / settings.plant.gain)
    braking = limits.quick_stop_deceleration / abs(settings.plant.gain)
    most = min(limits.effort, cruise + limits.jam_effort + braking)
    largest = max(abs(sample.effort) for sample in world.samples)
    return None if largest <= most + 1e-9 else f"the effort rose to {largest:.4g}, {most:.4g} is allowed"


def still_seen(world: World) -> str | None:
    """Check that the position is tracked after the power is off."""
    position = world.axis.drive.position
    if world.axis.drive.is_stale or position is None:
        return "the position is not seen any more"
    apart = abs(position - world.drive.position)
    return None if apart <= 2e-3 + world.axis.settings.window.position else f"the position is off by {apart:.4g}"


def only_off_the_switch(world: World) -> str | None:
    """Check that after the trip motion towards the switch is refused and motion off it is taken."""
    axis = world.axis
    if axis.trip is None:
        return None
    try:
        axis.reset()
    except Refused as refused:
        return f"reset was refused: {refused}"
    axis.referenced = True
    blocked, free = axis.drive.blocks(world.heading), axis.drive.blocks(-world.heading)
    return None if blocked and not free else f"towards it {'blocked' if blocked else 'free'}, off it {free or 'free'}"


def ended_with_an_error(world: World) -> str | None:
    """Check that the service ended with the defect, so that its process exits with a code other than zero."""
    serving = world.serving
    if serving is None or not serving.done():
        return "the service goes on"
    error = serving.exception()
    return None if isinstance(error, RuntimeError) else f"the service ended with {error!r}"


def refused_all(world: World) -> str | None:
    """Check that every request of the fault was refused."""
    carried_out = sum(answer is None for answer in world.refusals)
    if not world.refusals:
        return "nothing was asked"
    return f"{carried_out} of {len(world.refusals)} requests were carried out" if carried_out else None


def continuous(world: World) -> str | None:
    """Check that the effort followed without a jump: no step larger than what the rate limit allows."""
    largest_step = world.axis.settings.limits.effort_rate * world.period_s
    steps = [abs(b.effort - a.effort) for a, b in zip(world.samples, world.samples[1:], strict=False)]
    worst = max(steps, default=0.0)
    return None if worst <= largest_step + 1e-9 else f"the effort jumped by {worst:.4g}"


def log_dropped(world: World) -> str | None:
    """Check that lines were dropped and counted, and nothing waited for them."""
    return None if world.log is not None and world.log.dropped > 0 else "no line was counted as dropped"


def expected_after_the_holder(policy: str) -> str:
    """Return the reaction to a lost holder of the lease, under ``service.holder_lost``."""
    return {"continue": "T", "stop": "H", "disarm": "H"}[policy]
