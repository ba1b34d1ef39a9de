import pytest

from twostage_servo.canbus.bus_load import CyclicFrame, bus_load, frame_bits


@pytest.mark.parametrize(
    ("data_bytes", "extended", "by_hand"),
    [
        (0, False, 34 + 13 + 8),  # 33 bits behind the first: 8 times four
        (1, False, 42 + 13 + 10),
        (8, False, 98 + 13 + 24),  # 135, as in the literature
        (0, True, 54 + 13 + 13),
        (8, True, 118 + 13 + 29),  # 160
    ],
)
def test_the_longest_frame_by_hand(data_bytes: int, extended: bool, by_hand: int) -> None:
    assert frame_bits(data_bytes, extended=extended) == by_hand


def stuffed(bits: list[int]) -> list[int]:
    """Bit stuffing of ISO 11898-1: behind five equal bits, stuff bits included, goes one of the other value."""
    sent: list[int] = []
    for bit in bits:
        sent.append(bit)
        if len(sent) >= 5 and len(set(sent[-5:])) == 1:
            sent.append(1 - bit)
    return sent


@pytest.mark.parametrize("data_bytes", range(9))
@pytest.mark.parametrize(("extended", "overhead"), [(False, 34), (True, 54)])
def test_the_worst_pattern_needs_as_many_stuff_bits_as_the_formula_says(
    data_bytes: int, extended: bool, overhead: int
) -> None:
    count = overhead + 8 * data_bytes
    worst = [0] * 5 + [1 - (n // 4) % 2 for n in range(count - 5)]  # each stuff bit begins the next five
    assert len(stuffed(worst)) + 13 == frame_bits(data_bytes, extended=extended)


@pytest.mark.parametrize("data_bytes", [-1, 9])
def test_a_length_that_no_classic_frame_has_is_refused(data_bytes: int) -> None:
    with pytest.raises(ValueError, match="0 to 8"):
        frame_bits(data_bytes, extended=False)


def test_the_load_of_a_servo_by_hand() -> None:
    frames = [
        CyclicFrame("command", 8, False, 0.01),
        CyclicFrame("feedback", 8, False, 0.01),
        CyclicFrame("heartbeat", 0, False, 0.1),
    ]
    # (135 + 135) / 10 ms + 55 / 100 ms = 27 550 bit/s
    assert bus_load(frames, 500_000) == pytest.approx(0.0551)
    assert bus_load(frames, 20_000) == pytest.approx(1.3775)
    assert bus_load([], 500_000) == 0.0
