"""What `override` asks for, what it says, and what it ends with."""

import copy
import json

import pytest

from tests.cli.test_disabled_drive import Told
from tests.service.rig import World, simulate
from twostage_servo.api.fields import JsonObject
from twostage_servo.cli.main import main
from twostage_servo.client import blocking


@pytest.fixture(scope="module")
def held() -> JsonObject:
    """What a service tells of an axis that is held on its way to 400 mm."""

    async def script(world: World) -> JsonObject:
        await world.cruising()
        world.axis.set_override(0.0)
        await world.seconds(0.5)
        status: JsonObject = json.loads(json.dumps(world.loop.snapshot()))
        return status

    return simulate(script)


def use(monkeypatch: pytest.MonkeyPatch, answer: JsonObject) -> Told:
    service = Told([copy.deepcopy(answer)])
    monkeypatch.setattr(blocking, "Connection", lambda *_: service)
    return service


@pytest.mark.parametrize(
    ("arguments", "request_"),
    [
        (["0"], {"op": "override", "percent": 0.0}),
        (["62.5"], {"op": "override", "percent": 62.5}),
        (["200", "--axis", "x"], {"op": "override", "percent": 200.0, "axis": "x"}),
    ],
)
def test_it_asks_for_the_percentage(
    monkeypatch: pytest.MonkeyPatch, held: JsonObject, arguments: list[str], request_: JsonObject
) -> None:
    service = use(monkeypatch, held)
    assert main(["override", *arguments, "--socket", "socket"]) == 0
    assert service.requests == [request_]


@pytest.mark.parametrize(("percent", "why"), [
    ("-1", "greater than or equal to 0"), ("201", "less than or equal to 200"), ("nan", "a finite number"),
    ("-1e3", "greater than or equal to 0"), ("inf", "a finite number"),
])  # fmt: skip
def test_what_is_no_percentage_is_bad_usage(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], held: JsonObject, percent: str, why: str
) -> None:
    service = use(monkeypatch, held)
    assert main(["override", percent, "--socket", "socket"]) == 2
    assert service.requests == []
    assert f"percent: should be {why}" in capsys.readouterr().err


def test_an_axis_that_is_held_is_shown_as_such(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], held: JsonObject
) -> None:
    use(monkeypatch, held)
    assert main(["override", "0", "--socket", "socket"]) == 0
    line = capsys.readouterr().out
    assert ", override 0 %; set-point 400 mm moving" in line
    assert main(["status", "--socket", "socket"]) == 0
    row = "speed override   0 %: the axis is held, and goes on to its set-point when the override rises\n"
    assert row in capsys.readouterr().out
    assert main(["override", "0", "--json", "--socket", "socket"]) == 0
    assert json.loads(capsys.readouterr().out)["axis"]["override_percent"] == 0.0


def test_at_100_percent_nothing_is_said_but_by_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], held: JsonObject
) -> None:
    usual = copy.deepcopy(held)
    usual["axis"]["override_percent"] = 100.0
    use(monkeypatch, usual)
    assert main(["override", "100", "--socket", "socket"]) == 0
    assert "override" not in capsys.readouterr().out
    assert main(["status", "--socket", "socket"]) == 0
    assert "speed override   100 %\n" in capsys.readouterr().out
