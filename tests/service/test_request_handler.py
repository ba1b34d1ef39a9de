"""What becomes of a request, by itself: carried out, refused or dropped, and what the log is told of it."""

import asyncio
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import structlog

from tests.service.rig import World, simulate
from tests.service.test_log_lines import of
from twostage_servo.api.request_reading import parse_request
from twostage_servo.axis.state import State


@dataclass
class Client:
    """Who asks, and since when there was nothing of it."""

    peer: str = "pid 1 uid 2 #3"
    arrived_after_s: float = 0.0
    gone: bool = False


class Asking:
    """Requests to a service whose axis is armed."""

    def __init__(self, world: World) -> None:
        self.handler = world.requests
        self.status = world.requests.status

    def ask(self, client: Client | None = None, *, age_s: float = 0.0, **fields: Any) -> dict[str, Any] | None:
        """Return the answer of a request of this age; None if there is none."""
        client = client or Client()
        client.arrived_after_s = asyncio.get_running_loop().time() - age_s
        reply = self.handler.answer(parse_request(json.dumps(fields).encode()), client)
        line = b"".join(reply.pieces)
        answer: dict[str, Any] | None = json.loads(line) if line else None
        assert reply.done is (answer is not None and answer["ok"])
        return answer


def with_an_axis_that_holds(script: Callable[[World, Asking], None]) -> list[Any]:
    """Run a script with an axis that holds; return the lines of the log since then."""

    async def main(world: World) -> list[Any]:
        await world.armed()
        with structlog.testing.capture_logs() as logs:
            script(world, Asking(world))
        return logs

    return simulate(main)


def test_who_listens_is_told_of_what_was_carried_out_and_not_of_what_was_read_refused_or_dropped() -> None:
    told: list[tuple[str, str]] = []

    def script(world: World, asking: Asking) -> None:
        asking.handler.listen(lambda request, client: told.append((request.op, client)))
        asking.ask(op="status")
        asking.ask(op="move", position=1e6)
        asking.ask(Client(gone=True), op="move", position=5.0)
        asking.ask(op="move", position=5.0)
        asking.ask(Client(gone=True), op="stop")
        asking.handler.handle(parse_request(b'{"op": "disarm"}'), "another")

    with_an_axis_that_holds(script)
    assert told == [("move", "pid 1 uid 2 #3"), ("stop", "pid 1 uid 2 #3"), ("disarm", "another")]


def test_what_is_carried_out_is_told_with_who_asked_for_what() -> None:
    def script(world: World, asking: Asking) -> None:
        answer = asking.ask(op="move", position=5.0)
        assert answer is not None
        assert answer["move"]["target"] == 5.0
        asking.ask(op="status")
        asking.ask(op="recording")
        asking.ask(op="jog", velocity=1.0)

    logs = with_an_axis_that_holds(script)
    assert of(logs, "request") == [
        {
            "event": "request", "log_level": "info", "room": "control_socket", "peer": "pid 1 uid 2 #3", "op": "move",
            "axis": "x", "position": 5.0,
        }
    ]  # fmt: skip


def test_an_old_name_is_taken_and_the_log_names_the_new_one() -> None:
    def script(_: World, asking: Asking) -> None:
        answer = asking.ask(op="take")
        assert answer is not None
        assert answer["ok"]
        asking.ask(op="preempt")

    (told,) = of(with_an_axis_that_holds(script), "the old name of an operation")
    assert (told["op"], told["use"], told["log_level"]) == ("take", "preempt", "warning")


def test_what_is_refused_is_told_to_the_client_and_to_the_log() -> None:
    def script(_: World, asking: Asking) -> None:
        answer = asking.ask(op="move", position=1e6)
        assert answer is not None
        said.update(answer["error"])
        assert asking.ask(op="status", axis="y")["error"]["code"] == "which_axis"  # type: ignore[index]

    said: dict[str, str] = {}
    told, other = of(with_an_axis_that_holds(script), "refused")
    assert told == {
        "event": "refused", "log_level": "warning", "room": "control_socket", "peer": "pid 1 uid 2 #3", "op": "move",
        "axis": "x", "code": said["code"], "reason": said["message"],
    }  # fmt: skip
    assert (other["op"], other["code"]) == ("status", "which_axis")
    assert "axis" not in other  # an invented name is none of ours


def test_of_one_who_has_gone_only_what_brings_to_rest_is_carried_out() -> None:
    def script(world: World, asking: Asking) -> None:
        gone = Client(gone=True)
        assert asking.ask(gone, op="move", position=5.0) is None
        assert world.axis.state is State.HOLDING
        assert asking.ask(gone, op="status") is not None
        asking.ask(op="move", position=100.0)
        assert asking.ask(gone, op="stop") is not None
        assert world.state() is State.STOPPING

    assert of(with_an_axis_that_holds(script), "request dropped: its client has disconnected") == [
        {
            "event": "request dropped: its client has disconnected", "log_level": "warning", "room": "control_socket",
            "peer": "pid 1 uid 2 #3", "op": "move", "axis": "x",
        }
    ]  # fmt: skip


@pytest.mark.parametrize(("age_s", "expired"), [(0.999, False), (1.001, True)])
def test_a_command_expires_after_a_second(age_s: float, *, expired: bool) -> None:
    def script(_: World, asking: Asking) -> None:
        answer = asking.ask(age_s=age_s, op="move", position=5.0)
        assert answer is not None
        assert answer["ok"] is not expired
        if expired:
            assert answer["error"]["code"] == "expired"
            assert "this move may have waited for 1.0 s" in answer["error"]["message"]
            assert "at most 1 s is allowed" in answer["error"]["message"]

    with_an_axis_that_holds(script)


@pytest.mark.parametrize("op", ["stop", "disarm", "release", "status"])
def test_what_sets_nothing_in_motion_never_expires(op: str) -> None:
    def script(_: World, asking: Asking) -> None:
        asking.ask(op="move", position=100.0)
        answer = asking.ask(age_s=100.0, op=op)
        assert answer is not None
        assert answer["ok"]

    with_an_axis_that_holds(script)


def test_a_flood_of_stops_makes_a_report_for_the_first_alone() -> None:
    def script(_: World, asking: Asking) -> None:
        asking.ask(op="move", position=100.0)
        states = [asking.ask(op="stop") for _ in range(5)]
        made.append(asking.status.made)
        asking.ask(op="status")
        made.append(asking.status.made)
        assert states == [states[0]] * 5
        assert states[0] is not None
        assert states[0]["axis"]["state"] == "stopping"

    made: list[int] = []
    with_an_axis_that_holds(script)
    assert made == [2, 2]  # of the move, and of the first stop


def test_an_answer_that_cannot_be_made_ends_the_service() -> None:
    def script(world: World, asking: Asking) -> None:
        def broken(_: object) -> None:
            raise RuntimeError("a defect")

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("twostage_servo.service.status_lines.report_axis", broken)
            answer = asking.handler.answer(parse_request(b'{"op": "status"}'), Client())
            told = json.loads(b"".join(answer.pieces))
        assert told["error"]["code"] == "internal_error"
        assert "RuntimeError: a defect; the service is stopping" in told["error"]["message"]
        assert world.service.shutdown.is_ending

    with_an_axis_that_holds(script)


def test_a_defect_in_preparing_a_reload_ends_the_service_and_is_told() -> None:
    async def main(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)

        async def prepare() -> Callable[[], None]:
            raise RuntimeError("a defect")

        world.prepare = prepare
        client = Client(arrived_after_s=asyncio.get_running_loop().time())
        refused = await Asking(world).handler.prepare(parse_request(b'{"op": "reload"}'), client)
        assert refused is not None
        error = json.loads(b"".join(refused.pieces))["error"]
        assert error == {"code": "internal_error", "message": "RuntimeError: a defect; the service is stopping"}
        assert world.service.shutdown.is_ending

    simulate(main)


def test_a_reload_is_not_too_late_after_a_long_preparation_that_was_begun_in_time() -> None:
    async def main(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        put: list[str] = []

        async def prepare() -> Callable[[], None]:
            await world.seconds(5.0)
            return lambda: put.append("in force")

        world.prepare = prepare
        asking, reload = Asking(world), parse_request(b'{"op": "reload"}')
        client = Client(arrived_after_s=asyncio.get_running_loop().time())
        assert await asking.handler.prepare(reload, client) is None
        assert asking.handler.answer(reload, client).done
        assert put == ["in force"]
        refused = await asking.handler.prepare(reload, client)  # which is too old by now to be begun
        assert refused is not None
        assert json.loads(b"".join(refused.pieces))["error"]["code"] == "expired"
        assert not asking.handler.answer(reload, client).done
        assert put == ["in force"]

    simulate(main)
