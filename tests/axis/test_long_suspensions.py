"""A tick after a suspension of any length does a bounded amount of work."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.service.rig import World, simulate
from twostage_servo.axis.trips import TripCode
from twostage_servo.control.observer import NO_CORRECTION, DisturbanceObserver
from twostage_servo.control.plant import Plant

MISSED = 10**9


def predictions_after(missed: int, monkeypatch: pytest.MonkeyPatch) -> tuple[int, TripCode | None]:
    counted = 0
    update = DisturbanceObserver.update

    def counting(self: DisturbanceObserver, sample: float, effort: float) -> None:
        nonlocal counted
        counted += 1
        update(self, sample, effort)

    async def script(world: World) -> tuple[int, TripCode | None]:
        await world.cruising()
        axis, tick = world.axis, world.service.statistics.count + missed
        with monkeypatch.context() as patch:
            patch.setattr(DisturbanceObserver, "update", counting)
            axis.begin_tick(tick, missed)
            assert axis.drive.position is not None
            axis.drive.fresh, axis.drive.age_s = True, 0.01 * (missed + 1)  # an answer to the last command
            axis.step()
        return counted, None if axis.trip is None else axis.trip.code

    return simulate(script, "axis.law.type=paper")  # which has no observer but the axis' own


def test_a_tick_after_a_billion_missed_ones_does_as_much_as_after_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    second, _ = predictions_after(100, monkeypatch)
    longest, trip = predictions_after(MISSED, monkeypatch)
    few, _ = predictions_after(10, monkeypatch)
    none, _ = predictions_after(0, monkeypatch)
    assert none < few < second
    assert longest <= second <= 10 * (few - none)  # as many for each tick that was missed, for a second of them
    assert trip is TripCode.MISSED_TICKS


@given(
    periods=st.integers(1, 200),
    pole=st.floats(0.01, 500.0),
    period_s=st.floats(0.001, 0.1),
    before=st.floats(-100.0, 100.0),
    sample=st.floats(-100.0, 100.0),
)
def test_the_speed_between_two_samples_is_that_of_the_sum_over_their_periods(
    periods: int, pole: float, period_s: float, before: float, sample: float
) -> None:
    plant = Plant(180.0, pole).discretise(period_s)
    observer = DisturbanceObserver(plant, NO_CORRECTION)
    observer.start_moving(before, sample, periods)
    way = plant.a12 * sum(plant.a22**period for period in range(periods))
    velocity = plant.a22**periods * (sample - before) / way
    assert observer.velocity == pytest.approx(plant.a22 * velocity, rel=1e-8, abs=1e-9)
    assert observer.position == pytest.approx(sample + plant.a12 * velocity, rel=1e-8, abs=1e-9)


def test_the_speed_between_two_samples_a_billion_periods_apart_is_none() -> None:
    observer = DisturbanceObserver(Plant(180.0, 14.0).discretise(0.01), NO_CORRECTION)
    observer.start_moving(0.0, 5.0, MISSED)
    assert (observer.position, observer.velocity) == (5.0, 0.0)
