"""Keeps the trips of an axis until they are reset, and lets the most severe reaction win."""

from twostage_servo.axis.design import AxisDesign
from twostage_servo.axis.motion import Motion
from twostage_servo.axis.moves import MoveOutcome
from twostage_servo.axis.operation import Operation
from twostage_servo.axis.reference import Reference
from twostage_servo.axis.state import BRAKING, Event, State
from twostage_servo.axis.state_machine import StateMachine
from twostage_servo.axis.trips import EVENTS, RULES, Trip, TripCode


class TripLatch:
    """Latches trips.

    Parameters
    ----------
    design
        The axis.
    machine
        Its state.
    operation
        What it is about, which a trip ends.
    motion
        What a trip may take the feedback from.
    reference
        What a trip may cast doubt on.

    Attributes
    ----------
    tick
        Index of the present tick.
    trip
        The latched trip, or None. A later one does not replace it, but its reaction wins if it is more severe.
    escalation
        The later trip that did so, or None.
    trips
        Every trip since the last reset, the first of each code.
    """

    __slots__ = ("_limits", "_machine", "_motion", "_operation", "_reference", "escalation", "tick", "trip", "trips")

    def __init__(
        self, design: AxisDesign, machine: StateMachine, operation: Operation, motion: Motion, reference: Reference
    ) -> None:
        self._limits = design.settings.limits
        self._machine = machine
        self._operation = operation
        self._motion = motion
        self._reference = reference
        self.tick = 0
        self.trip: Trip | None = None
        self.escalation: Trip | None = None
        self.trips: dict[TripCode, Trip] = {}

    def begin_tick(self, tick: int) -> None:
        """Open the tick of this index."""
        self.tick = tick

    def reset(self) -> None:
        """Forget all trips."""
        self.trip = self.escalation = None
        self.trips.clear()

    def raise_trip(self, code: TripCode, cause: str, *, keeps_reference: bool = False) -> None:
        """Latch a trip; a second one changes nothing but that a more severe reaction takes over.

        One that concerns a disabled drive stands beside the first in any case: it must not hide behind it.

        Parameters
        ----------
        code, cause
            What has happened.
        keeps_reference
            Whether it says nothing against the encoder this time, though a trip of this code may.
        """
        rule, machine = RULES[code], self._machine
        event = Event.TRIP_WHILE_DISABLED if rule.while_disabled else EVENTS[rule.reaction]
        after = machine.next(event)
        if after is None:
            return
        trip = Trip(code, cause, self.tick)
        self.trips.setdefault(code, trip)
        doubted = rule.reckoned and not self._motion.blind
        if doubted:
            self._motion.distrust()
        elif rule.blind and not self._motion.blind:
            self._motion.ignore_feedback()
        if rule.unreferenced and not keeps_reference:
            self._reference.lose(f"{code}: {rule.position_in_doubt}")
        if self.trip is None:
            self.trip = trip
        elif after is machine.state and not rule.while_disabled:
            if doubted:  # braking goes on, but from another speed
                self._operation.brake_anew()
            return
        else:
            self.escalation = trip
        self._motion.plant.forget()
        before = machine.state
        machine.apply(event)
        self._operation.end_move(MoveOutcome.TRIPPED, trip.cause)
        if machine.state in BRAKING and machine.state is not before:
            quick = machine.state is State.TRIPPED_QUICK_STOP
            deceleration = self._limits.quick_stop_deceleration if quick else self._limits.acceleration
            self._operation.brake(deceleration, MoveOutcome.TRIPPED)
