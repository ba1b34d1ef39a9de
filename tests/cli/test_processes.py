"""Service, drive and operator as processes of their own, on a bus over the loopback address.

Nothing leaves the machine.

A test waits by reading: what a process logs, what a watch shows, the end of a process. None sleeps or looks
at a clock.
"""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import cantools
import pytest

from tests.drives_of_others import install
from twostage_servo.api.requests import ArmRequest, MoveRequest, WatchRequest
from twostage_servo.canbus.socketcand import SocketcandBus
from twostage_servo.client.connection import Connection

pytestmark = pytest.mark.processes

COMMAND = (sys.executable, "-c", "from twostage_servo.cli.main import entry_point; entry_point()")
CONFIG = Path(__file__).parents[2] / "config"
# These processes run in real time on a machine that may be busy with anything: what is tested is not their punctuality.
PATIENT = {
    "stale_feedback_ms": 3000.0,
    "heartbeat_ms": 3000.0,
    "missed_ticks": 300,
    "feedback_errors": 100,
    "following_error_minimum": 500.0,
    "innovation_gate": 500.0,
    "command_timeout_ms": 1000.0,
}
JOG_TIMEOUT = "axis.jog_timeout_ms=2000"
MOST_ATTEMPTS = 20
LONGEST_S = 60  # ends a test that hangs; nothing is measured against it
FRAMES_IN_THE_LONGEST = 20_000  # of service and drive together in that time, and more


class Process:
    """A running verb, whose log is read line by line."""

    def __init__(self, *arguments: str, environment: dict[str, str], command: tuple[str, ...] = COMMAND) -> None:
        self.popen = subprocess.Popen(  # noqa: S603
            [*command, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
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
        self.state = folder / "state"
        self.environment = os.environ | {
            "TWOSTAGE_SERVO_SOCKET": str(self.socket),
            "XDG_STATE_HOME": str(self.state),
        }
        self.started: list[Process] = []
        self.others: list[subprocess.Popen[str]] = []

    def start(self, verb: str, *overrides: str, command: tuple[str, ...] = COMMAND) -> Process:
        options = [argument for override in overrides for argument in ("--set", override)]
        return self.run(verb, "--config", str(self.config), *options, command=command)

    def run(self, *arguments: str, command: tuple[str, ...] = COMMAND) -> Process:
        """Start a verb and do not wait for its end."""
        process = Process(*arguments, "--json", environment=self.environment, command=command)
        self.started.append(process)
        return process

    def drive(self) -> Process:
        drive = self.start("drive")
        drive.until_logged("on the bus")
        return drive

    def service(self, *overrides: str, command: tuple[str, ...] = COMMAND) -> Process:
        service = self.start("run", *overrides, command=command)
        service.until_logged("the bus is open")
        self.watch_until(lambda status: status["axis"]["cia402"] == "ready to switch on")
        return service

    def listener(self) -> SocketcandBus:
        return SocketcandBus("can0", host="127.0.0.1", port=self.port)

    def ask(self, *arguments: str, exit_code: int = 0) -> dict[str, Any]:
        done = self.call(*arguments)
        assert done.returncode == exit_code, done
        answer: dict[str, Any] = json.loads(done.stdout)
        return answer

    def ask_disarmed(self, *arguments: str) -> dict[str, Any]:
        """Ask as often as an operator is told to: a host that has just missed a tick does not know the speed."""
        for _ in range(MOST_ATTEMPTS):
            if "try again" not in (done := self.call(*arguments)).stdout:
                break
        assert done.returncode == 0, done
        answer: dict[str, Any] = json.loads(done.stdout)
        return answer

    def call(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(  # noqa: S603
            [*COMMAND, *arguments, "--json"],
            capture_output=True,
            text=True,
            env=self.environment,
            timeout=LONGEST_S,
            check=False,
        )

    def watch_until(self, condition: Any) -> dict[str, Any]:
        with contextlib.closing(Connection(self.socket, LONGEST_S)) as client:
            for snapshot in client.snapshots(WatchRequest(every=2)):
                status = snapshot.to_json()
                if condition(status):
                    return status
        raise AssertionError("the service went away")

    def watch_until_at_rest(self) -> None:
        slow = 0

        def seen(status: dict[str, Any]) -> bool:
            nonlocal slow
            slow = slow + 1 if abs(status["axis"]["velocity"]) < 0.5 else 0
            return slow == 20

        self.watch_until(seen)


def dbc() -> cantools.database.can.Database:
    """An independent reader of our frames."""
    database = cantools.database.load_file(CONFIG / "servo_drive.dbc")
    assert isinstance(database, cantools.database.can.Database)
    return database


def frames_of(listener: can.BusABC, name: str) -> Iterator[dict[str, Any]]:
    """Read the bus, and yield each frame of a message, for as long as a drive may take to do anything."""
    database = dbc()
    identifier = database.get_message_by_name(name).frame_id
    for _ in range(FRAMES_IN_THE_LONGEST):
        message = listener.recv(LONGEST_S)
        if message is None:
            return
        if message.arbitration_id == identifier:
            yield dict(database.decode_message(identifier, bytes(message.data), decode_choices=False))  # type: ignore[arg-type]


def feedback_with(listener: can.BusABC, signal_name: str) -> dict[str, Any]:
    """Read the bus until the drive's feedback has a signal set."""
    for feedback in frames_of(listener, "DriveFeedback"):
        if feedback[signal_name]:
            return feedback
    raise AssertionError("the drive never told, or fell silent")


def position_at_rest(listener: can.BusABC) -> float:
    """Read the bus until 30 reports of the drive in a row give the same position, in mm."""
    reports: list[float] = []
    for feedback in frames_of(listener, "DriveFeedback"):
        position = float(feedback["Position"])
        reports = [*reports, position] if position in reports else [position]
        if len(reports) == 30:
            return position
    raise AssertionError("the axis never came to rest, or its drive fell silent")


def commands_until_disabled(listener: can.BusABC) -> list[tuple[float, int]]:
    """Read the bus until three commands in a row disable the drive that was enabled; return (effort, enable) of all."""
    commands: list[tuple[float, int]] = []
    for command in frames_of(listener, "DriveCommand"):
        commands.append((command["Effort"], command["Enable"]))
        if [enable for _, enable in commands[-3:]] == [0, 0, 0] and 1 in {enable for _, enable in commands}:
            return commands
    raise AssertionError(f"the drive was never disabled: {commands[-5:]}")


def _go_on(*_: object) -> None:
    """Handle a signal, so that a child begins with what the system does by default."""


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    machine = Machine(tmp_path)
    # A shell lets its background jobs ignore SIGINT and SIGQUIT, and nohup SIGHUP; their children would inherit that.
    ours: dict[signal.Signals, Callable[..., object]] = {
        signal.SIGINT: signal.default_int_handler, signal.SIGQUIT: _go_on, signal.SIGHUP: _go_on
    }  # fmt: skip
    inherited = {number: signal.signal(number, handler) for number, handler in ours.items()}
    yield machine
    for number, handler in inherited.items():
        signal.signal(number, handler)
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
    assert max(feedback["Position"] for feedback in decoded["DriveFeedback"]) > 99.9  # it arrived
    assert {str(command["Enable"]) for command in decoded["DriveCommand"]} == {"Enable", "Disable"}
    assert decoded["DriveHeartbeat"]


@pytest.mark.long
def test_a_drive_of_another_package_across_three_processes(machine: Machine, tmp_path: Path) -> None:
    """`run`, `drive` and the operator's verbs know no type of drives."""
    packages = tmp_path / "packages"
    packages.mkdir()
    install(packages, "node = node_drive:DRIVE")
    machine.environment["PYTHONPATH"] = str(packages)
    with machine.config.open("a", encoding="utf-8") as file:
        file.write('\n[protocol]\ntype = "node"\nnode = 5\n')
    drive = machine.drive()
    service = machine.service()
    machine.ask("arm")
    assert machine.ask("move", "5", "--wait")["axis"]["state"] == "holding"
    assert service.end(signal.SIGTERM)[0] == 0
    assert drive.end(signal.SIGTERM)[0] == 0


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
    tripped = machine.watch_until(lambda status: status["trip"] and status["trip"]["file"])
    assert tripped["trip"]["code"] in {"bus_failed", "stale_feedback"}
    (file,) = (machine.state / "twostage-servo" / "trips").iterdir()
    assert tripped["trip"]["file"] == str(file)
    assert json.loads(file.read_text(encoding="utf-8"))["snapshot"]["trip"]["cause"] == tripped["trip"]["cause"]
    assert machine.ask("status", exit_code=3)["axis"]["state"] == "tripped"
    machine.drive()
    back = machine.watch_until(lambda status: status["bus"]["open"] and status["axis"]["position"] is not None)
    assert back["axis"]["state"] == "tripped"
    assert machine.ask("reset")["axis"]["state"] == "disarmed"
    assert machine.ask("arm")["axis"]["state"] == "holding"


def test_what_a_law_had_learned_is_there_after_a_start_until_somebody_lets_it_forget(machine: Machine) -> None:
    file = machine.state / "twostage-servo" / "trips" / "learned-x.json"
    learned = {
        "gain": 200.0, "pole": 13.0, "gain_share": 0.02, "pole_share": 0.05, "delay_ticks": 1, "delay_evidence": -9.0,
        "load": [0.1, None], "moves": 3, "is_sure": True,
    }  # fmt: skip
    document = {
        "format": 1, "axis": "x", "law": "adaptive", "unit": "mm", "effort_unit": "V", "tick_ms": 10.0,
        "configured_gain": 180.0, "configured_pole": 14.0, "learned": learned,
    }  # fmt: skip
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps(document), encoding="utf-8")
    machine.drive()
    service = machine.service("axis.law.type=adaptive", "axis.law.memory=file")
    load = {"forward": 0.1, "backward": None}
    identified = {"gain": 200.0, "pole": 13.0, "delay_ticks": 1, "load": load, "moves": 3}
    assert machine.ask("status")["law"] == {
        "type": "adaptive", "identified": identified, "accepted": True, "rejection": None, "file_error": None,
    }  # fmt: skip
    assert machine.ask("forget")["law"]["identified"] is None
    service.end(signal.SIGTERM)
    assert not file.exists()


@pytest.mark.long
@pytest.mark.parametrize("law", [(), ("axis.law.type=adaptive", "axis.law.memory=file")], ids=["paper", "adaptive"])
def test_nothing_is_imported_while_the_service_runs(machine: Machine, tmp_path: Path, law: tuple[str, ...]) -> None:
    """What a start leaves out must not be needed by a tick, a request or a trip: an import takes many ticks."""
    drive = machine.drive()
    service = machine.service(*law, command=(sys.executable, "-X", "importtime", *COMMAND[1:]))
    assert machine.ask_disarmed("reload")["ok"]
    machine.ask("arm")
    machine.ask("move", "5", "--wait")
    machine.ask("jog", "10", "--seconds", "0.1")
    machine.ask("home", "--here", "0")
    machine.ask("reload", exit_code=3)
    machine.ask("status", "--recording", str(tmp_path / "ticks.csv"))
    machine.ask("stop")
    drive.end(signal.SIGKILL)
    machine.watch_until(lambda status: status["trip"] is not None and status["trip"]["file"] is not None)
    machine.ask("reset", exit_code=3)
    _, _, log = service.end(signal.SIGTERM)
    while_it_ran, ending, _ = log.partition('"event": "ending"')
    assert ending
    assert '"event": "trip file"' in while_it_ran
    assert [line for line in while_it_ran.splitlines() if line.startswith("import time:")] == []


def test_a_second_service_at_the_same_socket_is_refused(machine: Machine) -> None:
    machine.drive()
    machine.service()
    second = machine.start("run")
    out, _ = second.popen.communicate(timeout=LONGEST_S)
    assert second.popen.returncode == 2
    assert "another service answers" in json.loads(out)["error"]["message"]


def test_without_a_service_every_verb_says_so(machine: Machine) -> None:
    for verb in (
        "status",
        "arm",
        "move 1",
        "jog 5",
        "home",
        "watch",
        "stop",
        "reset",
        "disarm",
        "forget",
        "release",
        "reload",
    ):
        error = machine.ask(*verb.split(), exit_code=4)["error"]
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


# Control authority, and what goes on when an operator leaves ----------------------------------------------------------


def test_one_operator_commands_and_the_others_watch_or_stop(machine: Machine) -> None:
    machine.drive()
    machine.service()
    holder = Connection(machine.socket, LONGEST_S)
    holder.ask(ArmRequest())
    machine.watch_until(lambda status: status["axis"]["state"] == "holding")
    holder.ask(MoveRequest(position=2000.0, velocity=60.0))
    machine.watch_until(lambda status: (status["axis"]["velocity"] or 0.0) > 50.0)
    refused = machine.ask("move", "0", exit_code=3)["error"]
    assert refused["code"] == "authority_held"
    assert str(os.getpid()) in refused["message"]
    assert "release --force" in refused["message"]
    assert machine.ask("release", exit_code=3)["error"]["code"] == "authority_held"
    assert machine.ask("release", "--force", exit_code=3)["error"]["code"] == "busy"
    assert str(os.getpid()) in machine.ask("status")["authority"]["holder"]
    assert machine.ask("stop")["axis"]["state"] == "holding"
    assert machine.ask("release", "--force")["authority"] == {"holder": None}
    assert machine.ask("release")["authority"] == {"holder": None}
    assert machine.ask("move", "--by", "-10", "--wait")["move"]["outcome"] == "reached"
    holder.ask(MoveRequest(position=0.0))  # each verb has released authority as it left
    holder.close()


def test_a_move_goes_on_after_its_command_has_left(machine: Machine) -> None:
    machine.drive()
    machine.service("service.holder_lost='stop'")
    machine.ask("arm")
    assert machine.ask("move", "100")["move"]["outcome"] == "moving"
    reached = machine.watch_until(lambda status: status["move"]["outcome"] != "moving")
    assert reached["move"]["outcome"] == "reached"
    assert reached["authority"] == {"holder": None}


def test_a_command_that_is_killed_in_mid_move_falls_under_the_policy(machine: Machine) -> None:
    machine.drive()
    machine.service("service.holder_lost='stop'")
    machine.ask("arm")
    moving = machine.run("move", "2000", "--wait")
    machine.watch_until(lambda status: (status["axis"]["velocity"] or 0.0) > 50.0)
    moving.end(signal.SIGKILL)
    stopped = machine.watch_until(lambda status: status["axis"]["state"] == "holding")
    assert stopped["move"]["outcome"] == "stopped"
    assert "service.holder_lost is stop" in stopped["move"]["reason"]


@pytest.mark.long
def test_a_command_that_is_interrupted_in_mid_move_leaves_the_axis_moving(machine: Machine) -> None:
    machine.drive()
    machine.service("service.holder_lost='stop'")
    machine.ask("arm")
    moving = machine.run("move", "600", "--velocity", "200", "--wait")
    machine.watch_until(lambda status: (status["axis"]["velocity"] or 0.0) > 50.0)
    exit_code, _, said = moving.end(signal.SIGINT)
    assert exit_code == 130
    assert "the axis continues to its set-point" in said
    assert machine.watch_until(lambda status: status["move"]["outcome"] != "moving")["move"]["outcome"] == "reached"


# Jog, home, quick stop, reload ----------------------------------------------------------------------------------------


def test_a_jog_ends_after_its_time(machine: Machine) -> None:
    machine.drive()
    machine.service(JOG_TIMEOUT)
    assert machine.ask("jog", "50", exit_code=3)["error"]["code"] == "disarmed"
    machine.ask("arm")
    status = machine.ask("jog", "50", "--seconds", "0.5")
    assert status["axis"]["state"] == "holding"
    assert status["axis"]["position"] > 1.0
    assert (status["move"]["kind"], status["move"]["outcome"], status["move"]["reason"]) == ("jog", "stopped", None)
    back = machine.ask("jog", "-1e2", "--seconds", "0.1")
    assert back["axis"]["position"] < status["axis"]["position"]
    assert machine.ask("jog", "9999", exit_code=2)["error"]["code"] == "velocity_limit"
    assert machine.ask("jog", "nan", exit_code=2)["error"]["code"] == "bad_request"
    assert machine.ask("jog", "5", "--seconds", "-1", exit_code=2)["error"]["code"] == "usage"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_jog_ends_with_its_command(machine: Machine, number: signal.Signals) -> None:
    machine.drive()
    machine.service(JOG_TIMEOUT)
    machine.ask("arm")
    jogging = machine.run("jog", "50")
    machine.watch_until(lambda status: (status["axis"]["position"] or 0.0) > 20.0)
    exit_code, out, _ = jogging.end(number)
    held = machine.watch_until(lambda status: status["axis"]["state"] == "holding")
    assert held["move"]["outcome"] == "stopped"
    if number is signal.SIGINT:
        assert exit_code == 0
        assert json.loads(out)["axis"]["state"] == "holding"
        assert held["move"]["reason"] is None
    else:
        assert "has disconnected while it held the jog" in held["move"]["reason"]


@pytest.mark.long
def test_a_jog_ends_at_the_limit(machine: Machine) -> None:
    machine.drive()
    machine.service(JOG_TIMEOUT, "axis.limits.position_maximum=30.0")
    machine.ask("arm")
    status = machine.ask("jog", "100")
    assert (status["axis"]["state"], status["move"]["outcome"]) == ("holding", "reached")
    assert status["axis"]["position"] == pytest.approx(30.0, abs=0.2)


def test_home_here_counts_from_where_the_axis_stands(machine: Machine) -> None:
    machine.drive()
    machine.service("axis.homing.required=true")
    assert machine.ask("status")["axis"]["referenced"] is False
    machine.ask("arm")
    assert machine.ask("move", "1", exit_code=3)["error"]["code"] == "not_homed"
    machine.ask("jog", "20", "--seconds", "0.3")
    machine.watch_until_at_rest()
    # That the jog was stopped is no failure of this.
    homed = machine.ask("home", "--here", "250.5")
    assert homed["axis"]["referenced"] is True
    assert homed["axis"]["position"] == pytest.approx(250.5, abs=0.2)
    assert machine.ask("move", "200", "--wait")["axis"]["position"] == pytest.approx(200.0, abs=0.1)
    machine.ask("disarm")
    # Without a reference of its own, homing takes the place where the axis stands for axis.homing.position.
    assert machine.ask_disarmed("home")["axis"]["position"] == pytest.approx(0.0, abs=0.1)


def test_a_drive_that_is_killed_and_started_again_is_not_taken_for_the_one_before(machine: Machine) -> None:
    drive = machine.drive()
    machine.service("axis.homing.required=true")
    machine.ask_disarmed("home", "--here", "100")
    machine.watch_until(lambda status: status["bus"]["drive_state"] is not None)
    drive.end(signal.SIGKILL)
    machine.drive()
    status = machine.watch_until(
        lambda status: not status["axis"]["referenced"] and status["axis"]["position"] is not None
    )
    assert (status["axis"]["reference"], status["trip"]) == (None, None)
    machine.watch_until(lambda status: status["axis"]["cia402"] == "ready to switch on")
    machine.ask("arm")
    refused = machine.ask("move", "100", exit_code=3)["error"]
    assert refused["code"] == "not_homed"
    assert "rebooted" in refused["message"]


@pytest.mark.long
def test_home_looks_for_the_switch(machine: Machine) -> None:
    machine.config.write_text(
        machine.config.read_text(encoding="utf-8") + "home_switch_from = -1000.0\nhome_switch_to = -10.0\n",
        encoding="utf-8",
    )
    machine.drive()
    machine.service("axis.homing.method='switch'", "axis.homing.velocity=50.0")
    assert machine.ask("home", exit_code=3)["error"]["code"] == "disarmed"
    machine.ask("arm")
    homed = machine.ask("home")
    assert (homed["move"]["kind"], homed["move"]["outcome"], homed["axis"]["state"]) == ("home", "reached", "holding")
    assert machine.ask("move", "5", "--wait")["axis"]["position"] == pytest.approx(5.0, abs=0.1)


def test_a_quick_stop_in_mid_move(machine: Machine) -> None:
    machine.drive()
    service = machine.service()
    machine.ask("arm")
    machine.ask("move", "2000")
    machine.watch_until(lambda status: (status["axis"]["velocity"] or 0.0) > 90.0)
    stopped = machine.ask("stop", "--quick")
    assert (stopped["axis"]["state"], stopped["move"]["outcome"]) == ("holding", "stopped")
    _, _, log = service.end(signal.SIGTERM)
    assert '"now": "quick_stopping"' in log


def test_the_configuration_is_read_again_while_disarmed(machine: Machine) -> None:
    machine.drive()
    machine.service()
    good = machine.config.read_text(encoding="utf-8")
    slower = good.replace("cruise_velocity = 100.0", "cruise_velocity = 33.0")
    machine.config.write_text(slower, encoding="utf-8")
    machine.ask("arm")
    assert machine.ask("reload", exit_code=3)["error"]["code"] == "armed"
    machine.ask("disarm")

    machine.config.write_text(slower.replace("pole = 14.0", "pole = -14.0", 1), encoding="utf-8")
    error = machine.ask("reload", exit_code=2)["error"]
    line = slower[: slower.index("pole = 14.0")].count("\n") + 1
    assert error["code"] == "config"
    assert f"{machine.config}:{line}: axis.plant.pole" in error["message"]
    machine.config.write_text(slower + "hub = false\n[service]\ntick_ms = 5.0\n", encoding="utf-8")
    assert "restart the service" in machine.ask("reload", exit_code=2)["error"]["message"]

    machine.config.write_text(slower, encoding="utf-8")
    assert machine.ask("reload")["axis"]["state"] == "disarmed"
    machine.watch_until(lambda status: status["axis"]["position"] is not None)
    machine.ask("arm")
    assert machine.ask("move", "5")["move"]["velocity"] == 33.0


# The service itself ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGUSR1], ids=lambda number: number.name)
def test_a_signal_that_would_end_the_process_brakes_and_disables_the_drive(
    machine: Machine, number: signal.Signals
) -> None:
    drive = machine.drive()
    service = machine.service()
    with machine.listener() as listener:
        machine.ask("arm")
        machine.ask("move", "2000")
        machine.watch_until(lambda status: (status["axis"]["velocity"] or 0.0) > 90.0)
        service.popen.send_signal(number)
        commands = commands_until_disabled(listener)
    _, err = service.popen.communicate(timeout=LONGEST_S)
    assert service.popen.returncode == 128 + number
    assert f'"signal": "{number.name}"' in err
    assert commands[-3:] == [(0.0, 0)] * 3
    assert not machine.socket.exists()
    _, out, _ = drive.end(signal.SIGHUP)
    assert json.loads(out)["counters"]["command_timeouts"] == 0


WITHOUT_A_THREAD = (
    sys.executable,
    "-c",
    """
import threading
from twostage_servo.cli.main import entry_point
def fail(_):
    raise RuntimeError("can't start new thread")
threading.Thread.start = fail
entry_point()
""",
)


def test_a_service_that_gets_no_thread_does_not_start_and_says_so(machine: Machine) -> None:
    service = machine.start("run", command=WITHOUT_A_THREAD)
    out, _ = service.popen.communicate(timeout=LONGEST_S)
    assert service.popen.returncode == 3
    assert json.loads(out)["error"]["code"] == "no_thread"
    assert not machine.socket.exists()


WITH_A_DEFECT = (
    sys.executable,
    "-c",
    """
from twostage_servo.cli.main import entry_point
from twostage_servo.telemetry.recorder import Recorder

add = Recorder.add
def broken(recorder, record):
    if record.velocity > 50.0 and record.state == "moving_speed_stage":
        raise ZeroDivisionError("a defect")
    add(recorder, record)
Recorder.add = broken
entry_point()
""",
)


def test_a_defect_stops_the_axis_and_ends_with_a_traceback(machine: Machine) -> None:
    drive = machine.drive()
    service = machine.service(command=WITH_A_DEFECT)
    with machine.listener() as listener:
        machine.ask("arm")
        machine.ask("move", "2000")
        commands = commands_until_disabled(listener)
    _, err = service.popen.communicate(timeout=LONGEST_S)
    assert service.popen.returncode == 1
    assert "ZeroDivisionError: a defect" in err
    assert '"code": "internal_error"' in err
    assert commands[-3:] == [(0.0, 0)] * 3
    (file,) = (machine.state / "twostage-servo" / "trips").iterdir()
    assert file.name.endswith("-x-internal_error.json")
    _, out, _ = drive.end(signal.SIGTERM)
    assert json.loads(out)["counters"]["command_timeouts"] == 0


def test_a_service_manager_is_told_of_start_life_and_end(machine: Machine, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.settimeout(LONGEST_S)
        manager.bind(str(tmp_path / "notify"))
        machine.environment |= {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "400000"}
        service = machine.start("run")
        assert manager.recv(2000) == b"READY=1"
        heard: list[bytes] = []
        while heard.count(b"WATCHDOG=1") < 3:
            heard.append(manager.recv(2000))
        statuses = {message for message in heard if message != b"WATCHDOG=1"}
        assert statuses
        assert all(message.startswith(b"STATUS=x disarmed, no bus: ") for message in statuses)
        service.popen.send_signal(signal.SIGTERM)
        while (message := manager.recv(2000)) != b"STOPPING=1":
            assert message == b"WATCHDOG=1" or message.startswith(b"STATUS=x ")
        service.popen.communicate(timeout=LONGEST_S)
        assert service.popen.returncode == 0
