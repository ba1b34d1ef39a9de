"""What `jog` ends with: 0 where it went on for its time, to the limit or until Ctrl-C, 3 where else it was ended."""

import copy
import json

import pytest

from tests.cli.test_disabled_drive import Told
from tests.service.rig import World, simulate
from twostage_servo.api.fields import JsonObject
from twostage_servo.api.requests import JogRequest, Request
from twostage_servo.axis.state import State
from twostage_servo.cli.main import main
from twostage_servo.client import blocking, verbs

Snapshots = dict[str, JsonObject]


@pytest.fixture(scope="module")
def snapshots() -> Snapshots:
    """What a service tells of an axis that jogs, and of how a jog ends."""
    told: Snapshots = {}

    def tell(name: str, world: World) -> None:
        told[name] = copy.deepcopy(json.loads(json.dumps(world.loop.snapshot())))

    async def script(world: World) -> None:
        await world.armed()
        world.axis.jog(50.0)
        await world.seconds(0.1)
        tell("jogging", world)
        await world.until(lambda: world.state() is State.HOLDING)
        tell("not renewed", world)
        world.axis.jog(50.0)
        await world.seconds(0.1)
        tell("another jog", world)
        world.axis.disarm()
        await world.until(lambda: world.state() is State.DISARMED)
        tell("disarmed", world)
        await world.armed()
        tell("armed anew", world)

    simulate(script)
    return told


class Service(Told):
    """A service whose answers depend on what has been asked: to `jog` it jogs, then it tells what came of it."""

    def __init__(self, jogging: JsonObject, then: JsonObject) -> None:
        super().__init__([then])
        self._jogging = jogging

    def ask(self, request: Request, patience_s: float | None = None) -> JsonObject:
        answer = super().ask(request, patience_s)
        return self._jogging if isinstance(request, JogRequest) else answer


@pytest.fixture(autouse=True)
def no_time_between(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verbs, "JOG_INTERVAL_S", 0.0)


@pytest.mark.parametrize("then", ["not renewed", "another jog", "disarmed", "armed anew"])
@pytest.mark.parametrize("seconds", [[], ["--seconds", "2"]])
def test_a_jog_that_something_else_has_ended_was_not_done(
    monkeypatch: pytest.MonkeyPatch, snapshots: Snapshots, then: str, seconds: list[str]
) -> None:
    service = Service(snapshots["jogging"], snapshots[then])
    monkeypatch.setattr(blocking, "Connection", lambda *_: service)
    monkeypatch.setattr(verbs, "_none_in", lambda _: lambda _: True)  # it is at rest by then
    assert main(["jog", "50", *seconds, "--socket", "socket"]) == 3
    assert [request["op"] for request in service.requests if request["op"] != "status"] == ["jog"]


def test_a_jog_that_has_come_to_its_limit_was(monkeypatch: pytest.MonkeyPatch, snapshots: Snapshots) -> None:
    at_limit = copy.deepcopy(snapshots["not renewed"])
    at_limit["move"] |= {"outcome": "reached", "reason": None}
    service = Service(snapshots["jogging"], at_limit)
    monkeypatch.setattr(blocking, "Connection", lambda *_: service)
    assert main(["jog", "50", "--socket", "socket"]) == 0
