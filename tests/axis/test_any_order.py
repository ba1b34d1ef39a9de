"""Requests, faults, loads and a suspended host in any order: what must hold for an axis whatever happens to it."""

import contextlib
import math
from collections.abc import Callable

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from tests.axis.rig import PERIOD_S, TRAITS, AxisRig, axis_settings
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import design_axis
from twostage_servo.axis.messages import NO_EFFORT
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import BRAKING, DRIVEN, ENABLED, LATCHED, MOVING, State
from twostage_servo.axis.trips import EVENTS, RULES, TripCode

DESIGN = design_axis(axis_settings(), PERIOD_S)
EFFORT_LIMIT = 24.0
LARGEST_STEP = 10.0
"""1000 V/s in a tick of 10 ms."""

LONGEST_BRAKING_TICKS = 300
"""3 s, where the quickest speed needs 0.2 s and the patience is twofold."""

SEVERITY = {State.TRIPPED_STOPPING: 1, State.TRIPPED_QUICK_STOP: 2, State.TRIPPED: 3}
UNDER_WAY = MOVING | {State.JOGGING, State.HOMING}

velocities = st.floats(-300.0, 300.0) | st.sampled_from([0.0, math.nan, math.inf])
positions = st.floats(-3000.0, 3000.0) | st.sampled_from([math.nan, -math.inf])


class AnyOrder(RuleBasedStateMachine):
    """The axis on its plant; `request` holds a refusal to its promise, the invariants all that was sent since."""

    @initialize(place=st.floats(-2400.0, 2400.0))
    def begin(self, place: float) -> None:
        axis = Axis(DESIGN, TRAITS)
        self.rig = AxisRig(axis, position=place, sample=place).seconds(0.05)
        self.looked_at = 0
        self.braking_ticks = 0
        self.jump = 0.0
        self.rig.sees = lambda position: position + self.jump

    def seen_by_the_operator(self) -> tuple[object, ...]:
        axis, law = self.rig.axis, self.rig.axis.law
        move = axis.move and (axis.move.number, axis.move.outcome)
        return (
            axis.state, axis.trip, axis.escalation, axis.referenced, move, axis.override_percent, axis.set_point,
            law.stage, law.target, law.cruise_velocity, law.effort, law.effort_limit, law.observer.position,
        )  # fmt: skip

    def request(self, ask: Callable[[], object]) -> None:
        before, refusal = self.seen_by_the_operator(), None
        try:
            ask()
        except Refused as refused:
            refusal = refused
        if refusal is not None:
            assert self.seen_by_the_operator() == before
            assert refusal.code
            assert str(refusal)

    # What the operator asks for

    @rule()
    def arm(self) -> None:
        self.request(self.rig.axis.arm)

    @rule()
    def arm_and_wait(self) -> None:
        self.rig.seconds(0.05)
        self.request(self.rig.axis.arm)
        self.rig.seconds(0.05)

    @rule()
    def disarm(self) -> None:
        self.rig.axis.disarm()
        assert self.rig.state() in LATCHED | {State.DISARMED, State.DISARMING}

    @rule(place=positions, velocity=velocities)
    def move_to(self, place: float, velocity: float) -> None:
        self.request(lambda: self.rig.axis.move_to(place, velocity))

    @rule(distance=st.floats(-300.0, 300.0), velocity=st.floats(1.0, 250.0))
    def move_by(self, distance: float, velocity: float) -> None:
        self.request(lambda: self.rig.axis.move_by(distance, velocity))

    @rule(velocity=velocities)
    def jog(self, velocity: float) -> None:
        self.request(lambda: self.rig.axis.jog(velocity))

    @rule(percent=st.floats(-10.0, 210.0) | st.sampled_from([0.0, 0.0, 100.0, math.nan]), count=st.integers(0, 40))
    def override(self, percent: float, count: int) -> None:
        self.request(lambda: self.rig.axis.set_override(percent))
        self.ticks(count)

    @rule()
    def home(self) -> None:
        self.request(self.rig.axis.home)

    @rule(quick=st.booleans())
    def stop(self, *, quick: bool) -> None:
        self.request(lambda: self.rig.axis.stop(quick=quick))

    @rule()
    def reset(self) -> None:
        before = self.rig.state()
        another_one_commands = any(one.code is TripCode.FOREIGN_COMMAND for one in self.rig.axis.hazards)
        self.request(self.rig.axis.reset)
        if before in LATCHED - {State.TRIPPED} or (before is State.TRIPPED and another_one_commands):
            assert self.rig.state() is before
        elif before is State.TRIPPED:
            assert (self.rig.state(), self.rig.axis.trip) == (State.DISARMED, None)

    @rule()
    def end_braking(self) -> None:
        self.rig.axis.end_braking()

    # What happens to it

    @rule(code=st.sampled_from(TripCode))
    def trip(self, code: TripCode) -> None:
        first, before = self.rig.axis.trip, self.rig.state()
        self.rig.axis.raise_trip(code, "test")
        assert SEVERITY.get(self.rig.state(), 0) >= SEVERITY.get(before, 0)
        assert first is None or self.rig.axis.trip is first
        assert RULES[code].reaction in EVENTS

    @rule(silent=st.booleans())
    def silence(self, *, silent: bool) -> None:
        self.rig.silent = silent

    @rule(name=st.sampled_from(["safe_torque_off", "positive_limit", "negative_limit"]), active=st.booleans())
    def switch(self, name: str, *, active: bool) -> None:
        self.rig.inputs[name] = active

    @rule(code=st.sampled_from([None, 7]))
    def drive_fault(self, code: int | None) -> None:
        self.rig.fault_code = code

    @rule(boots=st.integers(0, 2))
    def heartbeat(self, boots: int) -> None:
        self.rig.axis.record_heartbeat(boots)

    @rule()
    def foreign_command(self) -> None:
        self.rig.axis.record_foreign_command("0x201")

    @rule(load=st.floats(-30.0, 30.0) | st.just(0.0))
    def load(self, load: float) -> None:
        self.rig.load = load

    @rule(height=st.floats(-50.0, 50.0) | st.just(math.nan))
    def encoder_jump(self, height: float) -> None:
        self.jump = height

    @rule()
    def all_is_well_again(self) -> None:
        self.rig.silent, self.rig.fault_code, self.rig.load, self.jump = False, None, 0.0, 0.0
        self.rig.inputs.clear()

    @rule()
    def the_operator_makes_it_ready(self) -> None:
        """Remove every cause, clear the trip, say where the axis is, and arm it: most of what follows then happens."""
        self.all_is_well_again()
        self.rig.axis.disarm()
        self.rig.seconds(1.0)
        with contextlib.suppress(Refused):
            self.rig.axis.reset()
        self.rig.seconds(0.6)
        for ask in (lambda: self.rig.axis.set_position(self.rig.position), self.rig.axis.arm):
            self.request(ask)
        self.rig.seconds(0.1)

    @rule(place=st.floats(-3000.0, 3000.0), velocity=st.floats(5.0, 250.0), count=st.integers(5, 120))
    def set_out(self, place: float, velocity: float, count: int) -> None:
        """A move from wherever it is, some of it made when the next thing happens."""
        if self.rig.state() is not State.HOLDING:
            self.the_operator_makes_it_ready()
        self.request(lambda: self.rig.axis.move_to(place, velocity))
        self.ticks(count)

    @rule(velocity=st.floats(5.0, 250.0), count=st.integers(5, 60))
    def jog_away(self, velocity: float, count: int) -> None:
        if self.rig.state() is not State.HOLDING:
            self.the_operator_makes_it_ready()
        self.request(lambda: self.rig.axis.jog(math.copysign(velocity, -self.rig.position)))
        self.ticks(count)

    @rule(count=st.integers(1, 60))
    def ticks(self, count: int) -> None:
        for _ in range(count):
            before, trip = self.rig.state(), self.rig.axis.trip
            self.rig.tick()
            after = self.rig.state()
            assert SEVERITY.get(after, 0) >= SEVERITY.get(before, 0)  # a trip never passes by itself
            assert trip is None or self.rig.axis.trip is trip
            assert (
                after in ENABLED
                or before not in {State.DISARMED, State.TRIPPED}
                or after is before
                or (before is State.DISARMED and after is State.TRIPPED and self.is_commanded_by_another)
            )  # whose command has come while the drive was still enabled
            assert before in ENABLED or after not in ENABLED  # nothing is enabled but by `arm`
            self.braking_ticks = self.braking_ticks + 1 if after in BRAKING and after is before else 0
            assert self.braking_ticks < LONGEST_BRAKING_TICKS

    @property
    def is_commanded_by_another(self) -> bool:
        trip = self.rig.axis.trip
        return trip is not None and trip.code is TripCode.FOREIGN_COMMAND

    @precondition(lambda self: self.rig.commands)
    @rule(missed=st.integers(1, 12))
    def suspend_host(self, missed: int) -> None:
        self.rig.tick(missed)

    # What holds all the time

    @invariant()
    def what_was_sent_was_within_bounds(self) -> None:
        rig, last = self.rig, max(self.looked_at - 1, 0)
        before = rig.commands[last]
        for command, state in zip(rig.commands[last:], rig.states[last:], strict=True):
            assert math.isfinite(command.effort)
            assert abs(command.effort) <= EFFORT_LIMIT
            assert command.enable == (state in ENABLED)
            if state not in ENABLED:
                assert command == NO_EFFORT
            elif state in DRIVEN:
                assert abs(command.effort - before.effort) <= LARGEST_STEP + 1e-9
            else:
                assert command.effort == 0.0
            before = command
        self.looked_at = len(rig.commands)

    @invariant()
    def trip_state_and_move_agree(self) -> None:
        axis = self.rig.axis
        assert (axis.trip is not None) == (axis.state in LATCHED)
        assert axis.escalation is None or axis.trip is not None
        under_way = axis.move is not None and axis.move.outcome == "moving"
        assert under_way == (axis.state in UNDER_WAY)
        assert axis.referenced or axis.state not in MOVING
        if axis.state in MOVING and axis.move is not None:
            assert abs(axis.move.target) <= 2500.0
            assert axis.set_point == axis.move.target
        assert axis.cruise_velocity <= 250.0
        assert axis.state in DRIVEN or axis.override_percent == 100.0

    @invariant()
    def the_estimate_is_a_number(self) -> None:
        observer = self.rig.axis.law.observer
        assert math.isfinite(observer.position + observer.velocity + observer.disturbance)


AnyOrder.TestCase.settings = settings(max_examples=80, stateful_step_count=30, deadline=None)
TestAnyOrder = AnyOrder.TestCase
