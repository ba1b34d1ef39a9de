"""`latency` and `doctor`, in simulated time and on made-up hosts."""

import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.host.machine import FakeKernel, fake_host
from tests.host.test_can_interface import UP, healthy
from twostage_servo.app.assembly import build_drive, cyclic_frames
from twostage_servo.cli.host import examine
from twostage_servo.cli.main import main
from twostage_servo.config.loader import load
from twostage_servo.config.machine import load_machine
from twostage_servo.host.findings import Status
from twostage_servo.timing.virtual_clock import VirtualClockLoop

SOCKETCAN = Path(__file__).parents[2] / "config" / "socketcan.toml"


class LateLoop(VirtualClockLoop):
    """Wakes up 3 ms late."""

    def _jump_to_next_timer(self) -> None:
        super()._jump_to_next_timer()
        self._now_s += 3e-3


@pytest.fixture(autouse=True)
def simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twostage_servo.timing.ticks.real_time_loop", VirtualClockLoop)
    monkeypatch.setattr("twostage_servo.host.realtime.Kernel", FakeKernel)


def test_latency_tells_its_verdict_and_its_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["latency", "--seconds", "3"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("good: no tick missed; 99 % came within 0 µs")
    for words in ("300 ticks of 10 ms in 3 s", "busy-wait       auto", "% of a core", "wake-up latency p50", "1 µs ██"):
        assert words in text


def test_latency_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(["latency", "--seconds", "1", "--json", "--set", "realtime.busy_wait=off", "--set", "service.tick_ms=5"])
        == 0
    )
    result = json.loads(capsys.readouterr().out)
    assert result["verdict"] == "good"
    assert (result["ticks"], result["period_ms"], result["missed"], result["margin_us"]) == (200, 5.0, 0, 0.0)
    assert result["histogram"] == [{"up_to_us": 1.0, "ticks": 200}]
    assert [grant["name"] for grant in result["realtime"]] == ["timer slack", "time slice", "thread switching"]
    assert result["obstacles"] == []


def test_a_host_that_is_late_is_poor_and_says_what_to_do(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twostage_servo.timing.ticks.real_time_loop", LateLoop)
    monkeypatch.setattr("twostage_servo.host.realtime.Kernel", lambda: FakeKernel(refused=["fifo"]))
    assert main(["latency", "--seconds", "1", "--set", "realtime.priority=50"]) == 3
    captured = capsys.readouterr()
    assert captured.out.startswith("poor: no tick missed; 99 % came within ")
    assert "LimitRTPRIO=50" in captured.out
    assert captured.err == "scheduling: the loop is not scheduled as SCHED_FIFO 50: Operation not permitted\n"
    assert main(["latency", "--seconds", "1", "--json"]) == 3
    assert {"scheduling"} <= {one["name"] for one in json.loads(capsys.readouterr().out)["obstacles"]}


def test_latency_under_load_ends_its_processes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["latency", "--seconds", "0.5", "--load", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["busy_processes"] >= 1


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "inf", "1e9"])
def test_a_duration_that_makes_no_sense_is_bad_usage(seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["latency", "--seconds", seconds]) == 2
    assert "--seconds" in capsys.readouterr().err


def test_a_configuration_that_is_wrong_is_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in ("latency", "doctor"):
        assert main([verb, "--set", "realtime.busy_wait=fast"]) == 2
        assert "realtime.busy_wait" in capsys.readouterr().err


def test_doctor_in_text_and_in_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = ["doctor", "--set", f"service.socket={tmp_path}/s", "--set", f"service.trip_folder={tmp_path}/trips"]
    exit_code = main([*arguments, "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["passed"] is (exit_code == 0) is (result["counts"]["fail"] == 0)
    assert sum(result["counts"].values()) == len(result["checks"]) > 12
    assert {"name", "status", "found", "remedy"} == set(result["checks"][0])
    assert main(arguments) == exit_code
    text = capsys.readouterr().out
    for check in result["checks"]:
        assert f"{check['status']:4}  {check['name']}: " in text
        assert not check["remedy"] or check["status"] in {"warn", "fail"}


def test_a_check_that_fails_is_exit_code_3(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    assert main(["doctor", "--set", f"service.trip_folder={file}", "--json"]) == 3
    result = json.loads(capsys.readouterr().out)
    assert {check["name"] for check in result["checks"] if check["status"] == "fail"} >= {"trip files"}


def test_a_socket_that_another_user_could_exchange_fails(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    assert main(["doctor", "--set", f"service.socket={tmp_path}/open/folder/s", "--json"]) == 3
    checks = {check["name"]: check for check in json.loads(capsys.readouterr().out)["checks"]}
    assert checks["control socket"]["status"] == "fail"
    assert "writable by everybody" in checks["control socket"]["found"]
    assert checks["service manager"]["status"] in {"ok", "skip", "warn"}


@pytest.mark.parametrize(
    ("bit_rate", "status", "words"),
    [
        (500_000, Status.OK, "4.75 %"),  # (95 + 135) / 10 ms + 75 / 100 ms, by hand
        (33_333, Status.WARN, "% of 33.333 kbit/s"),
        (20_000, Status.FAIL, "% of 20 kbit/s"),
        (None, Status.SKIP, "unknown"),
    ],
)
def test_the_load_of_the_bus(tmp_path: Path, bit_rate: int | None, status: Status, words: str) -> None:
    link = healthy()
    link["linkinfo"]["info_data"]["bittiming"] = {} if bit_rate is None else {"bitrate": bit_rate}

    def run(_: Sequence[str]) -> str:
        return json.dumps([link])

    findings = {finding.name: finding for finding in examine(load_machine(SOCKETCAN), fake_host(tmp_path, UP, run))}
    assert findings["bus interface"].status is Status.OK
    assert findings["bus load"].status is status
    assert words in findings["bus load"].found


def test_the_frames_of_the_shipped_protocol() -> None:
    frames = {frame.name: frame for frame in cyclic_frames(load(None), build_drive(load(None)), 0.01)}
    assert {name: frame.extended for name, frame in frames.items()} == dict.fromkeys(frames, False)
    assert frames.keys() == {"command", "feedback", "heartbeat"}
    assert frames["command"].period_s == frames["feedback"].period_s == 0.01
    assert frames["heartbeat"].period_s == pytest.approx(0.1)
    assert frames["feedback"].data_bytes == 8
