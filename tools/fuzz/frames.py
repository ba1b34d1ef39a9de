"""Random and mutated frames on the bus of a service that is armed, moving, tripped or disarmed meanwhile."""

from collections.abc import Callable
from typing import Any

import can

from tools.fuzz.bench import Bench
from tools.fuzz.drives import EXTREMES, all_drives
from tools.fuzz.outcome import Failed, Outcome
from tools.fuzz.reference import refusal
from tools.fuzz.reproducible import reproducible
from tools.fuzz.request_maker import RequestMaker
from twostage_servo.axis.refusals import RefusalCode
from twostage_servo.axis.state import DRIVEN, State
from twostage_servo.drives.frame import FrameRejected
from twostage_servo.service.answers import encode

PER_EPISODE = 5000
"""Frames of one episode, which is a service from its start to its end."""

_POOL = 48
_TICKS_AT_END = 400
_TICKS_TO_DRAIN = 200
_LEFT_AT_END = 2
_BUS_OFF = 0x40
_REFERENCE_EVERY = 32
_SNAPSHOT_SHARE = 0.02


def run_episode(seed: int, episode: int, frames: int) -> Outcome:
    """Run one service under fire; raises whatever goes wrong.

    Parameters
    ----------
    seed, episode
        Decide on everything.
    frames
        Frames to send.
    """
    rng = reproducible("frames", seed, episode)
    drives = all_drives()
    attack = _Attack(Bench(drives[episode % len(drives)], rng), frames)
    attack.run()
    bench, link = attack.bench, attack.bench.axis_loop.bus.link
    monitor = bench.axis_loop.axis.drive.monitor
    return Outcome(
        cases=bench.frames,
        counts={
            "ticks": sum(bench.states.values()),
            "received": link.counters.received,
            "error_frames": link.counters.errors,
            "rejected": link.counters.rejected,
            "received_while_driven": bench.frames_while_driven,
            "repeated_or_overtaken": monitor.doubled + monitor.reordered,
            "late": monitor.late,
            "bus_lost": attack.lost,
            "read_as_the_bus_went_off": bench.frame_check.discarded,
            "compared_with_reference": attack.compared,
            **{f"used.{name}": number for name, number in bench.frame_check.decoded.items()},
            **{f"rejected.{reason}": number for reason, number in link.counters.rejected_by_reason.items()},
            **{f"state.{name}": number for name, number in bench.states.items()},
            **{f"refused.{name}": number for name, number in bench.refusals.items()},
            **{f"trip.{name}": number for name, number in bench.trips.items()},
        },
    )


_Maker = Callable[[], can.Message]
_DRIVEN = frozenset(DRIVEN)


def _weighted(makers: dict[_Maker, int]) -> list[_Maker]:
    return [maker for maker, weight in makers.items() for _ in range(weight)]


class _Attack:
    """Decides tick by tick what is on the bus, and what the operator asks for.

    Parameters
    ----------
    bench
        The service, not yet running.
    frames
        How many frames to make.
    """

    def __init__(self, bench: Bench, frames: int) -> None:
        self.bench, self.rng = bench, bench.rng
        self.left = frames
        self.lost = 0
        self.compared = 0
        self._ticks_over = 0
        rng = self.rng
        self._breaks_bus = rng.random() < 0.1
        self._host_is_late = rng.random() < 0.2
        self._foreign_commands = rng.random() < 0.3  # each of which trips the axis
        self._requests = RequestMaker(rng)
        foreign = self._foreign_commands
        kinds = [kind for kind in bench.kinds.values() if foreign or kind.name != "command"]
        self._kinds = [kind for kind in kinds for _ in range(4 if kind.name == "feedback" else 1)]
        self._pool = [(kind, kind.random_data(rng)) for kind in self._kinds for _ in range(_POOL // len(self._kinds))]
        self._others = [entry for entry in self._pool if entry[0].name not in {"feedback", "heartbeat", "command"}]
        self._phases = {
            "storm": _weighted({
                self._flipped: 10, self._flipped_and_repaired: 14, self._noise_repaired: 4, self._valid: 8,
                self._cut: 8, self._other_kind: 8, self._foreign: 8, self._error_frame: 2, self._again: 2,
                self._spoofed: 2,
            }),
            "beside": _weighted({self._foreign: 5, self._error_frame: 1, self._beside: 12}),
            "spoof": _weighted({self._spoofed: 10, self._foreign: 2, self._beside: 2, self._again: 1}),
        }  # fmt: skip
        self._makers: list[_Maker] = []  # none: a calm phase
        self._phase_ticks = 0
        self._honest = True
        self._per_tick = 1.0
        self._latest = bench.feedback()

    def run(self) -> None:
        self.bench.run(self._prepare)

    async def _prepare(self) -> None:
        bench, rng = self.bench, self.rng
        if self.left <= 0:
            self._end()
            return
        self._phase_ticks -= 1
        is_driven = bench.axis_loop.axis.state in _DRIVEN
        if self._phase_ticks <= 0 or (not self._makers and is_driven and rng.random() < 0.2):
            self._next_phase()
        if self._honest or rng.random() < 0.5:
            bench.answer_as_drive(heartbeat=self._honest)
            self.left -= 1
        if self._makers:
            self._make_frames()
        self._operate()
        if rng.random() < _SNAPSHOT_SHARE:
            encode(bench.harness.snapshot())  # which refuses what is not finite
        if self._host_is_late and rng.random() < 0.02:
            bench.missed_next = rng.choice((1, 2, 3, 6, 40, 1001))
        bench.lateness_next_s = (
            rng.random() * bench.period_s * (0.9 if self._host_is_late and rng.random() < 0.05 else 0.01)
        )
        if self._breaks_bus:
            self._break_bus()

    def _make_frames(self) -> None:
        rng, queue = self.rng, self.bench.bus.queue
        number = min(self.left, 1 + int(rng.expovariate(self._per_tick)))
        self.left -= number
        makers, draw, size = self._makers, rng.random, len(self._makers)
        for _ in range(number):
            queue.append(makers[int(draw() * size)]())
        if self._honest and draw() < 0.3:
            queue.rotate(rng.randrange(1 + len(queue)))  # the true feedback anywhere among them
        if queue and draw() < number / _REFERENCE_EVERY:
            self._compare(rng.choice(queue))

    def _next_phase(self) -> None:
        """Attack an axis that is driven, leave another in peace to be armed; now and then the other way round."""
        rng = self.rng
        if (self.bench.axis_loop.axis.state in _DRIVEN) == (rng.random() < 0.9):
            name = rng.choice(("storm", "beside", "beside", "spoof", "spoof"))
            self._makers = self._phases[name]
            self._phase_ticks = rng.randrange(1, 5 if name == "storm" else 60)
            self._honest = rng.random() < 0.85
            self._per_tick = 10.0 ** -rng.uniform(-0.5, 1.0 if name == "spoof" else 2.2)
        else:
            self._makers = []
            self._phase_ticks = 120
            self._honest = True
            self.bench.place_within_limits()

    def _operate(self) -> None:
        bench, rng = self.bench, self.rng
        state = bench.axis_loop.axis.state
        if rng.random() < 0.03:
            bench.ask(**self._requests.sensible(bench.drive.loaded.config.axis))
        elif state is State.DISARMED and rng.random() < 0.5:
            bench.ask(op="arm")
            if bench.refused == RefusalCode.POSITION_LIMIT:  # a jump was taken for a wrap: only a new reference ends it
                bench.ask(op="home", position=0.0)
        elif state is State.TRIPPED and rng.random() < 0.2:
            bench.ask(op="reset")
        elif state is State.HOLDING and rng.random() < 0.3:
            bench.ask(**self._requests.motion(bench.drive.loaded.config.axis))

    def _break_bus(self) -> None:
        rng, bus = self.rng, self.bench.bus
        if bus.trouble is None and rng.random() < 0.01:
            bus.trouble = rng.choice((can.CanOperationError("made up"), OSError(5, "made up"), ValueError("made up")))
            if rng.random() < 0.5:
                bus.trouble = can.CanTimeoutError("made up")  # when sending: the queue is full
            self.lost += 1
        elif rng.random() < 0.2:
            bus.trouble = None
        bus.refuses_to_open = rng.random() < 0.3

    def _end(self) -> None:
        bench = self.bench
        bench.bus.trouble = None
        bench.bus.refuses_to_open = False
        bench.answer_as_drive()
        if not bench.service.shutdown.is_ending and (
            len(bench.bus.queue) <= _LEFT_AT_END or self._ticks_over == _TICKS_TO_DRAIN
        ):
            self._ticks_over = 0
            bench.service.shut_down()
        self._ticks_over += 1
        if self._ticks_over > _TICKS_AT_END:
            state = bench.axis_loop.axis.state
            raise Failed(f"the service has not ended after {_TICKS_AT_END} ticks, in state {state}")

    def _compare(self, message: can.Message) -> None:
        """Hold the codec to the reference."""
        for kind in self.bench.kinds.values():
            if kind.identifier.identifier == message.arbitration_id:
                self.compared += 1
                compare_with_reference(kind, message)

    # Frames ----------------------------------------------------------------------------------------------------------

    def _message(self, kind: Any, data: bytes | bytearray) -> can.Message:
        number, extended = kind.identifier
        return can.Message(self._stamp(), number, extended, is_fd=kind.fd, data=data)

    def _stamp(self) -> float:
        bits = self.rng.getrandbits(8)
        if bits < 250:
            return self.bench.bus.now_s - bits * 1e-4
        return (float("nan"), float("inf"), -1.0, 1e18, float("-inf"), self.bench.bus.now_s + 1.0)[bits - 250]

    def _flip(self, data: bytes) -> bytearray:
        flipped, rng = bytearray(data), self.rng
        length = 8 * len(flipped)
        for _ in range(1 if rng.getrandbits(1) else 1 + rng.getrandbits(3)):
            bit = rng.getrandbits(9) % length
            flipped[bit >> 3] ^= 1 << (bit & 7)
        return flipped

    def _beside(self) -> can.Message:
        """Make a frame that does not speak of the axis' position or state, or one that has to be rejected."""
        bits = self.rng.getrandbits(6)
        if bits == 0 or not self._others:
            return self._cut() if bits < 2 else self._foreign()
        kind, data = self.rng.choice(self._others)
        flipped = self._flip(data)
        return self._message(kind, kind.repaired(flipped) if bits & 1 else flipped)

    def _spoofed(self) -> can.Message:
        """Make a feedback that the axis takes for the next one of its drive, but for its position."""
        bench, rng = self.bench, self.rng
        honest = bench.sample
        if rng.getrandbits(1):
            bench.sample += rng.gauss(0.0, 1.0) * 10.0 ** rng.uniform(-3.0, 6.0)
        else:
            bench.sample = rng.choice(EXTREMES)
        message = bench.feedback()
        bench.sample = honest
        return message

    def _valid(self) -> can.Message:
        kind, data = self.rng.choice(self._pool)
        return self._message(kind, data)

    def _flipped(self) -> can.Message:
        kind, data = self.rng.choice(self._pool)
        return self._message(kind, self._flip(data))

    def _flipped_and_repaired(self) -> can.Message:
        kind, data = self.rng.choice(self._pool)
        return self._message(kind, kind.repaired(self._flip(data)))

    def _noise_repaired(self) -> can.Message:
        kind = self.rng.choice(self._kinds)
        return self._message(kind, kind.repaired(bytearray(self.rng.randbytes(kind.message.length))))

    def _cut(self) -> can.Message:
        """Return a frame of 0 to 64 bytes, with a DLC that need not be theirs."""
        kind, data = self.rng.choice(self._pool)
        rng = self.rng
        length = rng.randrange(9) if rng.getrandbits(2) else rng.randrange(65)
        data = (data + rng.randbytes(64))[:length]
        number, extended = kind.identifier
        dlc = length if rng.getrandbits(2) else rng.randrange(65)
        fd = kind.fd or (length > 8 and rng.random() < 0.5)
        return can.Message(self._stamp(), number, extended, data=data, dlc=dlc, is_fd=fd)

    def _other_kind(self) -> can.Message:
        """Make a remote frame, CAN FD, an identifier of the other length; alone or together."""
        kind, data = self.rng.choice(self._pool)
        number, extended = kind.identifier
        bits = self.rng.randrange(1, 16)
        remote = bits & 1 != 0
        return can.Message(
            self._stamp(), number, extended != (bits & 2 != 0), is_remote_frame=remote,
            is_fd=kind.fd != (bits & 4 != 0), error_state_indicator=bits & 8 != 0, data=None if remote else data,
            dlc=len(data),
        )  # fmt: skip

    def _foreign(self) -> can.Message:
        rng = self.rng
        extended = rng.random() < 0.5
        number = rng.getrandbits(29 if extended else 11)
        if rng.random() < 0.3:
            number = rng.choice(self._kinds).identifier.identifier ^ 1 << rng.randrange(29 if extended else 11)
        if not self._foreign_commands and number == self.bench.command_number:
            number ^= 1
        return can.Message(self._stamp(), number, extended, data=rng.randbytes(rng.randrange(9)))

    def _error_frame(self) -> can.Message:
        rng = self.rng
        classes = rng.getrandbits(29)
        if not self._breaks_bus or rng.getrandbits(5):
            classes &= ~_BUS_OFF
        return can.Message(
            self._stamp(),
            classes,
            True,
            is_error_frame=True,
            data=rng.randbytes(rng.randrange(9)),
            dlc=rng.randrange(9),
        )

    def _again(self) -> can.Message:
        """Repeat a feedback, or make one with the same data and another counter."""
        if self.rng.getrandbits(2) == 0:
            self._latest = self.bench.feedback()
        return self._latest


def compare_with_reference(kind: Any, message: can.Message) -> None:
    """Check that a frame is refused exactly if it has to be, by what cantools reads in it."""
    expected = refusal(kind, message)
    try:
        record = kind.decode(message)
    except FrameRejected as rejection:
        if expected is None:
            raise Failed(f"{rejection}, but by its DBC there is nothing against it") from rejection
        str(rejection)
        return
    if expected is not None:
        raise Failed(f"{message} is taken for {record}, but {expected} is not allowed")
