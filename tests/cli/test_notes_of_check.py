"""What `check` tells of a configuration that is valid, and yet not as it should be."""

import json

import pytest

from twostage_servo.cli.main import main


def test_a_bound_below_what_the_bus_can_carry_in_a_tick_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--set", "bus.max_frames_per_tick=200"]) == 0
    assert "is 200, and a bus of 1 Mbit/s can carry 213 frames in a tick of 10 ms" in capsys.readouterr().out
    assert main(["check", "--json", "--set", "bus.max_frames_per_tick=213"]) == 0
    assert json.loads(capsys.readouterr().out)["notes"] == []
