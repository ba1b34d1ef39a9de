"""What the desk makes of each request, with axes that only write down what they are told."""

from types import SimpleNamespace
from typing import Any

import pytest
import structlog

from twostage_servo.api.request_reading import read_request
from twostage_servo.axis.refusals import RefusalCode, Refused
from twostage_servo.axis.state import COMMANDED, State
from twostage_servo.service.desk import Desk
from twostage_servo.timing.virtual_clock import run as run_alone


class WrittenDown:
    """An axis that writes down what it is told, and refuses what it is set to refuse."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.state = State.DISARMED
        self.trip: object | None = None
        self.can_stop = True
        self.slowest_velocity = 0.5
        self.settings = SimpleNamespace(cruise_velocity=100.0)
        self.estimate = SimpleNamespace(position=0.0)
        self.duration = SimpleNamespace(
            duration_s=lambda distance, velocity: distance / velocity,
            velocity_for=lambda distance, duration_s, fastest: min(fastest, distance / duration_s),
        )
        self.told: list[tuple[Any, ...]] = []
        self.refuses: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        def tell(*arguments: Any, **named: Any) -> None:
            if name in self.refuses:
                raise Refused(RefusalCode.BUSY, f"{self.name} refuses {name}")
            self.told.append((name, *arguments, *named.items()))

        return tell


class Service:
    """Two axes, each on its own bus."""

    def __init__(self) -> None:
        self.axes = {name: WrittenDown(name) for name in ("x", "y")}
        self.discarded: list[str] = []
        self.axis_loops: list[Any] = [self._axis_loop(name, axis) for name, axis in self.axes.items()]
        self.settings = SimpleNamespace(holder_lost="continue")
        self.is_ending = False
        self.failed: list[Exception] = []
        self.desk = Desk(self)  # type: ignore[arg-type]

    def _axis_loop(self, name: str, axis: WrittenDown) -> Any:
        recorder = SimpleNamespace(records=lambda: [f"of {name}"], discard=lambda: self.discarded.append(name))
        return SimpleNamespace(name=name, axis=axis, bus=SimpleNamespace(error=None), recorder=recorder)

    def axis_loop(self, name: str | None) -> Any:
        if name is None:
            raise KeyError(name)
        return next((one for one in self.axis_loops if one.name == name), None) or self.axis_loop(None)

    def snapshot(self, name: str | None) -> dict[str, Any]:
        return {"of": name}

    def fail(self, error: Exception) -> None:
        self.failed.append(error)

    def ask(self, client: str = "operator", **request: Any) -> dict[str, Any]:
        return self.desk.handle(read_request(request), client)

    def refusal(self, client: str = "operator", **request: Any) -> tuple[str, str]:
        with pytest.raises(Refused) as refused:
            self.ask(client, **request)
        return refused.value.code, str(refused.value)

    def told(self) -> dict[str, list[tuple[Any, ...]]]:
        return {name: axis.told for name, axis in self.axes.items() if axis.told}


# Which axis ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "told"),
    [
        ({"op": "jog", "velocity": -5.0}, [("jog", -5.0)]),
        ({"op": "home"}, [("home",)]),
        ({"op": "home", "position": 7.0}, [("set_position", 7.0)]),
        ({"op": "move", "position": 3.0}, [("move_to", 3.0, 100.0)]),
        ({"op": "move", "position": 3.0, "velocity": 20.0}, [("move_to", 3.0, 20.0)]),
        ({"op": "move", "by": -3.0}, [("move_by", -3.0, 100.0)]),
        ({"op": "move", "by": -3.0, "velocity": 20.0}, [("move_by", -3.0, 20.0)]),
    ],
)
def test_what_concerns_one_axis_goes_to_the_one_that_is_named_or_is_refused(
    request_: dict[str, Any], told: list[tuple[Any, ...]]
) -> None:
    service = Service()
    assert service.ask(**request_, axis="y") == {"of": "y"}
    assert service.told() == {"y": told}
    assert service.refusal(**request_) == (
        "which_axis",
        "this concerns one axis, and there are several: name one of x, y.",
    )
    assert service.refusal(**request_, axis="z") == ("which_axis", "there is no axis z: name one of x, y.")
    assert service.told() == {"y": told}


@pytest.mark.parametrize(
    ("request_", "told"),
    [
        ({"op": "stop"}, [("stop", ("quick", False))]),
        ({"op": "stop", "quick": True}, [("stop", ("quick", True))]),
        ({"op": "disarm"}, [("disarm",)]),
        ({"op": "arm"}, [("check_arming",), ("arm",)]),
        ({"op": "reset"}, [("check_reset",), ("reset",)]),
    ],
)
def test_what_concerns_all_axes_goes_to_all_of_them_unless_one_is_named(
    request_: dict[str, Any], told: list[tuple[Any, ...]]
) -> None:
    service = Service()
    service.ask(**request_, axis="y")
    assert service.told() == {"y": told}
    assert service.ask(**request_) == {"of": None}
    assert service.told() == {"x": told, "y": 2 * told}


def test_reading_is_of_the_axis_that_is_named() -> None:
    service = Service()
    assert service.ask(op="status", axis="x") == {"of": "x"}
    assert service.ask(op="recording", axis="y")["records"] == ["of y"]
    assert service.refusal(op="recording")[0] == "which_axis"
    assert service.refusal(op="status", axis="z")[0] == "which_axis"
    assert service.desk.authority.holder is None


# All or none ---------------------------------------------------------------------------------------------------------


def test_where_some_axes_can_stop_only_these_are_told_to() -> None:
    service = Service()
    service.axes["x"].can_stop = False
    service.ask(op="stop")
    assert service.told() == {"y": [("stop", ("quick", False))]}
    service.axes["y"].can_stop = False
    service.axes["x"].refuses = {"stop"}
    assert service.refusal(op="stop") == ("busy", "axis x: x refuses stop")


def test_where_some_axes_have_tripped_only_these_are_reset() -> None:
    service = Service()
    service.axes["y"].trip = object()
    service.ask(op="reset")
    assert service.told() == {"y": [("check_reset",), ("reset",)]}
    assert service.discarded == ["y"]


@pytest.mark.parametrize(("op", "check"), [("arm", "check_arming"), ("reset", "check_reset")])
def test_what_one_axis_refuses_none_does(op: str, check: str) -> None:
    service = Service()
    service.axes["y"].refuses = {check}
    assert service.refusal(op=op) == ("busy", f"axis y: y refuses {check}")
    assert service.told() == {"x": [(check,)]}
    assert service.discarded == []


def test_no_axis_is_armed_whose_bus_is_closed() -> None:
    service = Service()
    service.axis_loops[1].bus.error = "no carrier"
    assert service.refusal(op="arm") == ("bus_closed", "axis y: the bus is not open: no carrier")
    assert service.told() == {"x": [("check_arming",)]}


@pytest.mark.parametrize(("velocity", "fastest"), [(None, 100.0), (40.0, 40.0)])
def test_axes_that_move_together_take_as_long_as_the_one_that_takes_longest(
    velocity: float | None, fastest: float
) -> None:
    service = Service()
    service.axes["x"].estimate.position = 100.0
    service.axes["y"].estimate.position = 100.0
    fields: dict[str, Any] = {} if velocity is None else {"velocity": velocity}
    service.ask(op="move", positions={"x": -100.0, "y": 150.0}, **fields)
    assert service.told() == {
        "x": [("check_move", -100.0, fastest), ("move_to", -100.0, fastest)],
        "y": [("check_move", 150.0, fastest), ("move_to", 150.0, fastest / 4.0)],
    }


def test_a_short_way_beside_a_very_long_one_is_no_slower_than_an_axis_can_go() -> None:
    service = Service()
    service.ask(op="move", positions={"x": 1e4, "y": 1.0})
    assert service.axes["y"].told[-1] == ("move_to", 1.0, 0.5)


def test_of_a_move_of_several_axes_that_one_refuses_none_is_begun() -> None:
    service = Service()
    service.axes["y"].refuses = {"check_move"}
    assert service.refusal(op="move", positions={"x": 1.0, "y": 1.0})[0] == "busy"
    assert service.told() == {"x": [("check_move", 1.0, 100.0)]}
    assert service.refusal(op="move", positions={"x": 1.0, "z": 1.0})[0] == "which_axis"


# Who commands --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("op", ["arm", "reset", "reload"])
def test_one_client_commands_and_everybody_may_stop_and_disarm(op: str) -> None:
    service = Service()
    service.ask("one", op="arm")
    assert service.refusal("another", op=op)[0] == "lease_held"
    for free in ("stop", "disarm", "status"):
        service.ask("another", op=free)
    service.ask("one", op="release")
    assert service.desk.authority.holder is None
    service.ask("another", op="arm")
    assert service.desk.authority.holder == "another"


def test_acquire_takes_what_is_free_and_from_nobody() -> None:
    service = Service()
    service.ask("one", op="acquire")
    assert service.desk.authority.holder == "one"
    service.ask("one", op="acquire")
    code, said = service.refusal("another", op="acquire")
    assert code == "lease_held"
    assert "`release --force`" in said
    assert service.desk.authority.holder == "one"


@pytest.mark.parametrize("op", ["preempt", "take"])
@pytest.mark.parametrize("state", list(State))
def test_the_lease_may_be_taken_while_every_axis_is_at_rest(state: State, op: str) -> None:
    service = Service()
    service.ask("one", op="arm")
    service.axes["y"].state = state
    at_rest = {State.DISARMED, State.ARMING, State.HOLDING, State.TRIPPED}
    if state in at_rest:
        service.ask("another", op=op)
        assert service.desk.authority.holder == "another"
    else:
        assert service.refusal("another", op=op)[0] == "busy"


@pytest.mark.parametrize("policy", ["continue", "stop", "disarm"])
@pytest.mark.parametrize("state", list(State))
def test_when_the_client_that_commands_has_gone(policy: str, state: State) -> None:
    service = Service()
    service.settings.holder_lost = policy
    service.ask("one", op="arm", axis="x")
    axis = service.axes["y"]
    axis.state = state
    service.desk.leave("another")
    assert axis.told == []
    with structlog.testing.capture_logs() as logs:
        service.desk.leave("one")
    if state is State.JOGGING:
        assert axis.told == [("stop", "one has gone, who held the jog")]
    elif state in COMMANDED and policy != "continue":
        reason = f"one has gone, who commanded the move (service.holder_lost is {policy})"
        assert axis.told == [(policy, reason)]
        event = "the lease's holder has gone"
        assert logs == [{"event": event, "log_level": "warning", "axis": "y", "client": "one", "policy": policy}]
    else:
        assert axis.told == []
    assert service.desk.authority.holder is None


# The end, and defects ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("op", ["arm", "stop", "disarm", "reset", "acquire", "preempt", "release"])
def test_a_service_that_ends_only_reads(op: str) -> None:
    service = Service()
    service.is_ending = True
    code, text = service.refusal(op=op)
    assert (code, text) == ("ending", "the service is ending: nothing but reading is possible any more.")
    assert service.ask(op="status") == {"of": None}
    assert service.told() == {}


def test_a_defect_ends_the_service_and_is_told_with_its_kind() -> None:
    service = Service()
    defect = ZeroDivisionError("by nothing")

    def broken(_: float) -> None:
        raise defect

    service.axes["x"].__dict__["jog"] = broken
    text = "ZeroDivisionError: by nothing; the service is stopping"
    assert service.refusal(op="jog", velocity=1.0, axis="x") == ("internal_error", text)
    with pytest.raises(Refused, match="by nothing"):
        service.desk.carry_out(read_request({"op": "jog", "velocity": 1.0, "axis": "x"}), "operator")
    assert service.failed == [defect, defect]


# Reading the configuration again -------------------------------------------------------------------------------------


def test_a_service_without_a_file_has_nothing_to_read_again() -> None:
    assert Service().refusal(op="reload")[0] == "no_configuration"


@pytest.mark.parametrize("state", [state for state in State if state is not State.DISARMED])
def test_settings_are_read_again_only_while_every_axis_is_disarmed(state: State) -> None:
    service, done = Service(), list[str]()
    service.desk.reload = lambda: done.append("reload")
    service.axes["y"].state = state
    assert service.refusal(op="reload") == (
        "armed",
        f"axis y is {state}: settings are read again only while disarmed.",
    )
    assert done == []
    service.axes["y"].state = State.DISARMED
    service.ask(op="reload")
    assert done == ["reload"]


def test_what_was_prepared_for_a_client_is_put_in_force_by_its_own_request_once() -> None:
    service, done = Service(), list[str]()
    desk = service.desk

    async def prepare() -> Any:
        return lambda: done.append("prepared")

    desk.reload = lambda: done.append("read")
    run_alone(desk.prepare_reload("one"))
    assert not desk.is_prepared("one")  # nothing prepares
    desk.prepare = prepare
    run_alone(desk.prepare_reload("one"))
    assert [desk.is_prepared("one"), desk.is_prepared("another")] == [True, False]
    service.ask("one", op="reload")
    assert done == ["prepared"]
    assert not desk.is_prepared("one")
    service.ask("one", op="reload")
    assert done == ["prepared", "read"]


def test_what_was_prepared_for_another_client_is_thrown_away() -> None:
    service, done = Service(), list[str]()

    async def prepare() -> Any:
        return lambda: done.append("prepared")

    service.desk.reload = lambda: done.append("read")
    service.desk.prepare = prepare
    run_alone(service.desk.prepare_reload("one"))
    service.ask("one", op="release")
    service.ask("another", op="reload")
    assert done == ["read"]
    assert not service.desk.is_prepared("one")


def test_an_axis_that_was_armed_meanwhile_keeps_its_settings() -> None:
    service, done = Service(), list[str]()

    async def prepare() -> Any:
        return lambda: done.append("prepared")

    service.desk.prepare = prepare
    run_alone(service.desk.prepare_reload("one"))
    service.axes["x"].state = State.HOLDING
    assert service.refusal("one", op="reload")[0] == "armed"
    assert done == []


@pytest.mark.parametrize("obstacle", ["ending", "armed", "lease_held", "busy"])
def test_nothing_is_prepared_that_would_be_refused(obstacle: str) -> None:
    service, done = Service(), list[str]()
    codes = []

    async def prepare() -> Any:
        done.append("prepare")
        if obstacle == "busy":
            with pytest.raises(Refused, match="one has asked for `reload` just now: wait for its end") as refused:
                await service.desk.prepare_reload("one")
            codes.append(refused.value.code)
        return lambda: None

    service.desk.prepare = prepare
    service.is_ending = obstacle == "ending"
    service.axes["x"].state = State.HOLDING if obstacle == "armed" else State.DISARMED
    if obstacle == "lease_held":
        service.ask("another", op="arm")
    if obstacle == "busy":
        run_alone(service.desk.prepare_reload("one"))
        assert (codes, done) == (["busy"], ["prepare"])
        run_alone(service.desk.prepare_reload("one"))  # it is over
        return
    with pytest.raises(Refused) as refused:
        run_alone(service.desk.prepare_reload("one"))
    assert (refused.value.code, done) == (obstacle, [])
