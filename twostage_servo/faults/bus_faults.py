"""Injections on the bus: what happens to frames on their way, and to the controllers that send them."""

import errno
import math
from collections.abc import Callable, Iterable
from random import Random

import can

from twostage_servo.faults.frames import profile_of
from twostage_servo.faults.world import DRIVE, SERVICE, World

Deliveries = Iterable[tuple[float, can.Message]]

_ERROR_PASSIVE = can.Message(
    arbitration_id=0x004, is_error_frame=True, is_extended_id=False, data=bytes((0, 0x20, 0, 0, 0, 0, 96, 130))
)
"""CAN_ERR_CRTL with CAN_ERR_CRTL_TX_PASSIVE of linux/can/error.h."""
_BUS_OFF = can.Message(arbitration_id=0x040, is_error_frame=True, is_extended_id=False, data=bytes(8))
"""CAN_ERR_BUSOFF."""


def on_feedback(world: World, act: Callable[[int, can.Message], Deliveries]) -> None:
    """Let a function decide what arrives of each feedback frame from now on; it is told how many came before."""
    seen = 0

    def disturb(sender: str, message: can.Message, _: float) -> Deliveries:
        nonlocal seen
        if sender != DRIVE or message.arbitration_id != world.axis_loop.drive.feedback_id.identifier:
            return [(0.0, message)]
        seen += 1
        return act(seen - 1, message)

    world.wire.disturb(disturb)


def _frame_s(world: World) -> float:
    """Return how far apart the feedback frames come, in s."""
    simulation = world.simulation
    return simulation.feedback_period_ms / 1e3 if simulation.feedback == "cyclic" else world.period_s


def lose(count: int) -> Callable[[World, Random], None]:
    """Lose the next frames."""
    return lambda world, _: on_feedback(world, lambda n, frame: [] if n < count else [(0.0, frame)])


def lose_as_many_as_the_limit(world: World, _: Random) -> None:
    """Lose as many frames in a row as the axis does not allow any more: three, with a limit of 30 ms.

    Those of a drive with a rhythm of its own come at any time within a tick, so the silence has to be a tick longer.
    """
    silence_s = world.axis.design.ticks(world.axis.settings.limits.stale_feedback_ms) * world.period_s
    if world.simulation.feedback == "cyclic":
        silence_s += world.period_s
    count = math.ceil(silence_s / _frame_s(world) - 1e-9)
    on_feedback(world, lambda n, frame: [] if n < count else [(0.0, frame)])


def lose_at_random(world: World, random: Random) -> None:
    """Lose 5 % of all frames from now on, yet never as many in a row as the limit: that is another fault."""
    stale_s = world.axis.design.ticks(world.axis.settings.limits.stale_feedback_ms) * world.period_s
    most = max(1, math.floor(stale_s / _frame_s(world) + 1e-9) - 1)
    row = 0

    def act(_: int, frame: can.Message) -> Deliveries:
        nonlocal row
        row = row + 1 if random.random() < 0.05 and row < most else 0
        return [] if row else [(0.0, frame)]

    on_feedback(world, act)


def double(world: World, random: Random) -> None:
    """Let each of the next 10 frames arrive twice, the second up to a tick later."""
    delay_s = random.uniform(0.0, world.period_s)
    on_feedback(world, lambda n, frame: [(0.0, frame), (delay_s, frame)] if n < 10 else [(0.0, frame)])


def reorder(world: World, _: Random) -> None:
    """Let a frame arrive behind the one after it."""
    on_feedback(world, lambda n, frame: [(1.2 * world.period_s if n == 0 else 0.0, frame)])


def delay_within_a_tick(world: World, random: Random) -> None:
    """Let each of the next 20 frames arrive 10 to 90 % of a tick late."""

    def act(n: int, frame: can.Message) -> Deliveries:
        return [(random.uniform(0.1, 0.9) * world.period_s if n < 20 else 0.0, frame)]

    on_feedback(world, act)


def delay_beyond_a_tick(world: World, random: Random) -> None:
    """Let one frame arrive more than a tick late."""
    delay_s = random.uniform(1.1, 1.9) * world.period_s
    on_feedback(world, lambda n, frame: [(delay_s if n == 0 else 0.0, frame)])


def refuse_to_send(count: int) -> Callable[[World, Random], None]:
    """Let the controller's queue be full (ENOBUFS) for a number of commands."""

    def inject(world: World, _: Random) -> None:
        node = world.wire.node(SERVICE)
        node.fail_to_send(can.CanOperationError("No buffer space available", errno.ENOBUFS))
        left = count

        def after_each_tick(_: object) -> None:
            nonlocal left
            left -= 1
            if left <= 0:
                node.fail_to_send(None)

        world.loop.listen(after_each_tick)

    return inject


def error_passive(world: World, _: Random) -> None:
    """Let the controller report that it is error-passive."""
    world.wire.node(SERVICE).inject(_ERROR_PASSIVE)


def bus_off(world: World, _: Random) -> None:
    """Let the controller report bus-off."""
    world.wire.node(SERVICE).inject(_BUS_OFF)


def interface_down(world: World, _: Random) -> None:
    """Take the interface down for 200 ms."""
    node = world.wire.node(SERVICE)
    node.take_down()
    world.later(0.2, node.bring_up)


def babble(world: World, random: Random) -> None:
    """Let a node send frames of other identifiers for half a second: 15 in a ms, 150 in a tick at most."""
    node = world.wire.node(SERVICE)
    count = round(min(15e3 * world.period_s, 150.0))
    known = {one.identifier for axis_loop in world.service.axis_loops for one in axis_loop.drive.decoders}
    others = [number for number in range(0x800) if number not in known]
    end_s = world.now_s + 0.5

    def after_each_tick(_: object) -> None:
        if world.now_s < end_s:
            for _frame in range(count):
                data = random.randbytes(random.randrange(9))
                node.inject(can.Message(arbitration_id=random.choice(others), is_extended_id=False, data=data))

    world.loop.listen(after_each_tick)


def back_up(world: World, _: Random) -> None:
    """Let a quarter more frames of another identifier arrive than a tick reads, for half a second; none is lost.

    What the drive sends waits behind them, longer with each tick.
    """
    node, link = world.wire.node(SERVICE), world.axis_loop.bus.link
    node.set_queue_length(1_000_000)
    known = {one.identifier for axis_loop in world.service.axis_loops for one in axis_loop.drive.decoders}
    foreign = next(number for number in range(0x7FF, 0, -1) if number not in known)
    frame = can.Message(arbitration_id=foreign, is_extended_id=False, is_fd=link.settings.fd, data=bytes(8))
    frames = math.ceil(1.25 * link.settings.frames_read(world.period_s))
    end_s = world.now_s + 0.5

    def bring(_: object) -> None:
        if world.now_s < end_s:
            for _frame in range(frames):
                node.inject(frame)

    bring(None)
    world.loop.listen(bring)


def foreign_command(world: World, _: Random) -> None:
    """Let another node command the drive, for a second: to be disabled, so that nothing else comes of it."""
    profile = profile_of(world.axis_loop.drive)
    node = world.wire.node(SERVICE)
    end_s = world.now_s + 1.0
    counter = 0

    def command(_: object) -> None:
        nonlocal counter
        if world.now_s < end_s:
            counter += 1
            data = profile.encode_command(0.0, enable=False, counter=counter)
            number, extended = profile.command_id
            fd = world.axis_loop.bus.link.settings.fd
            node.inject(can.Message(arbitration_id=number, is_extended_id=extended, is_fd=fd, data=data))

    command(None)
    world.loop.listen(command)


def malformed(world: World, random: Random) -> None:
    """Send frames with the feedback's number and a wrong length, kind or identifier, beside the good ones."""
    number, extended = world.axis_loop.drive.feedback_id
    data = random.randbytes(8)
    node = world.wire.node(SERVICE)
    for message in (
        can.Message(arbitration_id=number, is_extended_id=extended, data=data[:3]),
        can.Message(arbitration_id=number, is_extended_id=extended, is_remote_frame=True, dlc=8),
        can.Message(arbitration_id=number, is_extended_id=not extended, data=data),
        can.Message(arbitration_id=number, is_extended_id=extended, is_fd=True, data=random.randbytes(12)),
    ):
        node.inject(message)


def corrupt(world: World, random: Random) -> None:
    """Turn a bit of each frame round from now on."""

    def act(_: int, frame: can.Message) -> Deliveries:
        bit = random.randrange(8 * len(frame.data))
        frame.data[bit // 8] ^= 1 << bit % 8
        return [(0.0, frame)]

    on_feedback(world, act)


def transmit_dead(world: World, _: Random) -> None:
    """Let nothing that the service sends arrive any more."""
    world.wire.disturb(lambda sender, frame, _now: [] if sender == SERVICE else [(0.0, frame)])
