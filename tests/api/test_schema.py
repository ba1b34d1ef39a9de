"""The schemas in the docs, and that requests and the answers of a running service are as they say."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.service.operators import connect, serve
from tests.service.rig import World, simulate
from tests.service.test_several_axes import Plant, axis_page, machine_file, operate
from twostage_servo.api.records import UnreadableError
from twostage_servo.api.requests import OPERATIONS
from twostage_servo.api.schema import schema_of_request, schema_of_requests, schema_of_status
from twostage_servo.api.status import AxisReport, Status
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.service.control_socket import ControlSocket

DOCS = Path(__file__).parents[2] / "docs"
TYPES: dict[str, Any] = {
    "object": dict, "array": list, "string": str, "number": (int, float), "integer": int, "boolean": bool,
    "null": type(None),
}  # fmt: skip


class Checker:
    """Compares values with a schema: of the words of JSON schema it knows those that ours use."""

    def __init__(self, schema: dict[str, Any]) -> None:
        self._definitions = schema.get("$defs", {})

    def complaints(self, schema: dict[str, Any], value: Any, place: str = "") -> list[str]:
        """Return what about a value is not as a schema says."""
        if "$ref" in schema:
            return self.complaints(self._definitions[schema["$ref"].rpartition("/")[2]], value, place)
        if value not in schema.get("enum", [value]) or value != schema.get("const", value):
            return [f"{place}: {value!r} is none of those that are possible"]
        kind = schema.get("type")
        if kind and (not isinstance(value, TYPES[kind]) or (isinstance(value, bool) and kind != "boolean")):
            return [f"{place}: {value!r:.60} is not of the type {kind}"]
        found = self._of_alternatives(schema, value, place)
        if isinstance(value, dict):
            found += self._of_object(schema, value, place)
        if isinstance(value, list):
            found += [text for one in value for text in self.complaints(schema.get("items", {}), one, f"{place}[]")]
        return found

    def _of_alternatives(self, schema: dict[str, Any], value: Any, place: str) -> list[str]:
        found = [text for one in schema.get("allOf", []) for text in self.complaints(one, value, place)]
        for word, most in (("anyOf", 99), ("oneOf", 1)):
            fits = sum(not self.complaints(one, value, place) for one in schema.get(word, []))
            if word in schema and not 1 <= fits <= most:
                found.append(f"{place}: {fits} of {word} fit {value!r:.60}")
        return found

    def _of_object(self, schema: dict[str, Any], value: dict[str, Any], place: str) -> list[str]:
        properties, rest = schema.get("properties", {}), schema.get("additionalProperties", {})
        found = [f"{place}: {name} is missing" for name in schema.get("required", []) if name not in value]
        for name, inner in value.items():
            if name not in properties and rest is False:
                found.append(f"{place}: {name} is not known")
            else:
                found += self.complaints(properties.get(name, rest), inner, f"{place}.{name}")
        return found


def of_status(answer: dict[str, Any]) -> list[str]:
    schema = schema_of_status()
    return Checker(schema).complaints(schema, answer)


@pytest.mark.parametrize(
    ("name", "schema"), [("requests.schema.json", schema_of_requests()), ("status.schema.json", schema_of_status())]
)
def test_the_schemas_in_the_docs_are_those_of_the_code(name: str, schema: dict[str, Any]) -> None:
    assert json.loads((DOCS / name).read_text("utf-8")) == schema, "run: python -m tools.write_tables"


def test_the_answers_of_a_running_service_are_as_the_schema_says_and_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"

    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)

        async def look() -> Status:
            answer = await operator.done(op="status")
            del answer["ok"]
            assert of_status(answer) == []
            status = Status.from_json(answer)
            assert json.loads(json.dumps(status.to_json())) == answer
            assert list(status.to_json()) == list(answer)
            return status

        assert (await look()).axis.state is State.DISARMED
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        await operator.done(op="move", position=400.0)
        await world.seconds(1.0)
        moving = await look()
        assert moving.move is not None
        assert moving.move.target == 400.0
        assert isinstance(moving.axis.velocity, float)
        world.axis.raise_trip(TripCode.FOLLOWING_ERROR, "for a test")
        await world.seconds(1.0)
        tripped = await look()
        assert tripped.trip is not None
        assert tripped.trip.code is TripCode.FOLLOWING_ERROR
        assert tripped.trip.codes == [TripCode.FOLLOWING_ERROR]

    serve(path, script)


def test_the_status_of_several_axes_is_as_the_schema_says(tmp_path: Path) -> None:
    async def script(plant: Plant) -> None:
        answer = json.loads(json.dumps(plant.loop.snapshot()))
        assert of_status(answer) == []
        status = Status.from_json(answer)
        assert list(status.axes) == ["x", "y"]
        assert json.loads(json.dumps(status.to_json())) == answer
        with pytest.raises(LookupError, match=r"several axes \(x, y\)"):
            _ = status.axis

    operate(machine_file(tmp_path, {name: axis_page(name, f"can{name}") for name in "xy"}), script)


def test_what_is_no_status_is_told_by_its_name() -> None:
    async def script(world: World) -> dict[str, Any]:
        answer: dict[str, Any] = json.loads(json.dumps(world.loop.snapshot()))
        return answer

    answer = simulate(script)
    assert of_status(answer) == []
    for change, said in (
        ({"state": "flying"}, "axis: state: 'flying' is not a valid State"),
        ({"position": "far"}, "axis: position: 'far' is of another type"),
        ({"saturated": 1}, "axis: saturated: 1 is of another type"),
    ):
        changed = answer | {"axis": answer["axis"] | change}
        assert of_status(changed)
        with pytest.raises(UnreadableError, match=said):
            Status.from_json(changed)
    del answer["frames"]
    assert of_status(answer)
    with pytest.raises(UnreadableError, match="frames is missing"):
        AxisReport.from_json(answer)
    with pytest.raises(UnreadableError, match="an object is needed"):
        AxisReport.from_json([])  # type: ignore[arg-type]


@pytest.mark.parametrize("op", OPERATIONS)
def test_a_request_as_it_is_sent_is_as_its_schema_says(op: str) -> None:
    needed: dict[str, dict[str, Any]] = {
        "jog": {"velocity": 1.0}, "move": {"positions": {"x": 1}}, "override": {"percent": 0.0},
    }  # fmt: skip
    request = OPERATIONS[op](**needed.get(op, {}))
    schema = schema_of_request(OPERATIONS[op])
    assert Checker(schema).complaints(schema, request.to_json()) == []
    assert Checker(schema).complaints(schema, request.to_json() | {"k": 1})
