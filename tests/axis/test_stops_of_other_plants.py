"""A stop never drives the axis backwards, whatever acceleration the file states, on every plant that is accepted."""

from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twostage_servo.axis.axis import Axis
from twostage_servo.axis.design import AxisDesign, design_axis
from twostage_servo.axis.messages import DriveTraits, Feedback
from twostage_servo.axis.settings import AxisSettings
from twostage_servo.axis.state import BRAKING, State
from twostage_servo.config.loader import load
from twostage_servo.control.model_monitor.hypotheses import ACCEPTED
from twostage_servo.control.plant import Plant

SHIPPED = sorted(path.name for path in Path("config").glob("*.toml") if "[axis.plant]" in path.read_text())

REVERSAL = 0.15
"""Share of its speed by which a stop may reverse an axis whose plant is the model, or off it by 30 %."""

REVERSAL_DELAYED = 0.18
"""The same where the drive answers a tick later as well: that tick's step has been made when it shows."""

STEPS = 10
"""Steps of the plant in a tick."""

LONGEST_STOP_S = 4.0
"""Within which every stop has ended, and for how long an axis that has stopped is watched then: what the axis kept of
its speed, or what the position law makes of it, shows in half a second."""
AT_REST_S = 0.5


class Course(NamedTuple):
    """A stop, from the plant: its speed before, its largest reversal, and how far it went, in axis unit."""

    speed: float
    reversal: float
    distance: float


class Rig:
    """An axis of a design on a plant, whose drive samples in steps and may answer some ticks later."""

    def __init__(self, design: AxisDesign, gain: float, pole: float, delay: int, load: float = 0.0) -> None:
        model = design.settings.plant
        self._plant = Plant(gain * model.gain, pole * model.pole).discretise(design.period_s / STEPS)
        self._resolution = 1e-6 * design.settings.limits.velocity
        self.axis = Axis(design, DriveTraits(counter_modulus=16, position_quantum=self._resolution))
        self._period_s, self._load = design.period_s, load
        self._answers = [0.0] * delay
        self._tick, self._sample, self._enabled = 0, 0.0, False
        self.position = self.velocity = 0.0

    def tick(self) -> None:
        self._tick += 1
        self.axis.begin_tick(self._tick, 0)
        self.axis.accept_feedback(Feedback(self._sample, self._tick % 16, self._enabled))
        command = self.axis.step()
        self._enabled = command.enable is True
        self._sample = round(self.position / self._resolution) * self._resolution
        self._answers.append(command.effort if command.enable else 0.0)
        effort = self._answers.pop(0) - (self._load if command.enable else 0.0)
        for _ in range(STEPS):
            plant, velocity = self._plant, self.velocity
            self.position += plant.a12 * velocity + plant.b1 * effort
            self.velocity = plant.a22 * velocity + plant.b2 * effort

    def seconds(self, duration_s: float) -> None:
        for _ in range(round(duration_s / self._period_s)):
            self.tick()

    def stop_from(self, velocity: float, *, quick: bool) -> Course:
        self.seconds(0.3)
        self.axis.arm()
        self.seconds(1.5)
        limits = self.axis.settings.limits
        target = limits.position_maximum if velocity > 0.0 else limits.position_minimum
        self.axis.move_to(target, abs(velocity))
        self.seconds(0.8 + abs(velocity) / min(limits.acceleration, 10.0 * abs(velocity)))
        assert (self.axis.state, self.axis.trip) == (State.SPEED_STAGE, None)
        speed, start, sign = abs(self.velocity), self.position, 1.0 if velocity > 0.0 else -1.0
        self.axis.stop(quick=quick)
        slowest = farthest = at_rest_s = elapsed_s = 0.0
        while at_rest_s < AT_REST_S and elapsed_s < LONGEST_STOP_S:
            self.tick()
            slowest = min(slowest, sign * self.velocity)
            farthest = max(farthest, sign * (self.position - start))
            elapsed_s += self._period_s
            at_rest_s = at_rest_s + self._period_s if self.axis.state not in BRAKING else 0.0
        assert self.axis.state not in BRAKING
        assert self.axis.trip is None
        return Course(speed, -slowest, farthest)


def design_of(name: str) -> AxisDesign:
    configuration = load(Path("config", name)).config
    return design_axis(configuration.axis, 1e-3 * configuration.service.tick_ms)


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize(("gain", "pole", "delay"), ACCEPTED)
@pytest.mark.parametrize("name", SHIPPED)
def test_a_stop_of_a_shipped_axis_does_not_reverse_it(
    name: str, gain: float, pole: float, delay: int, *, quick: bool
) -> None:
    design = design_of(name)
    limits = design.settings.limits
    stop = Rig(design, gain, pole, delay).stop_from(design.settings.cruise_velocity, quick=quick)
    assert stop.reversal <= (REVERSAL_DELAYED if delay else REVERSAL) * stop.speed
    deceleration = limits.quick_stop_deceleration if quick else limits.acceleration
    assert stop.distance <= design.certain_stopping_distance(stop.speed, deceleration)


EXAMPLE = design_of("example2.toml")


def example_with(deceleration: float, effort_rate: float) -> AxisDesign:
    tables = EXAMPLE.settings.model_dump(exclude_unset=True)
    tables["limits"] |= {
        "acceleration": deceleration, "quick_stop_deceleration": deceleration, "effort_rate": effort_rate,
    }  # fmt: skip
    return design_axis(AxisSettings.model_validate(tables), EXAMPLE.period_s)


@settings(max_examples=40, deadline=None)
@given(
    plant=st.sampled_from(ACCEPTED),
    share=st.floats(0.02, 0.8),
    sign=st.sampled_from([1.0, -1.0]),
    deceleration=st.sampled_from([1000.0, 4000.0, 20_000.0, 1e9]),
    effort_rate=st.sampled_from([300.0, 1000.0, 1e5]),
    load=st.floats(-2.0, 2.0),
    quick=st.booleans(),
)
def test_no_stop_reverses_an_axis_whatever_deceleration_is_stated(
    plant: tuple[float, float, int], share: float, sign: float, deceleration: float, effort_rate: float, load: float,
    *, quick: bool,
) -> None:  # fmt: skip
    gain, pole, delay = plant
    design = example_with(deceleration, effort_rate)
    velocity = sign * share * design.settings.limits.velocity
    stop = Rig(design, gain, pole, delay, load).stop_from(velocity, quick=quick)
    noise = design.rest_velocity
    assert stop.reversal <= (REVERSAL_DELAYED if delay else REVERSAL) * stop.speed + noise
