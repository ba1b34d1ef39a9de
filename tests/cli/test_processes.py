"""Service, drive and operator as processes of their own, on a bus over the loopback address.

Nothing leaves the machine.

A test waits by reading: what a process logs, what a watch shows, the end of a process. None sleeps or looks
at a clock.
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import cantools
import pytest

from twostage_servo.canbus.socketcand import SocketcandBus

COMMAND = (sys.executable, "-c", "from twostage_servo.cli.main import entry_point; entry_point()")
CONFIG = Path(__file__).parents[2] / "config"
# These processes run in real time on a machine that may be busy with anything: what is tested is not their punctuality.
PATIENT = {
    "stale_feedback_ms": 3000.0,
    "missed_ticks": 300,
    "following_error_minimum": 500.0,
    "command_timeout_ms": 1000.0,
}
LONGEST_S = 60  # ends a test that hangs; nothing is measured against it


class Process:
    """A running verb, whose log is read line by line."""

    def __init__(self, *arguments: str, environment: dict[str, str]) -> None:
        self.popen = subprocess.Popen(  # noqa: S603
            [*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
        )

    def until_logged(self, text: str) -> str:
        assert self.popen.stderr is not None
        lines = []
        for line in self.popen.stderr:
            lines.append(line)
            if text in line:
                return line
        raise AssertionError(f"{text!r} was never logged:\n{''.join(lines)}")

    def end(self, number: signal.Signals) -> tuple[int, str, str]:
        self.popen.send_signal(number)
        out, err = self.popen.communicate(timeout=LONGEST_S)
        return self.popen.returncode, out, err


class Machine:
    """The processes of one test, with a bus and a control socket of their own."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        text = (CONFIG / "two_processes.toml").read_text(encoding="utf-8").replace("29536", str(self.port))
        for key, value in PATIENT.items():
            text, replaced = re.subn(rf"(?m)^{key} = [\d.]+", f"{key} = {value}", text)
            assert replaced == 1
        self.config = folder / "axis.toml"
        self.config.write_text(text, encoding="utf-8")
        self.socket = folder / "control.sock"
        self.environment = os.environ | {"TWOSTAGE_SERVO_SOCKET": str(self.socket)}
        self.started: list[Process] = []
        self.others: list[subprocess.Popen[str]] = []

    def start(self, verb: str) -> Process:
        process = Process(verb, "--config", str(self.config), "--json", environment=self.environment)
        self.started.append(process)
        return process

    def drive(self) -> Process:
        drive = self.start("drive")
        drive.until_logged("on the bus")
        return drive

    def service(self) -> Process:
        service = self.start("run")
        service.until_logged("the bus is open")
        self.watch_until(lambda status: status["axis"]["position"] is not None)
        return service

    def listener(self) -> SocketcandBus:
        return SocketcandBus("can0", host="127.0.0.1", port=self.port)

    def ask(self, *arguments: str, exit_code: int = 0) -> dict[str, Any]:
        done = subprocess.run(  # noqa: S603
            [*COMMAND, *arguments, "--json"],
            capture_output=True,
            text=True,
            env=self.environment,
            timeout=LONGEST_S,
            check=False,
        )
        assert done.returncode == exit_code, done
        answer: dict[str, Any] = json.loads(done.stdout)
        return answer

    def watch_until(self, condition: Any) -> dict[str, Any]:
        with socket.socket(socket.AF_UNIX) as client:
            client.settimeout(LONGEST_S)
            client.connect(str(self.socket))
            client.sendall(b'{"op": "watch", "every": 2}\n')
            for line in client.makefile():
                status: dict[str, Any] = json.loads(line)
                if condition(status):
                    return status
        raise AssertionError("the service went away")


def dbc() -> cantools.database.can.Database:
    """An independent reader of our frames."""
    database = cantools.database.load_file(CONFIG / "servo_drive.dbc")
    assert isinstance(database, cantools.database.can.Database)
    return database


def feedback_with(listener: can.BusABC, signal_name: str) -> dict[str, Any]:
    """Read the bus until the drive's feedback has a signal set."""
    database = dbc()
    identifier = database.get_message_by_name("DriveFeedback").frame_id
    while (message := listener.recv(LONGEST_S)) is not None:
        if message.arbitration_id == identifier:
            feedback: Any = database.decode_message(identifier, bytes(message.data), decode_choices=False)
            if feedback[signal_name]:
                return dict(feedback)
    raise AssertionError("the drive fell silent")


def position_at_rest(listener: can.BusABC) -> float:
    """Read the bus until 30 reports of the drive in a row give the same position, in mm."""
    database = dbc()
    identifier = database.get_message_by_name("DriveFeedback").frame_id
    reports: list[float] = []
    while (message := listener.recv(LONGEST_S)) is not None:
        if message.arbitration_id == identifier:
            report: Any = database.decode_message(identifier, bytes(message.data))
            position = float(report["Position"])
            reports = [*reports, position] if position in reports else [position]
            if len(reports) == 30:
                return position
    raise AssertionError("the drive fell silent")


def commands_until_disabled(listener: can.BusABC) -> list[tuple[float, int]]:
    """Read the bus until three commands in a row disable the drive that was enabled; return (effort, enable) of all."""
    database = dbc()
    identifier = database.get_message_by_name("DriveCommand").frame_id
    commands: list[tuple[float, int]] = []
    while (message := listener.recv(LONGEST_S)) is not None:
        if message.arbitration_id == identifier:
            command: Any = database.decode_message(identifier, bytes(message.data), decode_choices=False)
            commands.append((command["Effort"], command["Enable"]))
            if [enable for _, enable in commands[-3:]] == [0, 0, 0] and 1 in {enable for _, enable in commands}:
                return commands
    raise AssertionError(f"the drive was never disabled: {commands[-5:]}")


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    machine = Machine(tmp_path)
    # A shell lets its background jobs ignore SIGINT, and their children would inherit that.
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield machine
    signal.signal(signal.SIGINT, handler)
    for popen in (*(process.popen for process in machine.started), *machine.others):
        popen.kill()
        popen.communicate()


def test_a_session_across_three_processes(machine: Machine, tmp_path: Path) -> None:
    drive = machine.drive()
    service = machine.service()
    logger = subprocess.Popen(  # noqa: S603
        [
            sys.executable, "-u", "-m", "can.logger", "-i", "socketcand", "-c", "can0", "-f", str(tmp_path / "bus.log"),
            "--bus-kwargs", "host=127.0.0.1", f"port={machine.port}",
        ],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    machine.others.append(logger)
    assert logger.stdout is not None
    assert any("Connected to" in line for line in logger.stdout)

    assert machine.ask("status")["axis"]["state"] == "disarmed"
    assert machine.ask("move", "400", exit_code=3)["error"]["code"] == "disarmed"
    assert machine.ask("arm")["axis"]["state"] == "holding"
    arrived = machine.ask("move", "100", "--velocity", "200", "--wait")
    assert arrived["move"]["outcome"] == "reached"
    assert machine.ask("move", "--by", "-100", "--wait")["axis"]["position"] == pytest.approx(0.0, abs=0.1)
    assert machine.ask("stop")["axis"]["state"] == "holding"
    machine.ask("move", "500")
    machine.watch_until(lambda status: (status["axis"]["velocity"] or 0.0) > 50.0)
    assert machine.ask("stop")["move"]["outcome"] == "stopped"
    machine.ask("move", "-1e1", "--velocity", "250", "--wait")
    machine.ask("move", "99999", exit_code=2)
    machine.ask("status", "--recording", str(tmp_path / "ticks.csv"))
    assert len((tmp_path / "ticks.csv").read_text(encoding="utf-8").splitlines()) > 100
    assert machine.ask("disarm")["axis"]["state"] == "disarmed"

    logger.send_signal(signal.SIGINT)
    logger.communicate(timeout=LONGEST_S)
    exit_code, out, _ = service.end(signal.SIGTERM)
    assert exit_code == 0
    assert json.loads(out)["axis"]["state"] == "disarmed"
    exit_code, out, _ = drive.end(signal.SIGTERM)
    assert exit_code == 0
    assert json.loads(out)["counters"]["rejected"] == 0

    # An independent reader of the log, with cantools and the DBC alone.
    database = dbc()
    decoded: dict[str, list[Any]] = {}
    for message in can.LogReader(tmp_path / "bus.log"):
        name = database.get_message_by_frame_id(message.arbitration_id).name
        decoded.setdefault(name, []).append(database.decode_message(message.arbitration_id, bytes(message.data)))
    assert max(feedback["Position"] for feedback in decoded["DriveFeedback"]) > 100.0
    assert {str(command["Enable"]) for command in decoded["DriveCommand"]} == {"Enable", "Disable"}
    assert decoded["DriveHeartbeat"]


def test_a_killed_service_leaves_an_axis_that_stops_and_a_restart_that_does_not_move_it(machine: Machine) -> None:
    drive = machine.drive()
    service = machine.service()
    machine.ask("arm")
    machine.ask("move", "2000")
    moving = machine.watch_until(lambda status: (status["axis"]["velocity"] or 0.0) > 90.0)
    with machine.listener() as listener:
        service.end(signal.SIGKILL)
        assert machine.ask("status", exit_code=4)["error"]["code"] == "unreachable"
        stopped = feedback_with(listener, "CommandTimeout")
        assert stopped["Enabled"] == 0
        resting = position_at_rest(listener)

    service = machine.service()
    status = machine.ask("status")
    assert status["axis"]["state"] == "disarmed"
    assert status["axis"]["position"] == pytest.approx(resting, abs=0.01)
    # It went on for the 1 s of the command time-out and the coast of 1/14 s, and not to the set-point.
    assert moving["axis"]["position"] < resting < 1900.0
    later = machine.watch_until(lambda status: status["ticks"]["count"] > 50)
    assert later["axis"]["position"] == pytest.approx(resting, abs=0.01)
    assert machine.ask("move", "0", exit_code=3)["error"]["code"] == "disarmed"
    service.end(signal.SIGTERM)
    exit_code, out, _ = drive.end(signal.SIGTERM)
    assert exit_code == 0
    assert json.loads(out)["counters"]["command_timeouts"] == 1


def test_sigterm_in_mid_move_ramps_disables_and_exits_with_0(machine: Machine) -> None:
    drive = machine.drive()
    service = machine.service()
    with machine.listener() as listener:
        machine.ask("arm")
        machine.ask("move", "2000")
        machine.watch_until(lambda status: (status["axis"]["velocity"] or 0.0) > 90.0)
        exit_code, _, log = service.end(signal.SIGTERM)
        assert exit_code == 0
        commands = commands_until_disabled(listener)
    assert 1 in {enable for _, enable in commands}
    assert commands[-3:] == [(0.0, 0)] * 3
    assert 'disarming", "now": "disarmed"' in log
    exit_code, out, _ = drive.end(signal.SIGTERM)
    assert json.loads(out)["counters"]["command_timeouts"] == 0


def test_a_drive_that_goes_away_trips_the_axis(machine: Machine) -> None:
    drive = machine.drive()
    machine.service()
    machine.ask("arm")
    machine.ask("move", "1000")
    drive.end(signal.SIGKILL)
    tripped = machine.watch_until(lambda status: status["trip"])
    assert tripped["trip"]["code"] in {"bus_failed", "stale_feedback"}
    assert machine.ask("status", exit_code=3)["axis"]["state"] == "tripped"
    machine.drive()
    back = machine.watch_until(lambda status: status["bus"]["open"] and status["axis"]["position"] is not None)
    assert back["axis"]["state"] == "tripped"
    assert machine.ask("reset")["axis"]["state"] == "disarmed"
    assert machine.ask("arm")["axis"]["state"] == "holding"


def test_a_second_service_at_the_same_socket_is_refused(machine: Machine) -> None:
    machine.drive()
    machine.service()
    second = machine.start("run")
    out, _ = second.popen.communicate(timeout=LONGEST_S)
    assert second.popen.returncode == 2
    assert "another service answers" in json.loads(out)["error"]["message"]


def test_without_a_service_every_verb_says_so(machine: Machine) -> None:
    for arguments in (["status"], ["arm"], ["move", "1"], ["watch"], ["stop"], ["reset"], ["disarm"]):
        error = machine.ask(*arguments, exit_code=4)["error"]
        assert "is the service running?" in error["message"]


def test_watch_ends_after_its_count(machine: Machine) -> None:
    machine.drive()
    machine.service()
    watched = subprocess.run(  # noqa: S603
        [*COMMAND, "watch", "--count", "4", "--every", "3", "--json"],
        capture_output=True,
        text=True,
        env=machine.environment,
        timeout=LONGEST_S,
        check=True,
    )
    counts = [json.loads(line)["ticks"]["count"] for line in watched.stdout.splitlines()]
    assert len(counts) == 4
    assert counts == sorted(set(counts))
