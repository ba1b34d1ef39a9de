"""A line of any bytes is judged in bounded time, and is as urgent as what it asks for."""

import asyncio
import contextlib
import gc
import json
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.service.operators import connect, serve
from tests.service.rig import World
from twostage_servo.api.request_reading import LONGEST_LINE, longest_line, parse_request
from twostage_servo.api.requests import BadRequestError, DisarmRequest, MoveRequest, Request, StopRequest
from twostage_servo.axis.state import State
from twostage_servo.service.background_server import Priority, priority_of
from twostage_servo.service.control_socket import ControlSocket

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
keys = st.sampled_from(["op", "axis", "position", "positions", "velocity", "every", "quick", "by"]) | st.text(
    max_size=5
)
objects = st.dictionaries(keys, values, max_size=8)


def heavy(kind: str, size: int) -> bytes:
    """Return the worst that fits into so many bytes."""
    if kind == "positions":
        inner = ",".join(f'"{number:x}":""' for number in range(size))
        text = f'{{"op":"move","positions":{{{inner}'
    elif kind == "unknown keys":
        text = '{"op":"stop",' + ",".join(f'"k{number}":1' for number in range(size))
    elif kind == "nulls":
        text = '{"op":"stop",' + ",".join(f'"k{number}":null' for number in range(size))
    else:
        text = "[" * size
    return text.encode()[: size - 2].rpartition(b",")[0] + (b"}}" if kind == "positions" else b"}")


def calls_of(line: bytes) -> int:
    """Return how many functions of Python are called to find out that a line is no request."""
    calls = 0

    def count(_: Any, event: str, __: Any) -> None:
        nonlocal calls
        calls += event == "call"

    gc.disable()  # whose callbacks are functions as well
    sys.setprofile(count)
    try:
        with pytest.raises(BadRequestError):
            parse_request(line)
    finally:
        sys.setprofile(None)
        gc.enable()
    return calls


def judged(line: bytes) -> tuple[Request | None, str]:
    try:
        return parse_request(line), ""
    except BadRequestError as error:
        return None, str(error)


@pytest.mark.parametrize("kind", ["positions", "unknown keys", "nulls"])
def test_what_is_wrong_is_told_up_to_the_fifth_problem_and_no_more_work_is_done(kind: str) -> None:
    with pytest.raises(BadRequestError) as caught:
        parse_request(heavy(kind, LONGEST_LINE))
    assert 1 <= len(str(caught.value).split("; ")) <= 5
    assert len(str(caught.value)) < 1000
    assert calls_of(heavy(kind, LONGEST_LINE)) <= calls_of(heavy(kind, 200)) + 5
    assert calls_of(heavy(kind, 65_000)) <= calls_of(heavy(kind, 200)) + 5


@given(request=objects, op=st.sampled_from(["move", "stop", "watch", "home", "status"]))
def test_any_object_is_a_request_or_has_one_to_five_problems(request: dict[str, Any], op: str) -> None:
    for given_one in (request, request | {"op": op}):
        parsed, said = judged(json.dumps(given_one).encode())
        assert len(said) < 2000
        if parsed is not None:
            assert parsed.op == given_one["op"]
            assert set(parsed.to_json()) >= set(given_one)


@given(line=st.binary(max_size=300))
def test_any_bytes_are_none_or_a_request(line: bytes) -> None:
    with contextlib.suppress(BadRequestError):
        parse_request(line)


@pytest.mark.parametrize("depth", [10, 1000, 4000, 100_000])
def test_what_is_nested_deeply_is_refused(depth: int) -> None:
    for opening in (b"[", b'{"op":'):
        with pytest.raises(BadRequestError):
            parse_request(opening * depth)


@pytest.mark.parametrize(
    ("line", "rank"),
    [
        (b'{"op":"stop"}', Priority.URGENT),
        (b'{"quick":true,"op":"stop"}', Priority.URGENT),
        (b'{"op":"disarm","axis":"x"}', Priority.URGENT),
        (b'{"op":"\\u0073top"}', Priority.URGENT),
        (b'{"op":"status","axis":"stop"}', Priority.REQUEST),
        (b'{"op":"move","positions":{"stop":1}}', Priority.REQUEST),
    ],
)
def test_a_request_is_as_urgent_as_what_it_asks_for(line: bytes, rank: Priority) -> None:
    request = parse_request(line)
    assert priority_of(request) is rank
    assert isinstance(request, StopRequest | DisarmRequest) == (rank is Priority.URGENT)


@pytest.mark.parametrize(
    ("line", "name"),
    [
        (b'{"op":"stop","op":"arm"}', "op"),
        (b'{"op":"stop","o\\u0070":"arm"}', "op"),
        (b'{"op":"move","position":1,"position":1}', "position"),
        (b'{"op":"move","positions":{"x":1,"y":2,"x":3}}', "x"),
    ],
)
def test_a_key_that_is_given_twice_is_refused_by_its_name(tmp_path: Path, line: bytes, name: str) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        answer = await (await connect(tmp_path / "s")).send(line)
        assert answer["error"] == {"code": "bad_request", "message": f"{name} is given twice: give it once"}
        assert world.state() is State.DISARMED

    serve(tmp_path / "s", script)


def test_lines_that_only_speak_of_a_stop_take_no_urgent_turn(tmp_path: Path) -> None:
    ranks: list[Priority] = []

    async def script(world: World, _: ControlSocket) -> None:
        turn = world.loop.parts.background.slot

        @contextlib.asynccontextmanager
        async def noted(rank: Priority) -> AsyncIterator[None]:
            ranks.append(rank)
            async with turn(rank):
                yield

        operator = await connect(tmp_path / "s")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(world.loop.parts.background, "slot", noted)
            assert await operator.refused(op="status", axis="stop") == "which_axis"
            assert (await operator.send(b'{"op":"stop","k":1}'))["error"]["code"] == "bad_request"
            assert (await operator.send(b'"stop" "disarm"'))["error"]["code"] == "bad_request"
        assert Priority.URGENT not in ranks
        assert Priority.READING in ranks

    serve(tmp_path / "s", script)


def test_a_move_of_all_axes_fits_however_long_their_names() -> None:
    assert longest_line(["x", "y"]) == LONGEST_LINE
    names = [f"{number:02}" + "漢" * 62 for number in range(64)]
    line = json.dumps({"op": "move", "positions": dict.fromkeys(names, -123456.123456789), "velocity": 100.0}).encode()
    assert LONGEST_LINE < len(line) < longest_line(names)
    request = parse_request(line)
    assert isinstance(request, MoveRequest)
    assert request.positions is not None
    assert len(request.positions) == 64


def test_what_an_answer_repeats_is_short(tmp_path: Path) -> None:
    async def script(_: World, __: ControlSocket) -> None:
        operator = await connect(tmp_path / "s")
        for request in (
            {"op": "x" * 3000},
            {"op": "stop", "k" * 3000: 1},
            {"op": "move", "positions": {"n" * 3000: ""}},
        ):
            answer = await operator.ask(**request)
            assert answer["error"]["code"] == "bad_request"
            assert len(answer["error"]["message"]) < 300
        assert (await operator.ask(op="status"))["ok"]
        await asyncio.sleep(0)

    serve(tmp_path / "s", script)


def problem(text: str) -> str:
    """Return what is said of a line that is no request; nothing if it is one."""
    return judged(text.encode())[1]


@pytest.mark.parametrize("position", [-1e9, 1e9, 0, -1, 1.5])
def test_a_position_may_be_as_far_as_the_bound(position: float) -> None:
    assert problem(json.dumps({"op": "move", "positions": {"x": position}})) == ""


@pytest.mark.parametrize("position", ["-1000000000.5", "1000000000.5", "NaN", "Infinity", "true", '"1"', "null", "[]"])
def test_a_position_that_is_none_is_told_with_its_axis(position: str) -> None:
    said = problem(f'{{"op": "move", "positions": {{"x": 1.0, "y": {position}}}}}')
    assert said == "positions.y: a finite number from -1e9 to 1e9 is needed"


def test_a_move_has_64_axes_at_most() -> None:
    positions = {f"axis{number}": 0.0 for number in range(64)}
    assert problem(json.dumps({"op": "move", "positions": positions})) == ""
    assert problem(json.dumps({"op": "move", "positions": positions | {"more": 0.0}})) == (
        "positions: 65 axes, but at most 64 are allowed"
    )


@pytest.mark.parametrize(("length", "shown"), [(40, 40 * "k"), (41, 40 * "k" + "…")])
def test_a_word_of_up_to_40_characters_is_repeated_whole(length: int, shown: str) -> None:
    assert problem(json.dumps({"op": "stop", length * "k": 1})).startswith(
        f"{shown}: no such key (there are axis, op, quick)"
    )
    assert problem(json.dumps({"op": length * "k"})).startswith(f"op: {shown} is not a request; the requests are ")


def test_what_is_no_request_is_told_in_the_words_of_whoever_wrote_it() -> None:
    assert problem("[1]") == 'a request should be an object, such as {"op": "status"}'
    assert problem("{}").startswith("op: it must name the request; the requests are ")
    assert problem('{"op": 1}').startswith("op: it must name the request; ")
    assert problem("{").startswith("invalid JSON: ")
    assert problem('{"op": "move", "velocity": null}') == "velocity is null: give it a value, or leave it out"
    assert problem('{"op": "move", "position": "far"}').startswith("position: ")
    several = problem('{"op": "watch", "every": "x", "axis": 1}')
    assert {one.partition(":")[0] for one in several.split("; ")} == {"every", "axis"}


def test_a_line_with_few_axes_has_4096_bytes() -> None:
    assert longest_line([]) == longest_line(["x"]) == 4096
    names = [f"a{number:03}" for number in range(200)]
    assert longest_line(names) == 256 + 200 * (len('"a000"') + 2 + 30)
