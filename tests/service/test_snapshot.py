"""What `status` shows: each value under its name, and nothing where nothing is known."""

from typing import Any

import pytest

from tests.service.rig import World, simulate
from twostage_servo.api.status import GarbageStatus, RealtimeStatus, Refusal
from twostage_servo.axis.axis import Axis
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.service.snapshot import StatusReport


def test_a_drive_that_was_never_heard_has_no_position_and_no_age() -> None:
    async def script(world: World) -> dict[str, Any]:
        return world.report

    report = simulate(script)
    axis = report["axis"]
    assert (axis["name"], axis["unit"], axis["effort_unit"]) == ("x", "mm", "V")
    assert (axis["state"], axis["position"], axis["feedback_age_ms"]) == ("disarmed", None, None)
    assert [axis[name] for name in ("velocity", "disturbance", "target")] == [None] * 3
    assert axis["saturated"] is False
    assert report["move"] is None
    assert report["trip"] is None
    assert report["bus"]["open"] is False
    assert report["bus"]["error"] == "not opened yet"
    assert (report["frames"]["age_us"], report["frames"]["feedback_to_command_us"]) == (None, None)


def test_an_axis_in_mid_move_is_shown_with_its_estimates_and_its_move(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        await world.cruising(target=400.0, velocity=80.0)
        axis, estimate = world.axis, world.axis.estimate
        report = world.report
        shown = report["axis"]
        assert shown["state"] == State.SPEED_STAGE
        assert shown["velocity"] == estimate.velocity == pytest.approx(80.0, rel=0.05)
        assert shown["disturbance"] == estimate.disturbance
        assert shown["position"] == axis.drive.position == pytest.approx(world.drive.position, abs=2.0)
        assert shown["effort"] == world.axis_loop.command.effort > 0.0
        assert shown["target"] == 400.0
        assert shown["following_error"] == axis.following_error
        assert shown["feedback_age_ms"] in {0.0, 10.0}
        assert shown["referenced"] is True
        assert shown["saturated"] is False
        assert axis.move is not None
        assert report["move"] == {
            "number": 1, "start": axis.move.start, "target": 400.0, "velocity": 80.0, "outcome": axis.move.outcome,
            "kind": axis.move.kind, "reason": axis.move.reason,
        }  # fmt: skip
        assert report["drive"] == {"enabled": True, "disabling": False, "moved": None, "lasting": []}
        assert report["bus"]["open"] is True
        assert report["bus"]["error"] is None
        assert report["bus"]["channel"] == "can0"
        assert report["bus"]["controller"] == "active"
        monkeypatch.setattr(Axis, "saturated", True)
        assert world.report["axis"]["saturated"] is True

    simulate(script)


def test_a_trip_is_shown_with_its_file_and_with_what_made_it_worse() -> None:
    async def script(world: World) -> None:
        await world.cruising()
        world.axis.raise_trip(TripCode.FOLLOWING_ERROR, "first")
        await world.seconds(0.01)
        trip = world.report["trip"]
        first = world.axis.trip
        assert first is not None
        assert trip == {
            "code": "following_error", "cause": "first", "next_action": first.next_action, "tick": first.tick,
            "reaction": "quick_stop", "escalation": None, "codes": ["following_error"], "file": None,
            "file_error": None,
        }  # fmt: skip
        world.axis.raise_trip(TripCode.DRIVE_FAULT, "second")
        first.file.path, first.file.error = "/var/trips/1.json", "the disk is full"
        trip = world.report["trip"]
        assert trip["code"] == "following_error"
        assert (trip["escalation"], trip["codes"]) == ("drive_fault", ["following_error", "drive_fault"])
        assert (trip["file"], trip["file_error"]) == ("/var/trips/1.json", "the disk is full")

    simulate(script)


def test_each_counter_stands_under_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    async def script(world: World) -> None:
        await world.armed()
        counters, monitor = world.axis_loop.bus.link.counters, world.axis.drive.monitor
        of_link = ["received", "sent", "rejected", "dropped", "errors", "overflowed", "overruns"]
        of_monitor = ["late", "lost", "doubled", "reordered", "implausible"]
        for number, name in enumerate(of_link, 1001):
            setattr(counters, name, number)
        for number, name in enumerate(of_monitor, 2001):
            setattr(monitor, name, number)
        monkeypatch.setattr(Axis, "predicted_ticks", 3001)
        counters.rejected_by_reason["remote"] = 4001
        counters.errors_by_kind["bus_off"] = 5001
        frames = world.report["frames"]
        assert [frames[name] for name in of_link] == list(range(1001, 1008))
        assert [frames[name] for name in of_monitor] == list(range(2001, 2006))
        assert frames["predicted"] == 3001
        assert frames["rejected_by_reason"] == {"remote": 4001}
        assert frames["errors_by_kind"] == {"bus_off": 5001}

    simulate(script)


@pytest.mark.parametrize("name", ["safe_torque_off", "positive_limit", "negative_limit", "home_switch"])
def test_each_input_stands_under_its_name(name: str) -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        for one in ("safe_torque_off", "positive_limit", "negative_limit", "home_switch"):
            setattr(world.axis.drive, one, one == name)
        inputs = world.report["inputs"]
        assert [one for one, on in inputs.items() if on] == [name]

    simulate(script)


def test_what_all_axes_have_in_common() -> None:
    async def script(world: World) -> None:
        await world.until(lambda: world.axis.ready_to_arm)
        await world.seconds(1.0)
        report = world.loop.snapshot()
        assert report["uptime_s"] == pytest.approx(world.service.statistics.uptime_s, abs=1e-3)
        assert report["uptime_s"] > 1.0
        assert report["authority"] == {"holder": None}
        assert report["ticks"]["count"] == world.service.statistics.count
        assert report["realtime"] is None
        host = RealtimeStatus(
            busy_wait="off", margin_us=1.5, output_offset=0.5, output_offset_us=None, granted={"cpus": "0"},
            refused=[Refusal(what="memory", asked="locked", why="no right", remedy="grant it")],
            garbage=GarbageStatus(collections=3, postponed=2, longest_us=1.0),
        )  # fmt: skip
        parts = world.parts
        told = StatusReport(parts.axis_loops, parts.statistics, parts.authority, lambda: host).common()
        assert told.to_json()["realtime"] == {
            "busy_wait": "off", "margin_us": 1.5, "output_offset": 0.5, "output_offset_us": None,
            "granted": {"cpus": "0"},
            "refused": [{"what": "memory", "asked": "locked", "why": "no right", "remedy": "grant it"}],
            "garbage": {"collections": 3, "postponed": 2, "longest_us": 1.0},
        }  # fmt: skip

    simulate(script)
