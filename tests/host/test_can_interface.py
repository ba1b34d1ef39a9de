"""The bus as sysfs and a made-up `ip` tell of it; the JSON is what iproute2's iplink_can.c writes."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.host.machine import fake_host
from twostage_servo.host.can_interface import CanInterface, check_can_interface
from twostage_servo.host.findings import Status, run_program

NET = "sys/class/net/can0/"
UP = {NET + "type": "280\n", NET + "flags": "0x40081\n"}


def healthy() -> dict[str, Any]:
    return {
        "ifindex": 4,
        "ifname": "can0",
        "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
        "mtu": 16,
        "operstate": "UP",
        "txqlen": 10,
        "linkinfo": {
            "info_kind": "can",
            "info_data": {
                "state": "ERROR-ACTIVE",
                "berr_counter": {"tx": 0, "rx": 0},
                "restart_ms": 0,
                "bittiming": {"bitrate": 500000, "sample_point": "0.875", "tq": 125, "sjw": 1, "brp": 1},
                "clock": 8000000,
            },
            "info_xstats": {"restarts": 0, "bus_error": 0, "bus_off": 0},
        },
    }


def check(tmp_path: Path, link: Any, files: dict[str, str] = UP) -> CanInterface:
    asked: list[Sequence[str]] = []

    def run(arguments: Sequence[str]) -> str:
        asked.append(arguments)
        return link if isinstance(link, str) else json.dumps([{}, link])

    result = check_can_interface(fake_host(tmp_path, files, run), "can0")
    assert asked in ([], [["ip", "-details", "-json", "link", "show", "can0"]])
    for finding in result.findings:
        assert (finding.remedy != "") is (finding.status in {Status.WARN, Status.FAIL}), finding
    return result


def found(result: CanInterface, name: str) -> tuple[Status, str]:
    (finding,) = [finding for finding in result.findings if finding.name == name]
    return finding.status, finding.found + finding.remedy


def test_an_interface_that_is_set_up_well(tmp_path: Path) -> None:
    result = check(tmp_path, healthy())
    assert {finding.name: finding.status for finding in result.findings} == dict.fromkeys(
        (
            "bus interface",
            "transmit queue",
            "frames",
            "bus controller",
            "bus mode",
            "bit rate",
            "sample point",
            "restart after bus-off",
        ),
        Status.OK,
    )
    assert result.bit_rate == 500_000


@pytest.mark.parametrize(
    ("files", "status", "words"),
    [
        ({"sys/class/net/lo/type": "772\n"}, Status.FAIL, "interfaces present: none"),
        ({"sys/class/net/can1/type": "280\n"}, Status.FAIL, "present: can1"),
        ({NET + "type": "1\n", NET + "flags": "0x1003\n"}, Status.FAIL, "not a CAN interface"),
        ({NET + "type": "280\n", NET + "flags": "0x40080\n"}, Status.FAIL, "sudo ip link set can0 up type can bitrate"),
        ({"sys/kernel/x": ""}, Status.SKIP, "cannot be read"),
    ],
)
def test_an_interface_that_is_not_there_or_not_up(
    tmp_path: Path, files: dict[str, str], status: Status, words: str
) -> None:
    got, text = found(check(tmp_path, healthy(), files), "bus interface")
    assert got is status
    assert words in text


@pytest.mark.parametrize("channel", ["", "../lo", "a/b"])
def test_a_channel_that_is_no_name_is_not_there(tmp_path: Path, channel: str) -> None:
    result = check_can_interface(fake_host(tmp_path, UP), channel)
    assert result.findings[0].status is Status.FAIL


def test_without_ip_or_with_one_that_fails_the_rest_is_skipped(tmp_path: Path) -> None:
    result = check_can_interface(fake_host(tmp_path, UP), "can0")
    assert [finding.status for finding in result.findings] == [Status.OK, Status.SKIP]
    assert "iproute2" in result.findings[1].found

    def fails(_: Sequence[str]) -> str:
        raise OSError("Cannot open netlink socket")

    result = check_can_interface(fake_host(tmp_path, UP, fails), "can0")
    assert "Cannot open netlink socket" in result.findings[1].found


@pytest.mark.parametrize("output", ["4: can0: <NOARP,UP>", "{}", "[]", "[[]]", "[null]", '[{"ifname": ""}]'])
def test_an_output_that_is_not_understood_is_skipped(tmp_path: Path, output: str) -> None:
    assert found(check(tmp_path, output), "bus controller")[0] is Status.SKIP


@pytest.mark.parametrize(
    ("mtu", "fd", "status", "words"),
    [
        (16, False, Status.OK, "carries classic frames; the service sends classic ones"),
        (72, False, Status.OK, "carries classic and CAN FD frames; the service sends classic ones"),
        (72, True, Status.OK, "the service sends CAN FD ones"),
        (16, True, Status.FAIL, "bus.fd is true, but can0 carries classic frames only (mtu 16)"),
        (None, True, Status.SKIP, "does not report"),
    ],
)
def test_an_interface_has_to_carry_the_frames_that_are_sent(
    tmp_path: Path, mtu: int | None, fd: bool, status: Status, words: str
) -> None:
    output = json.dumps([{**healthy(), "mtu": mtu}])
    result = check_can_interface(fake_host(tmp_path, UP, lambda _: output), "can0", fd=fd)
    got, text = found(result, "frames")
    assert got is status
    assert words in text


def test_a_virtual_interface_has_no_controller(tmp_path: Path) -> None:
    link = {**healthy(), "linkinfo": {"info_kind": "vcan"}}
    result = check(tmp_path, link)
    assert found(result, "bus controller") == (Status.SKIP, "can0 is of kind vcan: it has no controller")
    assert result.bit_rate is None


@pytest.mark.parametrize(
    ("state", "status", "words"),
    [
        ("ERROR-WARNING", Status.WARN, "terminations"),
        ("ERROR-PASSIVE", Status.WARN, "error counters 128 tx, 0 rx, 3 times bus-off"),
        ("BUS-OFF", Status.FAIL, "type can restart"),
        ("STOPPED", Status.FAIL, "link set can0 up"),
        (None, Status.SKIP, "unknown"),
    ],
)
def test_states_of_the_controller(tmp_path: Path, state: str | None, status: Status, words: str) -> None:
    link = healthy()
    data = link["linkinfo"]["info_data"]
    data.pop("state") if state is None else data.update(state=state, berr_counter={"tx": 128, "rx": 0})
    link["linkinfo"]["info_xstats"]["bus_off"] = 3
    got, text = found(check(tmp_path, link), "bus controller")
    assert got is status
    assert words in text


@pytest.mark.parametrize(
    ("modes", "status", "words"),
    [
        (["FD"], Status.OK, "FD"),
        (["LISTEN-ONLY"], Status.FAIL, "listen-only off"),
        (["LOOPBACK", "FD"], Status.FAIL, "loopback off"),
        (["ONE-SHOT"], Status.WARN, "one-shot off"),
        (["PRESUME-ACK"], Status.WARN, "presume-ack off"),
        (["BERR-REPORTING"], Status.OK, "BERR-REPORTING"),
    ],
)
def test_modes_of_the_controller(tmp_path: Path, modes: list[str], status: Status, words: str) -> None:
    link = healthy()
    link["linkinfo"]["info_data"]["ctrlmode"] = modes
    got, text = found(check(tmp_path, link), "bus mode")
    assert got is status
    assert words in text


@pytest.mark.parametrize(
    ("timing", "rate", "point"),
    [
        ({"bitrate": 250000, "sample_point": "0.800"}, Status.OK, Status.OK),
        ({"bitrate": 250000, "sample_point": 0.875}, Status.OK, Status.OK),
        ({"bitrate": 250000, "sample_point": "0.500"}, Status.OK, Status.WARN),
        ({"bitrate": 250000, "sample_point": "?"}, Status.OK, Status.SKIP),
        ({"bitrate": 250000}, Status.OK, Status.SKIP),
        ({}, Status.SKIP, None),
    ],
)
def test_bit_timing(tmp_path: Path, timing: dict[str, Any], rate: Status, point: Status | None) -> None:
    link = healthy()
    link["linkinfo"]["info_data"]["bittiming"] = timing
    result = check(tmp_path, link)
    assert found(result, "bit rate")[0] is rate
    assert result.bit_rate == (250_000 if timing else None)
    assert [finding.status for finding in result.findings if finding.name == "sample point"] == [
        status for status in (point,) if status
    ]


def test_a_controller_with_fixed_bit_rates(tmp_path: Path) -> None:
    link = healthy()
    data = link["linkinfo"]["info_data"]
    del data["bittiming"]
    data["bittiming_bitrate"] = 1_000_000
    assert check(tmp_path, link).bit_rate == 1_000_000


@pytest.mark.parametrize(("delay", "status"), [(0, Status.OK), (None, Status.OK), (100, Status.WARN)])
def test_restart_after_bus_off(tmp_path: Path, delay: int | None, status: Status) -> None:
    link = healthy()
    link["linkinfo"]["info_data"]["restart_ms"] = delay
    assert found(check(tmp_path, link), "restart after bus-off")[0] is status


@pytest.mark.parametrize(("length", "status"), [(10, Status.OK), (1000, Status.WARN), (None, Status.SKIP)])
def test_transmit_queue(tmp_path: Path, length: int | None, status: Status) -> None:
    assert found(check(tmp_path, {**healthy(), "txqlen": length}), "transmit queue")[0] is status


def test_programs_are_run_and_their_failures_are_told() -> None:
    assert run_program(["true"]) == ""
    with pytest.raises(FileNotFoundError):
        run_program(["no-such-program-anywhere"])
    with pytest.raises(OSError, match="ended with exit code 1"):
        run_program(["false"])
