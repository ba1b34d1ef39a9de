"""What a law has learned, as clients see it, and who may erase it; over frames."""

from pathlib import Path

import pytest

from tests.demo_file import DEMO, LAW_OF_THE_DEMO
from tests.service.rig import World, simulate
from tests.service.test_several_axes import Plant, axis_page, machine_file, operate
from twostage_servo.api.requests import ForgetRequest
from twostage_servo.api.status import AxisReport, Status
from twostage_servo.axis.refusals import Refused
from twostage_servo.axis.state import State
from twostage_servo.axis.trips import TripCode
from twostage_servo.cli.axis_text import describe

ADAPTIVE = ("axis.law.type=adaptive", "simulation.gain=225")

NOTHING = {"type": "adaptive", "identified": None, "accepted": None, "rejection": None, "file_error": None}


async def moved(world: World, *targets: float) -> None:
    for target in targets:
        world.axis.move_to(target, 100.0)
        await world.until(lambda: world.state() is State.HOLDING)


def test_the_status_tells_what_has_been_learned_and_forget_erases_it() -> None:
    async def script(world: World) -> None:
        await world.armed()
        assert world.report["law"] == NOTHING
        await moved(world, 100.0, 0.0)
        status = Status.from_json(world.loop.snapshot())
        law = status.only.law
        assert (law.type, law.accepted) == ("adaptive", True)
        assert law.identified is not None
        assert law.identified.gain == pytest.approx(225.0, rel=0.02)
        assert law.identified.pole == pytest.approx(14.0, rel=0.02)
        assert (law.identified.delay_ticks, law.identified.moves) == (0, 2)
        assert law.identified.load.forward == pytest.approx(0.0, abs=0.05)
        assert AxisReport.from_json(world.report) == status.only
        (line,) = [line for line in describe(status).splitlines() if line.startswith("law")]
        assert "adaptive; from 2 moves: gain 22" in line
        assert "mm/s²/V, pole 1" in line
        answer = world.requests.handle(ForgetRequest())
        assert answer["law"] == NOTHING
        assert "law              adaptive\n" in describe(Status.from_json(answer))

    simulate(script, *ADAPTIVE)


def test_only_who_commands_may_erase_it() -> None:
    async def script(world: World) -> None:
        await world.armed()
        await moved(world, 100.0)
        world.requests.authority.acquire("somebody")
        with pytest.raises(Refused) as refused:
            world.requests.handle(ForgetRequest(), "somebody else")
        assert refused.value.code == "authority_held"
        assert world.report["law"]["identified"] is not None
        assert world.requests.handle(ForgetRequest(), "somebody")["law"]["identified"] is None

    simulate(script, *ADAPTIVE)


def test_the_status_tells_of_a_plant_of_another_form(tmp_path: Path) -> None:
    """A resonance at 15 Hz: also after a trip, which erases what was learned."""
    page = DEMO.replace(LAW_OF_THE_DEMO, '[axis.law]\ntype = "adaptive"\n')
    page = page.replace("[simulation]", "[simulation]\nresonance_hz = 15.0\nresonance_damping = 0.05")

    async def script(plant: Plant) -> None:
        await plant.armed()
        plant.ask(op="move", positions={"x": 50.0}, velocity=200.0)
        await plant.until(lambda: set(plant.states()) == {State.HOLDING})
        status = Status.from_json(plant.ask(op="status"))
        law = status.only.law
        assert law.identified is None
        assert law.rejection is not None
        assert law.rejection.code in {"fit_residual", "unexplained_motion"}
        assert law.rejection.degrades
        (line,) = [line for line in describe(status).splitlines() if line.startswith("law")]
        assert f"adaptive; rejected ({law.rejection.code}): " in line
        assert "it is no plant of the configured form (a resonance, backlash, a coupling that slips)" in line
        assert line.endswith("Until a move fits, the law controls as on a plant that is not known")
        plant.axis("x").raise_trip(TripCode.STALE_FEEDBACK, "test")
        assert Status.from_json(plant.ask(op="status")).only.law.rejection == law.rejection

    operate(machine_file(tmp_path, {"x": axis_page("x", "can0", page=page)}), script)


def test_of_several_axes_those_forget_that_have_learned_all_or_none(tmp_path: Path) -> None:
    adaptive = DEMO.replace(LAW_OF_THE_DEMO, '[axis.law]\ntype = "adaptive"\n')
    paper = DEMO.replace(LAW_OF_THE_DEMO, '[axis.law]\ntype = "paper"\n')
    pages = {"x": axis_page("x", "can0", page=adaptive), "y": axis_page("y", "can1", page=adaptive)}
    pages["z"] = axis_page("z", "can2", page=paper)

    def moves(plant: Plant) -> list[int]:
        return [0 if found is None else found.moves for found in (plant.axis(name).learned for name in pages)]

    async def script(plant: Plant) -> None:
        await plant.armed()
        plant.ask(op="move", positions={"x": 50.0, "y": 50.0, "z": 50.0})
        await plant.until(lambda: set(plant.states()) == {State.HOLDING})
        assert moves(plant) == [1, 1, 0]
        plant.ask(op="forget", axis="y")
        assert moves(plant) == [1, 0, 0]
        with pytest.raises(Refused, match=r"axis z: the law .* \(axis.law.type = paper\) learns nothing"):
            plant.ask(op="forget", axis="z")
        plant.ask(op="jog", axis="y", velocity=20.0)
        with pytest.raises(Refused, match="axis y: the axis is jogging"):
            plant.ask(op="forget")
        assert moves(plant)[0] == 1
        plant.ask(op="stop", axis="y")
        await plant.until(lambda: set(plant.states()) == {State.HOLDING})
        plant.ask(op="forget")
        assert moves(plant) == [0, 0, 0]

    operate(machine_file(tmp_path, pages), script)
