"""Who commands: two operators at one control socket, connections that die, and jogs that have to be renewed."""

import asyncio
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.service.operators import Operator, connect, serve
from tests.service.rig import World
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import State
from twostage_servo.service.authority import Authority
from twostage_servo.service.control_socket import ControlSocket

COMMANDS: list[dict[str, Any]] = [
    {"op": "arm"}, {"op": "reset"}, {"op": "move", "position": 0.0}, {"op": "jog", "velocity": 5.0}, {"op": "home"},
    {"op": "home", "position": 3.0}, {"op": "reload"}, {"op": "override", "percent": 50},
]  # fmt: skip


async def commanding(world: World, path: Path, position: float = 400.0) -> Operator:
    """Connect, arm, and move until the axis cruises."""
    operator = await connect(path)
    await operator.done(op="arm")
    await world.until(lambda: world.state() is State.HOLDING)
    await operator.done(op="move", position=position)
    await world.seconds(1.0)
    assert world.state() is State.SPEED_STAGE
    return operator


def outcome(world: World) -> tuple[str, str | None]:
    assert world.axis.move is not None
    return world.axis.move.outcome, world.axis.move.reason


# Control authority ----------------------------------------------------------------------------------------------------


def test_the_one_who_commands_holds_authority_and_the_rest_watch(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        first, second, watcher = [await connect(path) for _ in range(3)]
        for reader, request in ((second, {"op": "status"}), (second, {"op": "recording"}), (watcher, {"op": "watch"})):
            await reader.done(**request)
            assert (await first.done(op="status"))["authority"] == {"holder": None}
        holder = (await first.done(op="arm"))["authority"]["holder"]
        assert re.fullmatch(r"pid \d+ uid \d+ #1", holder)
        await world.until(lambda: world.state() is State.HOLDING)
        await first.done(op="move", position=400.0)
        for request in COMMANDS:
            answer = await second.ask(**request)
            assert answer["error"]["code"] == "authority_held", request
            assert holder in answer["error"]["message"]
        await world.seconds(0.5)
        assert outcome(world) == ("moving", None)
        assert (await second.done(op="status"))["authority"]["holder"] == holder

    serve(path, script)


@pytest.mark.parametrize(
    ("request_", "state"),
    [
        ({"op": "stop"}, State.STOPPING),
        ({"op": "stop", "quick": True}, State.QUICK_STOPPING),
        ({"op": "disarm"}, State.DISARMING),
    ],
)
def test_everybody_may_bring_the_axis_to_rest(path: Path, request_: dict[str, Any], state: State) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        first, second = await commanding(world, path), await connect(path)
        answer = await second.done(**request_)
        assert answer["axis"]["state"] == state
        assert answer["authority"]["holder"].endswith("#1")  # and does not command from then on
        assert await second.refused(op="move", position=0.0) == "authority_held"
        rest = State.DISARMED if state is State.DISARMING else State.HOLDING
        await world.until(lambda: world.state() is rest)
        assert outcome(world) == ("stopped", None)
        await world.seconds(0.1)
        await first.done(op="arm" if rest is State.DISARMED else "stop")

    serve(path, script)


def test_authority_that_is_released_can_be_acquired_and_the_move_goes_on(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        first, second = await commanding(world, path), await connect(path)
        await second.done(op="release")  # changes nothing: it is not theirs
        assert await second.refused(op="move", position=0.0) == "authority_held"
        assert (await first.done(op="release"))["authority"] == {"holder": None}
        assert outcome(world) == ("moving", None)
        await second.done(op="move", position=50.0)
        assert await first.refused(op="move", position=0.0) == "authority_held"
        await world.until(lambda: outcome(world)[0] == "reached")

    serve(path, script)


def test_authority_can_be_preempted_at_rest_but_not_in_motion(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        first, second = await commanding(world, path), await connect(path)
        assert await second.refused(op="take") == "busy"
        await second.done(op="stop")
        assert await second.refused(op="take") == "busy"  # still braking
        await world.until(lambda: world.state() is State.HOLDING)
        assert (await second.done(op="take"))["authority"]["holder"].endswith("#2")
        assert await first.refused(op="move", position=0.0) == "authority_held"
        await second.done(op="move", position=0.0)
        await second.done(op="take")  # it is theirs already, also in motion
        await second.done(op="release")
        await first.done(op="take")  # nobody's, also in motion
        assert outcome(world)[0] == "moving"

    serve(path, script)


@pytest.mark.parametrize("request_", [{"op": "jog", "velocity": 10.0}, {"op": "home"}])
def test_authority_is_not_preempted_from_one_who_jogs_or_homes(path: Path, request_: dict[str, Any]) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        first, second = await connect(path), await connect(path)
        await first.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        await first.done(**request_)
        assert await second.refused(op="take") == "busy"

    serve(
        path, script, "axis.homing.method='switch'", "simulation.home_switch_from=-1e3", "simulation.home_switch_to=-50"
    )


def test_a_refused_command_acquires_no_authority_and_loses_none(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        first, second = await connect(path), await connect(path)
        for request in ({"op": "move", "position": 0.0}, {"op": "jog", "velocity": 1.0}, {"op": "reload"}):
            assert await first.refused(**request) in {"disarmed", "no_configuration"}
            assert (await first.done(op="status"))["authority"]["holder"] is None
        await second.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        holder = (await second.done(op="status"))["authority"]["holder"]
        assert await second.refused(op="move", position=3000.0) == "position_limit"
        assert (await first.done(op="status"))["authority"]["holder"] == holder
        assert await first.refused(op="arm") == "authority_held"
        second.writer.close()
        await second.writer.wait_closed()
        await world.seconds(0.01)
        await first.done(op="disarm")
        await world.until(lambda: world.axis.ready_to_arm)
        await first.done(op="arm")


def test_a_reload_that_cannot_be_prepared_acquires_no_authority(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        async def fail() -> Callable[[], None]:
            raise Refused(RefusalCode.CONFIG, "line 3 is wrong")

        world.prepare = fail
        operator = await connect(path)
        assert await operator.refused(op="reload") == "config"
        assert (await operator.done(op="status"))["authority"]["holder"] is None

    serve(path, script)


def test_authority_by_itself() -> None:
    authority = Authority()
    assert not authority.release("a")
    authority.acquire("a")
    authority.acquire("a")
    with pytest.raises(Refused, match="a commands this axis"):
        authority.acquire("b")
    with pytest.raises(Refused, match="as a has commanded"):
        authority.preempt("b", at_rest=False)
    authority.preempt("a", at_rest=False)
    authority.preempt("b", at_rest=True)
    assert (authority.holder, authority.release("a"), authority.release("b"), authority.holder) == (
        "b",
        False,
        True,
        None,
    )


# Connections that die -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policy", "ends", "because"),
    [
        ("continue", "reached", None),
        ("stop", "stopped", "service.holder_lost is stop"),
        ("disarm", "stopped", "service.holder_lost is disarm"),
    ],
)
def test_a_connection_that_dies_in_mid_move(path: Path, policy: str, ends: str, because: str | None) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await commanding(world, path)
        operator.die()
        await world.seconds(0.02)
        assert world.loop.snapshot()["authority"] == {"holder": None}
        await world.until(lambda: outcome(world)[0] != "moving")
        how, reason = outcome(world)
        assert how == ends
        assert reason is None if because is None else because in (reason or "")
        await world.seconds(3.0)
        assert world.state() is (State.DISARMED if policy == "disarm" else State.HOLDING)
        assert world.drive.enabled == (policy != "disarm")
        assert world.axis.trip is None
        await (await connect(path)).done(op="arm" if policy == "disarm" else "stop")

    serve(path, script, f"service.holder_lost='{policy}'")


@pytest.mark.parametrize("policy", ["continue", "stop", "disarm"])
def test_one_who_has_released_may_leave_under_every_policy(path: Path, policy: str) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await commanding(world, path, 150.0)
        await operator.done(op="release")
        operator.die()
        await world.until(lambda: outcome(world)[0] != "moving")
        assert outcome(world) == ("reached", None)
        assert world.state() is State.HOLDING

    serve(path, script, f"service.holder_lost='{policy}'")


@pytest.mark.parametrize("policy", ["stop", "disarm"])
def test_the_death_of_a_watcher_or_at_rest_changes_nothing(path: Path, policy: str) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator, watcher = await commanding(world, path, 150.0), await connect(path)
        await watcher.done(op="watch")
        watcher.die()
        await world.until(lambda: world.state() is State.HOLDING)
        assert outcome(world) == ("reached", None)
        operator.die()
        await world.seconds(1.0)
        assert world.state() is State.HOLDING

    serve(path, script, f"service.holder_lost='{policy}'")


@pytest.mark.parametrize(("policy", "state"), [("stop", State.HOLDING), ("disarm", State.DISARMED)])
def test_a_search_for_the_reference_follows_the_policy_too(path: Path, policy: str, state: State) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        await operator.done(op="home")
        await world.seconds(0.5)
        operator.die()
        await world.seconds(1.0)
        assert world.state() is state
        assert outcome(world)[0] == "stopped"

    serve(
        path, script, f"service.holder_lost='{policy}'", "axis.homing.method='switch'",
        "simulation.home_switch_from=-1e3", "simulation.home_switch_to=-50",
    )  # fmt: skip


# Jog ------------------------------------------------------------------------------------------------------------------


async def jogging(world: World, path: Path, velocity: float = 50.0, seconds: float = 1.0) -> Operator:
    """Connect, arm, and jog for a time, asking again every 100 ms."""
    operator = await connect(path)
    await operator.done(op="arm")
    await world.until(lambda: world.state() is State.HOLDING)
    await renew(world, operator, velocity, seconds)
    assert world.state() is State.JOGGING
    return operator


async def renew(world: World, operator: Operator, velocity: float, seconds: float) -> None:
    for _ in range(round(seconds / 0.1)):
        await operator.done(op="jog", velocity=velocity)
        await world.seconds(0.1)


def test_a_jog_goes_on_while_it_is_renewed_and_ends_when_it_is_not(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await jogging(world, path, seconds=5.0)
        assert world.drive.velocity == pytest.approx(50.0, abs=0.5)
        status = await operator.done(op="status")
        assert (status["move"]["number"], status["move"]["kind"], status["axis"]["state"]) == (1, "jog", "jogging")
        position = world.drive.position
        await world.until(lambda: world.state() is State.HOLDING)
        how, reason = outcome(world)
        assert how == "stopped"
        assert "not renewed within 300 ms" in (reason or "")
        # 300 ms from the last request, of which 100 ms were over; then a ramp of 25 ms.
        assert 0.2 * 50.0 - 1.0 < world.drive.position - position < 0.2 * 50.0 + 3.0
        assert world.axis.trip is None

    serve(path, script)


@pytest.mark.parametrize("policy", ["continue", "stop", "disarm"])
def test_a_jog_ends_with_its_connection_whatever_the_policy(path: Path, policy: str) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await jogging(world, path)
        position = world.drive.position
        operator.die()
        await world.seconds(0.02)
        assert world.state() is State.STOPPING
        assert "has disconnected while it held the jog" in (outcome(world)[1] or "")
        await world.until(lambda: world.state() is State.HOLDING)
        assert world.drive.position - position < 4.0

    serve(path, script, f"service.holder_lost='{policy}'")


async def ask_blindly(world: World, operator: Operator, seconds: float) -> list[str]:
    """Ask for a jog every 100 ms whatever the answers are, as a pendant does; return the codes of the refusals."""
    codes = []
    for _ in range(round(seconds / 0.1)):
        answer = await operator.ask(op="jog", velocity=50.0)
        codes.append("" if answer["ok"] else answer["error"]["code"])
        await world.seconds(0.1)
    return codes


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("is_let_go_before", [False, True])
def test_a_stop_by_somebody_else_outlasts_a_jog_that_is_asked_for_blindly(
    path: Path,
    quick: bool,
    is_let_go_before: bool,
) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator, other = await jogging(world, path), await connect(path)
        if is_let_go_before:  # the time-out has just ended the jog, and the operator is about to go on
            await world.until(lambda: world.state() is State.HOLDING)
        await other.done(op="stop", quick=quick)
        await world.until(lambda: world.state() is State.HOLDING)
        place = world.drive.position
        assert set(await ask_blindly(world, operator, 3.0)) == {"stopped"}
        assert world.state() is State.HOLDING
        assert abs(world.drive.position - place) < 0.5
        await world.seconds(0.35)  # it is let go
        assert set(await ask_blindly(world, operator, 1.0)) == {""}
        assert world.drive.position > place + 20.0

    serve(path, script)


def test_whoever_stops_its_own_jog_may_jog_on_at_once(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await jogging(world, path)
        await operator.done(op="stop")
        await world.until(lambda: world.state() is State.HOLDING)
        await operator.done(op="jog", velocity=50.0)

    serve(path, script)


def test_a_jog_comes_to_rest_at_the_position_limit(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        while (await operator.done(op="jog", velocity=50.0))["axis"]["state"] == "jogging":
            await world.seconds(0.1)
            if world.state() is not State.JOGGING:
                break
        assert (world.state(), outcome(world)) == (State.HOLDING, ("reached", None))
        assert world.drive.position == pytest.approx(100.0, abs=0.06)
        await operator.done(op="jog", velocity=-50.0)
        await operator.done(op="stop")

    serve(path, script, "axis.limits.position_maximum=100.0")


def test_a_jog_can_change_its_velocity_and_turn_round(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await jogging(world, path)
        await renew(world, operator, 20.0, 1.0)
        assert world.drive.velocity == pytest.approx(20.0, abs=0.5)
        await renew(world, operator, -50.0, 1.0)
        assert world.drive.velocity == pytest.approx(-50.0, abs=0.5)
        assert world.axis.trip is None
        await operator.done(op="stop", quick=True)
        await world.until(lambda: world.state() is State.HOLDING)

    serve(path, script)


@pytest.mark.parametrize(
    ("velocity", "code"), [(0.0, "velocity_limit"), (250.1, "velocity_limit"), (-251.0, "velocity_limit")]
)
def test_a_jog_that_is_too_fast_is_refused(path: Path, velocity: float, code: str) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        assert await operator.refused(op="jog", velocity=50.0) == "disarmed"
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        assert await operator.refused(op="jog", velocity=velocity) == code
        await operator.done(op="move", position=100.0)
        assert await operator.refused(op="jog", velocity=50.0) == "busy"

    serve(path, script)


# What else the socket can ask for -------------------------------------------------------------------------------------


def test_an_axis_that_must_be_homed_takes_no_set_point_before(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        assert (await operator.done(op="status"))["axis"]["referenced"] is False
        assert await operator.refused(op="move", position=10.0) == "not_homed"
        assert await operator.refused(op="jog", velocity=21.0) == "velocity_limit"  # axis.homing.velocity is the most
        answer = await operator.done(op="home")
        assert (answer["axis"]["state"], answer["move"]["kind"]) == ("homing", "home")
        await world.until(lambda: world.state() is State.HOLDING)
        status = await operator.done(op="status")
        assert (status["axis"]["referenced"], status["move"]["outcome"]) == (True, "reached")
        await operator.done(op="move", position=100.0)
        await world.until(lambda: outcome(world)[0] != "moving" and world.state() is State.HOLDING)
        assert outcome(world)[0] == "reached"
        # The switch, open from -50 mm up, is at position 7.
        assert world.drive.position == pytest.approx(-50.0 - 7.0 + 100.0, abs=0.3)

    serve(
        path, script, "axis.homing.required=true", "axis.homing.method='switch'", "axis.homing.position=7.0",
        "simulation.home_switch_from=-1e3", "simulation.home_switch_to=-50",
    )  # fmt: skip


def test_the_place_where_the_axis_stands_can_be_given(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        answer = await operator.done(op="home", position=123.5)  # also while it is disarmed
        assert answer["axis"]["position"] == pytest.approx(123.5)
        assert answer["axis"]["referenced"] is True
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        await operator.done(op="move", position=100.0)
        assert await operator.refused(op="home", position=0.0) == "busy"
        await world.until(lambda: world.state() is State.HOLDING)
        assert world.drive.position == pytest.approx(-23.5, abs=0.06)

    serve(path, script, "axis.homing.required=true")


def test_off_a_limit_switch_only_the_way_back_is_open(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        await operator.done(op="move", position=400.0)
        await world.until(lambda: world.state() is State.TRIPPED)
        status = await operator.done(op="status")
        assert (status["trip"]["code"], status["trip"]["reaction"]) == ("limit_switch", "quick_stop")
        assert status["inputs"]["positive_limit"] is True
        assert await operator.refused(op="move", position=0.0) == "tripped"
        await operator.done(op="reset")
        await world.until(lambda: world.axis.ready_to_arm)
        await operator.done(op="arm")
        await world.until(lambda: world.state() is State.HOLDING)
        assert await operator.refused(op="move", position=400.0) == "limit_switch"
        assert await operator.refused(op="jog", velocity=5.0) == "limit_switch"
        await operator.done(op="move", position=0.0)
        await world.until(lambda: outcome(world)[0] == "reached")

    serve(path, script, "simulation.positive_limit_from=100")


def test_safe_torque_off_is_shown_and_keeps_the_axis_from_arming(path: Path) -> None:
    async def script(world: World, _: ControlSocket) -> None:
        operator = await connect(path)
        assert (await operator.done(op="status"))["inputs"]["safe_torque_off"] is False
        world.drive.change(asyncio.get_running_loop().time(), safe_torque_off=True)
        await world.seconds(0.05)
        assert (await operator.done(op="status"))["inputs"]["safe_torque_off"] is True
        assert await operator.refused(op="arm") == "safe_torque_off"
        world.drive.change(asyncio.get_running_loop().time(), safe_torque_off=False)
        await world.until(lambda: world.axis.ready_to_arm)
        await operator.done(op="arm")

    serve(path, script)
