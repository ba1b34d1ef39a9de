"""The methods that the paper compares, each built for an example."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from twostage_servo.control.baselines.compared_law import ComparedLaw
from twostage_servo.control.baselines.conventional import ConventionalTwoStage
from twostage_servo.control.baselines.optimal_servo import OptimalServo
from twostage_servo.control.baselines.pid import Pid
from twostage_servo.control.baselines.transcription import Reading, TranscribedLaw
from twostage_servo.control.baselines.velocity import Differentiator, speed_sensor
from twostage_servo.control.laws.paper import TwoStageLaw
from twostage_servo.control.observer import DisturbanceObserver
from twostage_servo.paper.examples import NOISE, PERIOD_S, Example

Sensor = Callable[[], float]
"""Reads the true velocity, in mm/s."""
Builder = Callable[[Example, Sensor], ComparedLaw]

CONVENTIONAL: Final = "conventional_differentiated"
"""The paper's plant has one output, so the conventional method of its examples differentiates."""

AS_PRINTED: Final = Reading(disturbance_memory=0.0, offset="set-point")
"""The printed observer and the printed hand-over (errata 5 and 12); with the other slips no law would be left."""


@dataclass(frozen=True, slots=True)
class Method:
    """One method: its title, for the report and for a narrow table, where its velocity comes from, how to build it."""

    title: str
    label: str
    velocity_from: str
    build: Builder
    two_stage: bool = True


def transcribed(reading: Reading) -> Builder:
    """Return the builder of the proposed law, read in some way."""
    return lambda example, _: TranscribedLaw(example.model, example.ratio, NOISE.measurement_variance, reading)


def _proposed(example: Example, _: Sensor) -> ComparedLaw:
    observer = DisturbanceObserver(example.model, example.kalman.predictor, NOISE.disturbance_memory)
    return TwoStageLaw(observer, example.gains, PERIOD_S)


def _two_output(example: Example, sensor: Sensor) -> ComparedLaw:
    return ConventionalTwoStage(example.model, example.gains, speed_sensor(sensor))


def _one_output(example: Example, _: Sensor) -> ComparedLaw:
    return ConventionalTwoStage(example.model, example.gains, Differentiator(PERIOD_S))


def model_difference_without_sensor(example: Example, _: Sensor) -> ComparedLaw:
    """Build the law of reference [6] with a differentiated velocity: it is published with a speed sensor."""
    return ConventionalTwoStage(
        example.model, example.gains, Differentiator(PERIOD_S), difference_gain=example.gains.f11
    )


def _model_difference(example: Example, sensor: Sensor) -> ComparedLaw:
    return ConventionalTwoStage(example.model, example.gains, speed_sensor(sensor), difference_gain=example.gains.f11)


METHODS: Final[dict[str, Method]] = {
    "pid": Method("PID", "PID", "differentiated", lambda example, _: Pid(example.gains, PERIOD_S), two_stage=False),
    "optimal": Method(
        "optimal servo",
        "optimal servo",
        "speed sensor",
        lambda example, sensor: OptimalServo(example.gains, speed_sensor(sensor)),
        two_stage=False,
    ),
    "conventional_two_output": Method("conventional, speed sensor", "conv., speed sensor", "speed sensor", _two_output),
    "conventional_differentiated": Method(
        "conventional, differentiated", "conv., differentiated", "differentiated", _one_output
    ),
    "conventional_model_difference": Method(
        "conventional, difference [6]", "conv., difference [6]", "speed sensor", _model_difference
    ),
    "proposed": Method("proposed", "proposed", "estimated", _proposed),
    "proposed_as_printed": Method("proposed, as printed", "proposed, as printed", "estimated", transcribed(AS_PRINTED)),
}
