"""No number that is not finite, or beyond all measure, gets past the control socket in any field of any request."""

import json
import types
import typing
from pathlib import Path
from typing import Any

import pytest

from tests.service.operators import connect, serve
from tests.service.rig import World
from twostage_servo.api.request_reading import parse_request
from twostage_servo.api.requests import OPERATIONS, BadRequestError
from twostage_servo.axis.state import State
from twostage_servo.service.control_socket import ControlSocket

NOT_NUMBERS = [
    "NaN",
    "Infinity",
    "-Infinity",
    "1e400",
    "-1e400",
    "1e309",
    "1e300",
    "-1e300",
    "1" + "0" * 400,
    '"1"',
    "true",
    "[]",
]
"""As they stand in the JSON; NaN and Infinity are none of JSON's words, but Python's writer uses them."""


def _is_numeric(annotation: Any) -> bool:
    alternatives = typing.get_args(annotation) if isinstance(annotation, types.UnionType) else (annotation,)
    return float in alternatives or int in alternatives


def _numeric_fields() -> list[tuple[str, str]]:
    return [
        (op, name)
        for op, model in OPERATIONS.items()
        for name, annotation in typing.get_type_hints(model).items()
        if _is_numeric(annotation)
    ]


FIELDS = _numeric_fields()


def test_the_walk_finds_the_numeric_fields() -> None:
    assert set(FIELDS) >= {
        ("move", "position"), ("move", "by"), ("move", "velocity"), ("jog", "velocity"), ("home", "position"),
        ("watch", "every"),
    }  # fmt: skip
    assert set(OPERATIONS) >= {"status", "acquire", "preempt", "take", "release", "reload"}


def _line(op: str, field: str, literal: str) -> str:
    needed = ', "position": 1' if (op, field) == ("move", "velocity") else ""
    return f'{{"op": "{op}", "{field}": {literal}{needed}}}'


@pytest.mark.parametrize(("op", "field"), FIELDS)
def test_a_usual_number_is_taken(op: str, field: str) -> None:
    assert getattr(parse_request(_line(op, field, "5").encode()), field) == 5


@pytest.mark.parametrize("literal", NOT_NUMBERS, ids=lambda literal: literal[:9])
@pytest.mark.parametrize(("op", "field"), FIELDS)
def test_what_is_no_usual_number_is_not(op: str, field: str, literal: str) -> None:
    with pytest.raises(BadRequestError, match=field):
        parse_request(_line(op, field, literal).encode())


@pytest.mark.parametrize(("op", "field"), FIELDS)
def test_null_is_not_taken_for_a_field_left_out(op: str, field: str) -> None:
    with pytest.raises(BadRequestError, match=f"{field} is null: give it a value, or leave it out"):
        parse_request(_line(op, field, "null").encode())


def test_over_the_socket_each_is_refused_with_its_field_and_nothing_moves(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"

    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        for op, field in FIELDS:
            for literal in NOT_NUMBERS:
                answer = await operator.send(_line(op, field, literal).encode())
                assert answer["ok"] is False
                assert answer["error"]["code"] == "bad_request"
                assert field in answer["error"]["message"]
                assert len(answer["error"]["message"]) < 300, "the number itself is not repeated"
        status = await operator.done(op="status")
        assert (status["axis"]["state"], status["move"], status["trip"]) == ("holding", None, None)
        assert world.service.statistics.missed == 0

    serve(path, script)


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ('{"op": "move", "position": 1e9}', "position_limit"),
        ('{"op": "move", "by": -1e9}', "position_limit"),
        ('{"op": "move", "position": 1, "velocity": 1e9}', "velocity_limit"),
        ('{"op": "jog", "velocity": -1e9}', "velocity_limit"),
    ],
)
def test_a_number_beyond_the_axis_limits_is_refused_by_the_axis(tmp_path: Path, line: str, code: str) -> None:
    path = tmp_path / "control.sock"

    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        assert await operator.refused(**json.loads(line)) == code
        assert world.state() is State.HOLDING

    serve(path, script)
