"""What has to be true after a fault, beside reaction and travel; each check returns what is wrong, or None."""

import itertools
from collections.abc import Awaitable, Callable, Sequence

from twostage_servo.axis.motion import IMPLAUSIBLE_SAMPLES
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.state import LATCHED, State
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.laws.paper import SPEED_TOLERANCE
from twostage_servo.faults.drive_faults import creep
from twostage_servo.faults.servo_gains import follows_a_plan, servo_gains_of
from twostage_servo.faults.world import Sample, World

Check = Callable[[World], Awaitable[str | None]]

_PATIENCE_S = 3.0
"""How long an operator waits for what a request should lead to."""
_OFF_THE_SWITCH_WINDOWS = 20.0
"""How far the axis is moved off a limit switch, in position windows."""

_LATCHED = frozenset(state.value for state in LATCHED)


async def arrived(world: World) -> str | None:
    """Check that the move was carried out."""
    move = world.axis.move
    return None if move is None or move.outcome is MoveOutcome.REACHED else f"the move was {move.outcome}"


async def bus_error_reported(world: World) -> str | None:
    """Check that the controller's state is known."""
    state = world.axis_loop.bus.link.controller_state
    return None if state == "passive" else f"the controller's state is reported as {state}"


async def came_back_disarmed(world: World) -> str | None:
    """Check that the bus is open again, and nothing has been armed by that."""
    if world.axis_loop.bus.error is not None:
        return f"the bus is not open again: {world.axis_loop.bus.error}"
    if world.axis.state not in {State.TRIPPED, State.DISARMED, State.HOLDING}:
        return f"the axis is {world.axis.state}"
    return "the drive is enabled" if world.axis.state is State.TRIPPED and world.drive.enabled else None


async def rejected_some(world: World) -> str | None:
    """Check that the frames were counted, each with a reason."""
    counters = world.axis_loop.bus.link.counters
    if counters.rejected == 0:
        return "no frame was counted as rejected"
    by_reason = sum(counters.rejected_by_reason.values())
    return None if by_reason == counters.rejected else f"{counters.rejected} rejected, {by_reason} with a reason"


async def needs_homing(world: World) -> str | None:
    """Check that positions are no longer trusted, if the axis was armed."""
    if world.axis.trip is None:
        return None
    return "the axis still trusts its position" if world.axis.referenced else None


async def right_or_not_trusted(world: World) -> str | None:
    """Check that the axis is where it says it is, or does not trust its position."""
    axis = world.axis
    await world.until(lambda: not axis.drive.is_stale, _PATIENCE_S)
    await world.seconds(5.0 * world.period_s)
    if not axis.referenced:
        return None
    apart = abs((axis.drive.position or 0.0) - world.drive.position)
    allowed = axis.settings.limits.innovation_gate
    return None if apart <= allowed else f"the axis trusts its position, which is off by {apart:.4g}"


async def trips_early(world: World) -> str | None:
    """Check that the trip came before the axis had gone ten times the innovation gate: 5 mm with 0.5 mm.

    On a long tick it goes farther in the samples that it takes, at its cruise velocity: the fault falls before them.
    """
    tripped = list(itertools.takewhile(lambda sample: sample.state in _LATCHED, reversed(world.samples)))
    if not tripped:
        return None
    distance = abs(tripped[-1].position - world.fault_place)
    settings = world.axis.settings
    in_samples = (IMPLAUSIBLE_SAMPLES + 1) * world.period_s * settings.cruise_velocity
    allowed = max(10.0 * settings.limits.innovation_gate, in_samples)
    return None if distance <= allowed else f"it was noticed after {distance:.3g}, {allowed:.3g} is allowed"


async def within_stall_effort(world: World) -> str | None:
    """Check that a stall trips in its time, and that the effort against it is no more than the law comes to by then.

    It has to trip when the effort has changed by the stall effort, or the samples of a stall time show no motion, and
    that has lasted for the stall time; beside that, a sample is read a tick after it was taken, the fault may fall just
    behind one, and an axis that is only setting out has no way to make in its first tick.

    Until then the effort starts from where it was. What stands still gives back the velocity's part, ``f12 x2``, and
    the estimate may swing as far to the other side. The sum adds f22 a tick for each unit that is missing: of speed,
    the move's at most, or of the distance in the position stage. A law that follows a plan goes on with the efforts of
    the plan, which are those of the same move without the fault, and adds less than what tells a stall; one that stops
    in mid-motion gives back the velocity's part at once, in loops as quick as the tick allows, up to the effort limit.
    Where that is more than the feedback of the paper's law comes to, its efforts add up to no more than those of that
    law would. After the trip no more is allowed than the quick stop's ramp takes without friction.
    """
    design, limits = world.axis.design, world.axis.settings.limits
    stall_ticks = design.ticks(limits.stall_time_ms)
    after = [sample for sample in world.samples if sample.time_s > world.begun_s]
    stuck = list(itertools.takewhile(lambda sample: sample.state not in _LATCHED, after))
    if len(stuck) == len(after):
        return "the stall was not noticed"
    before = next(sample for sample in reversed(world.samples) if sample.time_s <= world.begun_s)
    closing = before.state == State.POSITION_STAGE.value
    gains = servo_gains_of(design)
    rise = abs(gains.f22) * (abs(world.target - world.fault_place) if closing else world.velocity)
    ticks = max(stall_ticks, limits.stall_effort / rise) + stall_ticks + 3.0
    # While the speed reference is on its ramp, half as much is missing.
    ramp_ticks = 0.0 if closing else world.velocity / limits.acceleration / design.period_s
    if len(stuck) > ticks + 0.5 * ramp_ticks:
        return f"the stall was noticed after {len(stuck)} ticks, {ticks + 0.5 * ramp_ticks:.1f} are allowed"
    most = abs(before.effort) + 2.0 * abs(gains.f12 * before.velocity) + rise * ticks
    if follows_a_plan(design):
        # Beyond that for no longer than an effort that rises to it evenly comes to, from what tells a stall on.
        push = sum(abs(sample.effort) for sample in stuck)
        allowed_push = 0.5 * (abs(before.effort) + most) * (2.0 * stall_ticks + 3.0 + 0.5 * ramp_ticks)
        if max(abs(sample.effort) for sample in stuck) > most and push > allowed_push:
            return f"the efforts against the stall add up to {push:.4g} a tick, {allowed_push:.4g} is allowed"
        planned = max(abs(sample.effort) for sample in world.undisturbed) + limits.stall_effort
        most = max(most, planned if abs(before.velocity) <= design.rest_velocity else limits.effort)
    braking = max(most, limits.quick_stop_deceleration / abs(world.axis.settings.plant.gain))
    for samples, allowed in ((stuck, most), (after[len(stuck) :], braking)):
        largest = max((abs(sample.effort) for sample in samples), default=0.0)
        if largest > allowed:
            return f"the effort against the stall rose to {largest:.4g}, {allowed:.4g} is allowed"
    return None


async def told_in_time(world: World) -> str | None:
    """Check that the effort has not stood at its limit for longer than its time when the axis trips."""
    limits = world.axis.settings.limits
    allowed = world.axis.design.ticks(limits.effort_saturation_ms)
    driven = list(itertools.takewhile(lambda sample: sample.state not in _LATCHED, world.samples))
    if len(driven) == len(world.samples):
        return "the effort at its limit was not noticed"
    at_limit = itertools.takewhile(lambda sample: abs(sample.effort) >= limits.effort, reversed(driven))
    ticks = sum(1 for _ in at_limit)
    return None if ticks <= allowed else f"the effort was at its limit for {ticks} ticks, {allowed} are allowed"


async def still_seen(world: World) -> str | None:
    """Check that the position is tracked after the power is off."""
    position = world.axis.drive.position
    if world.axis.drive.is_stale or position is None:
        return "the position is no longer seen"
    apart = abs(position - world.drive.position)
    resolution = 2.0 * max(world.axis_loop.drive.traits.position_quantum, world.simulation.quantum)
    return None if apart <= resolution + world.axis.settings.window.position else f"the position is off by {apart:.4g}"


async def only_off_the_switch(world: World) -> str | None:
    """Check that an operator who resets and arms is refused motion towards the switch, and gets off it."""
    axis, state = world.axis, world.axis.state
    for request, wanted in (("reset", State.TRIPPED), ("arm", State.DISARMED)):
        if state is wanted:
            await world.until(lambda: axis.state is State.TRIPPED or axis.ready_to_arm, _PATIENCE_S)
            if code := world.clients.ask({"op": request}):
                return f"`{request}` was refused after the trip: {code}"
            state = State.DISARMED
    if not await world.until(lambda: axis.state is State.HOLDING, _PATIENCE_S):
        return f"the axis does not hold after it was armed: it is {axis.state}"
    place = world.place()
    way = world.heading * _OFF_THE_SWITCH_WINDOWS * axis.settings.window.position
    for towards in ({"op": "move", "by": way}, {"op": "jog", "velocity": world.heading * world.velocity}):
        if (code := world.clients.ask(towards)) != RefusalCode.LIMIT_SWITCH:
            return f"`{towards['op']}` towards the switch was {f'refused: {code}' if code else 'carried out'}"
    if code := world.clients.ask({"op": "move", "by": -way}):
        return f"a move off the switch was refused: {code}"
    await world.until(lambda: axis.state in {State.HOLDING, State.TRIPPED}, 10.0 * _PATIENCE_S)
    if axis.trip is not None:
        return f"the move off the switch tripped: {axis.trip.cause}"
    gone = world.place() - place
    apart = abs(gone + way)
    allowed = 2.0 * axis.settings.window.position
    return None if apart <= allowed else f"a move off the switch by {-way:.4g} went {gone:.4g}"


async def ended_with_an_error(world: World) -> str | None:
    """Check that the service ended with the defect, so that its process exits with a code other than zero."""
    serving = world.serving
    if not serving.done():
        return "the service continues"
    error = serving.exception()
    return None if isinstance(error, RuntimeError) else f"the service ended with {error!r}"


async def refused_all(world: World) -> str | None:
    """Check that every request of the fault was refused."""
    carried_out = sum(answer is None for answer in world.refusals)
    if not world.refusals:
        return "no request was sent"
    return f"{carried_out} of {len(world.refusals)} requests were carried out" if carried_out else None


async def continuous(world: World) -> str | None:
    """Check that a new set-point in motion is taken without a bump in the effort.

    In the first tick after it, the effort is what it would have been without it, but for what the law's sum adds in a
    tick for the other set-point. The position stage begins at the change-over distance p = f11 T v / f22, equation
    (19), so that is f22 p = f11 T v at most, and the same if the speed stage takes over, which does not count the way
    of that tick; more by the share by which the axis may be faster than its set-point asks for. A law that follows a
    plan begins in that tick what the new one asks for: an acceleration where it braked, at most, which is twice the
    step of an acceleration from rest, and more by the same share.

    No later step is larger than a turn takes. The response is linear, so a turn from v to -v, which is twice the change
    of speed from rest to v, takes twice the largest step of the same move without the new set-point, and what that move
    had under way adds one. Limits only take away from it; where they took away from that move as well, as a low limit
    of the acceleration does, the sum's tick and one usual step may be more than that.
    """
    axis = world.axis
    usual = {round(sample.time_s, 6): sample for sample in world.undisturbed}
    after = [sample for sample in world.samples if sample.time_s > world.fault_s]
    if not after or round(after[0].time_s, 6) not in usual:
        return "the tick of the new set-point cannot be compared with one without it"
    apart = abs(after[0].effort - usual[round(after[0].time_s, 6)].effort)
    speed = max(world.velocity, *(abs(sample.velocity) for sample in world.undisturbed))
    tick_of_the_sum = abs(servo_gains_of(axis.design).f11) * world.period_s * speed * (1.0 + SPEED_TOLERANCE)
    largest, usual_step = _largest_step(world.samples), _largest_step(world.undisturbed)
    turn = 2.0 * usual_step * (1.0 + SPEED_TOLERANCE)
    at_once = max(tick_of_the_sum, turn) if follows_a_plan(axis.design) else tick_of_the_sum
    if apart > at_once + 1e-9:
        return f"the new set-point changes the effort by {apart:.4g} at once, {at_once:.4g} is allowed"
    most = max(3.0 * usual_step, usual_step + tick_of_the_sum)
    if largest > most + 1e-9:
        return f"the effort jumped by {largest:.4g} in a tick, {most:.4g} is allowed"
    return None


def _largest_step(samples: Sequence[Sample]) -> float:
    return max((abs(b.effort - a.effort) for a, b in itertools.pairwise(samples)), default=0.0)


async def log_dropped(world: World) -> str | None:
    """Check that lines were dropped and counted, and nothing waited for them."""
    return None if world.log is not None and world.log.dropped > 0 else "no line was counted as dropped"


async def still_enabled_is_told(world: World) -> str | None:
    """Check that a drive that stays enabled is told as long as it lasts, and that no reset is possible until then."""
    axis = world.axis
    if TripCode.DRIVE_NOT_DISABLED not in axis.trips:
        return f"the trips are {', '.join(axis.trips) or 'none'}"
    if (code := world.clients.ask({"op": "reset"})) != TripCode.DRIVE_NOT_DISABLED:
        return f"`reset` was {f'refused: {code}' if code else 'carried out'} while the drive is enabled"
    world.change(stays_enabled=False)
    await world.until(lambda: not axis.lasting, _PATIENCE_S)
    if code := world.clients.ask({"op": "reset"}):
        return f"`reset` was refused when the drive was disabled: {code}"
    return None


async def told_how_far(world: World) -> str | None:
    """Check that motion while the drive is off is told with its distance, and trips nothing."""
    axis, gate = world.axis, world.axis.settings.limits.innovation_gate
    if axis.state is State.HOLDING:  # an axis that was armed in the meantime is disarmed once more
        axis.disarm()
        await world.seconds(_PATIENCE_S)
        creep(world)
    place = world.place() if axis.disabled.moved is None else world.place() - axis.disabled.moved
    await world.until(lambda: world.drive.faults.effort_while_disabled == 0.0, 1e3)
    await world.seconds(_PATIENCE_S)
    if axis.trip is not None:
        return f"it tripped: {axis.trip.cause}"
    moved = axis.disabled.moved
    if moved is None:
        return "the motion of the axis is not reported"
    apart = abs(world.place() - place - moved)
    return None if apart <= gate else f"the reported motion of {moved:.4g} is off by {apart:.4g}"
