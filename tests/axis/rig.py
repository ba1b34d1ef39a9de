"""An axis with a plant of its own, told tick by tick what happens; no bus, no clock."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import AxisDesign, design_axis
from twostage_servo.axis.messages import IN_TIME, Command, DriveTraits, Feedback
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.state import State
from twostage_servo.control.laws.paper_design import PaperDesign
from twostage_servo.control.plant import Plant

PERIOD_S = 0.01

TRAITS = DriveTraits(counter_modulus=16, position_quantum=0.001)

DEMO: dict[str, Any] = {
    "name": "x",
    "unit": "mm",
    "effort_unit": "V",
    "cruise_velocity": 100.0,
    "plant": {"gain": 180.0, "pole": 14.0},
    "limits": {
        "position_minimum": -2500.0,
        "position_maximum": 2500.0,
        "position_overrun": 20.0,
        "velocity": 250.0,
        "overspeed": 320.0,
        "acceleration": 2000.0,
        "quick_stop_deceleration": 4000.0,
        "effort": 24.0,
        "effort_saturation_ms": 500.0,
        "following_error_minimum": 10.0,
        "following_error_time_s": 0.2,
        "effort_rate": 1000.0,
        "innovation_gate": 0.5,
        "innovation_time_ms": 3.0,
        "stall_effort": 2.5,
        "stall_time_ms": 50.0,
        "stale_feedback_ms": 30.0,
        "feedback_errors": 25,
        "heartbeat_ms": 300.0,
        "missed_ticks": 2,
    },
    "window": {"position": 0.05, "time_ms": 100.0},
}


def axis_settings(
    homing: dict[str, Any] | None = None, approach: dict[str, Any] | None = None, **limits: float
) -> AxisSettings:
    tables = {"limits": DEMO["limits"] | limits, "homing": homing or {}, "approach": approach or {}}
    return AxisSettings.model_validate(DEMO | tables)


def paper(design: AxisDesign) -> PaperDesign:
    """Return the design of the paper's law, which every axis here has."""
    assert isinstance(design.law, PaperDesign)
    return design.law


def check_what_is_told(axis: Axis, tick_index: int) -> None:
    """Check that each trip, and what lasts, says what has happened, and when."""
    for trip in (*axis.trips.values(), *axis.lasting):
        assert trip.cause
        assert "None" not in trip.cause
        assert 0 <= trip.tick <= tick_index


@dataclass
class AxisRig:
    """Drives an axis and its plant. `sees` changes what the axis is told of the true position."""

    axis: Axis = field(default_factory=lambda: Axis(design_axis(axis_settings(), PERIOD_S), TRAITS))
    plant: Plant = field(default_factory=lambda: Plant(180.0, 14.0))
    period_s: float = PERIOD_S
    load: float = 0.0
    position: float = 0.0
    velocity: float = 0.0
    sample: float = 0.0
    tick_index: int = 0
    counter: int = 0
    silent: bool = False
    enabled: bool = False
    fault_code: int | None = None
    inputs: dict[str, Any] = field(default_factory=dict)
    enables: bool = True
    sees: Callable[[float], float] = field(default=lambda position: position)
    commands: list[Command] = field(default_factory=list)
    states: list[State] = field(default_factory=list)

    def state(self) -> State:
        return self.axis.state

    def tick(self, missed: int = 0) -> Command:
        self.tick_index += 1 + missed
        for _ in range(missed):  # the last command goes on acting, and nobody looks
            self.sample = self.sees(self.position)
            self.move(self.commands[-1].effort if self.enabled and self.commands else 0.0)
        self.axis.begin_tick(self.tick_index, missed)
        if not self.silent:
            self.counter = (self.counter + 1) % 16
            told = {name: value for name, value in self.inputs.items() if name in Feedback._fields}
            received = {name: value for name, value in self.inputs.items() if name not in told}
            feedback = Feedback(self.sample, self.counter, self.enabled, fault_code=self.fault_code, **told)
            self.axis.accept_feedback(feedback, IN_TIME._replace(**received))
        command = self.axis.step()
        self.enabled = command.enable is True and self.enables
        self.sample = self.sees(self.position)
        self.move(command.effort if self.enabled else 0.0)
        self.commands.append(command)
        self.states.append(self.axis.state)
        check_what_is_told(self.axis, self.tick_index)
        return command

    def move(self, effort: float) -> None:
        sampled, total = self.plant.discretise(self.period_s), effort - self.load
        self.position += sampled.a12 * self.velocity + sampled.b1 * total
        self.velocity = sampled.a22 * self.velocity + sampled.b2 * total

    def seconds(self, duration_s: float) -> "AxisRig":
        for _ in range(round(duration_s / self.period_s)):
            self.tick()
        return self

    def armed(self, for_s: float = 0.1) -> "AxisRig":
        self.seconds(0.05)
        self.axis.arm()
        self.seconds(for_s)
        assert self.state() is State.HOLDING
        return self

    def cruising(self, target: float = 400.0, velocity: float = 100.0, for_s: float = 1.5) -> "AxisRig":
        self.armed()
        self.axis.move_to(target, velocity)
        self.seconds(for_s)
        return self
