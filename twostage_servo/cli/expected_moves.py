"""The moves that `check` and `design` expect, as text and as JSON."""

from typing import TYPE_CHECKING, Any

from twostage_servo.cli.output import CommandError, ExitCode

if TYPE_CHECKING:
    from twostage_servo.app.expected_response import Expectation, Response
    from twostage_servo.axis.design import AxisDesign


def check_uncertainty(percent: float) -> None:
    """Check an option.

    Raises
    ------
    CommandError
        If it is no percentage by which a plant may be off its model.
    """
    if not 0.0 <= percent < 100.0:
        text = f"--uncertainty {percent:g}: it must be at least 0 and less than 100 percent"
        raise CommandError(ExitCode.USAGE, "usage", text)


def expectation_as_json(expected: "Expectation") -> dict[str, Any]:
    """Return a move and what will become of it."""
    return {
        "distance": expected.move.distance,
        "velocity": expected.move.velocity,
        "bound_s": expected.bound_s,
        "nominal": response_as_json(expected.nominal),
        "worst": response_as_json(expected.worst),
    }


def response_as_json(response: "Response") -> dict[str, Any]:
    """Return what a move comes to."""
    return {name: getattr(response, name) for name in response.__slots__}


def response_lines(expected: "list[Expectation]", design: "AxisDesign", uncertainty: float) -> list[str]:
    """Return the responses to be expected as lines of text, each move once."""
    lines = []
    for index, one in enumerate(expected):
        if one.move in [other.move for other in expected[:index]]:
            continue
        move, unit = one.move, design.settings.unit
        lines.append(
            f"move       {move.distance:.4g} {unit} at {move.velocity:g} {unit}/s, to "
            f"{move.band(design.settings.window.position):.3g} {unit}; the limits allow {one.bound_s:.4g} s"
        )
        lines.append(f"           as the model:   {_response(one.nominal, design)}")
        if uncertainty:
            lines.append(f"           up to {uncertainty:g} % off: {_response(one.worst, design)}")
    return lines


def _response(response: "Response", design: "AxisDesign") -> str:
    axis = design.settings
    if response.trip is not None:
        return f"trips ({response.trip})"
    settled = (
        "does not settle" if response.settling_time_s is None else f"settled after {response.settling_time_s:.4g} s"
    )
    return (
        f"{settled}, overshoot {response.overshoot:.3g} {axis.unit}, peak velocity {response.peak_velocity:.4g} "
        f"{axis.unit}/s, peak effort {response.peak_effort:.3g} {axis.effort_unit}"
    )
