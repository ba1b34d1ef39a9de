"""Injections in the drive: its encoder, its power stage, its plant."""

import math
from collections.abc import Callable
from random import Random

from twostage_servo.axis.state import DRIVEN, State
from twostage_servo.faults.servo_gains import servo_gains_of
from twostage_servo.faults.world import World
from twostage_servo.timing.ticks import Tick

LARGEST_JUMP = 100.0
"""How far an encoder jumps at most, as a multiple of the innovation gate."""

WEAKNESS = 0.95
"""Share of the velocity that a plant which is too weak reaches at the effort limit."""

FAULT_STATE = "fault"
"""What a heartbeat says that contradicts its feedback, in the terms of CiA 402."""

CREEP_GATES = 4.0
"""How far an axis moves while its drive is off, as a multiple of the innovation gate."""

Injection = Callable[[World, Random], None]


def frozen(world: World, _: Random) -> None:
    """Let the encoder report the position of this moment for ever; its counter lives."""
    place = world.drive.position
    world.change(measure=lambda _position: place)


def spike(world: World, random: Random) -> None:
    """Let one sample be far off."""
    height = random.choice((-1.0, 1.0)) * random.uniform(20.0, 200.0) * world.axis.settings.limits.innovation_gate
    left = 1

    def measure(position: float) -> float:
        nonlocal left
        left -= 1
        return position + height if left == 0 else position

    world.change(measure=measure)


def jump(world: World, random: Random) -> None:
    """Let all samples be off by the same from now on."""
    limits = world.axis.settings.limits
    size = random.choice((-1.0, 1.0)) * random.uniform(4.0, LARGEST_JUMP) * limits.innovation_gate
    # While nothing drives the axis a hand may push it as far.
    pushed = (
        0.0 if world.axis.state in DRIVEN else 3.0 * world.period_s * limits.overspeed + 2.0 * limits.innovation_gate
    )
    height = math.copysign(max(abs(size), pushed), size)
    world.change(measure=lambda position: position + height)


def scaled(factor: float) -> Injection:
    """Let the encoder count another number of steps from where the axis is now; -1 turns it round."""

    def inject(world: World, _: Random) -> None:
        place = world.drive.position
        world.change(measure=lambda position: place + factor * (position - place))

    return inject


def not_a_number(world: World, _: Random) -> None:
    """Let the drive report that the position is invalid."""
    world.change(measure=lambda _position: math.nan)


def drift(world: World, _: Random) -> None:
    """Let the encoder drift by the position window in each second."""
    start_s, rate = world.now_s, world.axis.settings.window.position
    world.change(measure=lambda position: position + rate * (world.now_s - start_s))


def coarse(world: World, _: Random) -> None:
    """Let the encoder's steps be as wide as half the position window."""
    step = 0.5 * world.axis.settings.window.position
    world.change(measure=lambda position: round(position / step) * step)


def fault_bit(world: World, random: Random) -> None:
    """Let the drive latch a fault."""
    world.change(fault_code=random.randint(2, 9))


def reboot(world: World, _: Random) -> None:
    """Let the drive reboot: silent for 15 ms, disabled, and its encoder starts at 0."""
    world.drive.reboot(world.now_s, 0.015)
    world.node.wake()


def count_away_from_zero(world: World) -> None:
    """Let the encoder show as much more as the axis goes in a second, so that one that counts anew shows another count.

    To be called while the axis is disarmed and at rest, before it is told where it is.
    """
    offset = world.axis.settings.cruise_velocity
    world.change(measure=lambda position: position + offset)


def restart_with_the_old_boot_counter(world: World, _: Random) -> None:
    """Let the drive be off for twice as long as an armed axis goes without feedback; it does not count its boots."""
    limits = world.axis.settings.limits
    off_s = 2.0 * (limits.stale_feedback_ms / 1e3 + (limits.missed_ticks + 1) * world.period_s)
    world.change(measure=None)
    world.drive.reboot(world.now_s, off_s, counts=False)
    world.node.wake()


def ignore_effort(world: World, _: Random) -> None:
    """Let the drive go on with the effort of this moment; it still obeys Enable."""
    world.change(ignores_effort=True)


def too_weak(world: World, _: Random) -> None:
    """Let the plant need a little more effort than the limit for the velocity of the move."""
    limits, true = world.axis.settings.limits, world.simulation
    needed = abs(limits.velocity * true.pole / true.gain)
    world.change(gain_factor=WEAKNESS * needed / limits.effort)


def stall(world: World, _: Random) -> None:
    """Let the axis stand still at once."""
    world.change(stalled=True)


def load_step(world: World, random: Random) -> None:
    """Let a load act that deflects the holding axis by a third of the following error's minimum."""
    world.change(load=random.choice((-1.0, 1.0)) * tolerable_load(world))


def tolerable_load(world: World) -> float:
    """Return the load, in effort unit, that deflects the position stage by a third of the least following error.

    In the position stage a load step L moves the axis by less than L/f11, its deflection if the sum did nothing.
    """
    return world.axis.settings.limits.following_error_minimum / 3.0 * abs(servo_gains_of(world.axis.design).f11)


def another_plant(world: World, random: Random) -> None:
    """Let gain and pole change by up to 20 %, and friction come up to a tenth of the stall effort."""
    world.change(
        gain_factor=random.uniform(0.8, 1.2),
        pole_factor=random.uniform(0.8, 1.2),
        coulomb_friction=0.1 * world.axis.settings.limits.stall_effort,
    )


def safe_torque_off(world: World, _: Random) -> None:
    """Let somebody press the emergency stop."""
    world.change(safe_torque_off=True)


def limit_switch(world: World, _: Random) -> None:
    """Let the switch ahead become active: the positive one if the axis moves or will move that way."""
    ahead = world.heading
    world.change(positive_limit=ahead > 0.0, negative_limit=ahead < 0.0)


def heartbeat_stops(world: World, _: Random) -> None:
    """Let the heartbeat stop; the feedback goes on."""
    world.change(heartbeat_silent=True)


def repeat_counter(world: World, _: Random) -> None:
    """Let the alive counter stand still."""
    world.change(frozen_counter=True)


def wrap_ahead(world: World) -> None:
    """Shift what the encoder counts so that it wraps a little way ahead of here, and tell the axis where it is.

    To be called while the axis is disarmed and at rest.
    """
    period = world.axis_loop.drive.traits.position_period
    place = world.drive.position
    offset = period / 2.0 - place - world.wrap_in
    world.change(measure=lambda position: position + offset)


def stays_enabled(world: World, _: Random) -> None:
    """Let the operator disarm the axis, and the drive be enabled for good, though it obeys the effort."""
    world.axis.disarm()
    _once_disarmed(world, lambda: world.change(stays_enabled=True))


def moves_while_disabled(world: World, _: Random) -> None:
    """Let the operator disarm the axis, and something move it then though its drive is off: slowly, and for a way."""
    world.axis.disarm()
    _once_disarmed(world, lambda: creep(world))


def creep(world: World) -> None:
    """Let the axis move at half the speed that counts as standstill, for some widths of the innovation gate."""
    settings, speed = world.axis.settings, 0.5 * world.axis.design.rest_velocity
    world.change(effort_while_disabled=world.heading * speed * settings.plant.pole / settings.plant.gain)
    world.later(CREEP_GATES * settings.limits.innovation_gate / speed, lambda: world.change(effort_while_disabled=0.0))


def contradiction(world: World, _: Random) -> None:
    """Let the heartbeat say that the drive has a fault, while the feedback says that it has none."""
    texts = world.axis_loop.drive.traits.state_texts
    world.change(heartbeat_state=next(value for value, text in texts.items() if text.lower() == FAULT_STATE))


def _once_disarmed(world: World, act: Callable[[], None]) -> None:
    """Do something as the last command of an enabled axis acts, at the end of the tick before it is told to disable."""
    if world.axis.state is State.DISARMED:
        act()
        return
    done = False

    def look(_: Tick) -> None:
        nonlocal done
        if not done and world.axis.state is State.DISARMED:
            done = True
            act()

    world.loop.listen(look)
