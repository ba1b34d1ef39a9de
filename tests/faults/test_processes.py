"""The faults with real processes, and the parts that start, watch and end them.

Nothing is measured against a clock, but that a process which does not end within a minute hangs.
"""

import concurrent.futures
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import can
import pytest

from twostage_servo.app.assembly import design
from twostage_servo.axis.messages import Feedback
from twostage_servo.axis.state import State
from twostage_servo.canbus.link import BusSettings
from twostage_servo.config.loader import load
from twostage_servo.faults import approach, bench, power_cut
from twostage_servo.faults.cell import Cell
from twostage_servo.faults.frames import compile_profile
from twostage_servo.faults.hosted import HostedRun
from twostage_servo.faults.launch import LONGEST_S, Child
from twostage_servo.faults.listening import Listener, Operator, Order, RefusalError, Report, Snapshot
from twostage_servo.faults.phase import Phase
from twostage_servo.faults.plan import plan_target
from twostage_servo.faults.processes import HostedFault, hosted_cells, run_hosted
from twostage_servo.faults.simulated_approach import NotOperableError
from twostage_servo.faults.watchdog import Watchdog
from twostage_servo.service.notify import Notifier

pytestmark = pytest.mark.processes

PATIENT = ("axis.limits.missed_ticks=1000", "axis.limits.stale_feedback_ms=500", "simulation.command_timeout_ms=500")
"""So that a service which is not stopped goes on, however long a busy machine holds it up."""

SHARE = [(37, Phase.CRUISING), (38, Phase.CHANGEOVER), (39, Phase.ACCELERATING), (42, Phase.SETTLING), (54, Phase.IDLE)]


def processes_in(folder: Path) -> list[int]:
    """Return the processes whose command line names a folder."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal() and entry.name != str(os.getpid()):
            try:
                command = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if str(folder).encode() in command:
                found.append(int(entry.name))
    return found


@pytest.fixture(scope="module")
def temporary(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A temporary folder for this module alone."""
    before, tempfile.tempdir = tempfile.tempdir, str(tmp_path_factory.mktemp("hosted"))
    yield Path(tempfile.tempdir)
    tempfile.tempdir = before


@pytest.fixture(scope="module")
def cells(temporary: Path) -> dict[int, Cell]:
    """The share by their numbers, and under 0 one in which the service is not stopped; all run at the same time."""
    here = threading.local()
    send = Child.send_signal

    def send_but_no_stop(child: Child, number: int) -> None:
        if number != signal.SIGSTOP or not getattr(here, "never_stops", False):
            send(child, number)

    def run(number: int, phase: Phase) -> Cell:
        here.never_stops = number == 0
        return run_hosted(number or 37, phase, None, () if number else PATIENT, 7)

    tasks = [*SHARE, (0, Phase.ACCELERATING)]
    with pytest.MonkeyPatch.context() as patch, concurrent.futures.ThreadPoolExecutor(len(tasks)) as pool:
        patch.setattr(Child, "send_signal", send_but_no_stop)
        return {task[0]: cell for task, cell in zip(tasks, pool.map(lambda task: run(*task), tasks), strict=True)}


# The cells ------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(("number", "expected", "how"), [
    (37, "Z", "missed_ticks"), (38, "Z", "SIGKILL"), (39, "H", "exit 0"), (42, "Z", "SIGABRT"), (54, "T", ""),
])  # fmt: skip
def test_a_share_of_the_faults_is_met(cells: dict[int, Cell], number: int, expected: str, how: str) -> None:
    cell = cells[number]
    assert cell.met, cell
    assert (cell.observed, cell.trip) == (expected, how)
    assert (cell.travel > 0.1) == (number != 54)


@pytest.mark.long
def test_nothing_is_left_behind(cells: dict[int, Cell], temporary: Path) -> None:
    assert list(temporary.iterdir()) == []
    assert processes_in(temporary) == []


@pytest.mark.long
def test_the_verdict_can_fail(cells: dict[int, Cell]) -> None:
    """A service that is not stopped drives on to its set-point, and enables the drive ever after."""
    cell = cells[0]
    assert not cell.met
    assert (cell.expected, cell.observed) == ("Z", "T")
    assert cell.travel > cell.bound
    assert "the service commands an effort" in cell.wrong
    assert "after SIGCONT" in cell.wrong
    assert "the drive is still enabled" in cell.wrong


def test_what_a_service_does_later_is_not_read_from_what_has_waited() -> None:
    """Status lines pile up while nobody reads them, and a busy bus brings commands later than status tells of them."""
    orders = [Order(0.5, 3.0, True), Order(2.0, 3.0, True)]
    operator = SimpleNamespace(read_snapshots=lambda: True, unread=deque({"ticks": {"count": 40}} for _ in range(40)))
    operator.latest = {"ticks": {"count": 40}, "axis": {"effort": 3.0}}

    def watch(condition: Callable[[Snapshot], bool], _: str) -> None:
        assert not operator.unread
        for count in range(41, 1000):
            if condition({"ticks": {"count": count}}):
                return
            if count == 100:
                orders.append(Order(2.01, 3.0, True))
        raise AssertionError("nothing ends the wait")

    stand_in = SimpleNamespace(operator=operator, watch=watch, listener=SimpleNamespace(orders=orders))
    for heard, told in ((True, "the service commands an effort"), (False, "the service sends no commands")):
        run = HostedRun(37, Phase.CRUISING, cast("Any", None))
        run._bench = cast("bench.Bench", stand_in)
        run._watch_what_follows(1.0 if heard else 3.0, spared=1)
        assert run._seen.wrong[0].startswith(told)


def test_on_several_cores_these_tests_share_one(request: pytest.FixtureRequest) -> None:
    if request.config.getoption("loadgroup", default=False):
        assert request.node.nodeid.endswith("@processes")


def test_every_fault_has_its_phases() -> None:
    every = hosted_cells(Phase)
    assert len(every) == len(set(every)) == 25
    assert hosted_cells([Phase.HOLDING]) == [HostedFault(fault, Phase.HOLDING) for fault in (37, 38, 39, 42)]
    assert HostedFault(54, Phase.IDLE) in hosted_cells([Phase.IDLE])


def test_what_never_starts_is_an_error_and_is_cleared_away(monkeypatch: pytest.MonkeyPatch, temporary: Path) -> None:
    monkeypatch.setattr(bench, "LONGEST_S", 0.0)
    with pytest.raises(NotOperableError, match="the drive to be on the bus"):
        run_hosted(38, Phase.IDLE, None, (), 1)
    assert list(temporary.iterdir()) == []
    assert processes_in(temporary) == []


ONE_CELL = """
import signal
from twostage_servo.faults.processes import run_hosted
from twostage_servo.faults.phase import Phase
signal.signal(signal.SIGINT, signal.default_int_handler)
print("begun", flush=True)
run_hosted(37, Phase.CRUISING, None, (), 1)
"""


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """A folder whose path leaves room for that of a socket in it, of which Linux takes 107 characters."""
    with tempfile.TemporaryDirectory(prefix="ts-") as folder:
        yield Path(folder)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_processes_end_with_the_campaign(number: signal.Signals, short_folder: Path) -> None:
    campaign = subprocess.Popen(  # noqa: S603
        [sys.executable, "-c", ONE_CELL],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"TMPDIR": str(short_folder)},
    )
    try:
        assert campaign.stdout is not None
        assert campaign.stdout.readline() == b"begun\n"
        wait_until(lambda: len(processes_in(short_folder)) == 2)
    finally:
        campaign.send_signal(number)
        campaign.communicate(timeout=LONGEST_S)
    wait_until(lambda: not processes_in(short_folder))
    if number == signal.SIGINT:
        assert list(short_folder.iterdir()) == []


def wait_until(condition: Any) -> None:
    end_s = time.monotonic() + LONGEST_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


# What a process of the campaign is ------------------------------------------------------------------------------------


def run_python(text: str, *arguments: str, folder: Path | None = None) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(  # noqa: S603
        [sys.executable, "-c", text, *arguments],
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=LONGEST_S,
        check=False,
    )


def test_a_process_whose_parent_has_gone_already_ends_at_once() -> None:
    text = "import sys; from twostage_servo.faults.child import die_with; die_with(int(sys.argv[1])); print('alive')"
    mine = run_python(text, str(os.getpid()))
    assert (mine.returncode, mine.stdout) == (0, "alive\n")
    foreign = run_python(text, str(os.getppid()))
    assert (foreign.returncode, foreign.stdout) == (1, "")


def test_an_aborted_process_leaves_no_core(tmp_path: Path) -> None:
    text = "import os; from twostage_servo.faults.child import leave_no_core; leave_no_core(); os.abort()"
    done = run_python(text, folder=tmp_path)
    assert done.returncode == -signal.SIGABRT, done
    assert list(tmp_path.iterdir()) == []


def test_a_process_that_is_told_to_hang_does(tmp_path: Path) -> None:
    text = """
import os, signal, threading
from twostage_servo.faults.child import hang
signal.signal(signal.SIGUSR1, hang)
def say():
    for _ in range(3):
        print("another thread", flush=True)
    os._exit(7)
threading.Timer(0.2, say).start()
os.kill(os.getpid(), signal.SIGUSR1)
print("never", flush=True)
"""
    done = run_python(text)
    assert (done.returncode, done.stdout) == (7, "another thread\n" * 3)


def test_a_child_keeps_what_it_printed_and_can_be_ended_twice(tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack:
        child = Child(stack, tmp_path, "cut", ["power_cut", str(tmp_path / "trips"), "1", "2"])
        assert child.wait(LONGEST_S) == 0
        assert child.printed() == {"cuts": 2, "damaged": []}
        assert child.has_ended
        child.kill()
        broken = Child(stack, tmp_path, "broken", ["child", "no such verb"])
        assert broken.wait(LONGEST_S) == 2
        assert broken.printed() == {}
        assert "invalid choice" in broken.log()
        endless = Child(stack, tmp_path, "endless", ["power_cut", str(tmp_path / "trips"), "1", "1000000"])
        wait_until((tmp_path / "trips").exists)
    assert endless.returncode == -signal.SIGKILL
    wait_until(lambda: not processes_in(tmp_path))  # nor does the one live on that it has started


def test_a_child_whose_start_is_interrupted_is_ended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The process is there already when the interruption comes, but nobody has been told of it."""
    create = vars(subprocess)["_fork_exec"]

    def interrupted(*arguments: Any) -> Any:
        process = create(*arguments)
        signal.raise_signal(signal.SIGINT)
        return process

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        monkeypatch.setattr(subprocess, "_fork_exec", interrupted)
        with pytest.raises(KeyboardInterrupt), contextlib.ExitStack() as stack:
            Child(stack, tmp_path, "cut", ["power_cut", str(tmp_path / "trips"), "1", "1000000"])
        wait_until(lambda: not processes_in(tmp_path))
    finally:
        signal.signal(signal.SIGINT, before)


# The power cut --------------------------------------------------------------------------------------------------------


def test_damage_is_found(tmp_path: Path) -> None:
    assert power_cut.damaged(tmp_path) == ["there is no file at all"]
    document, records = power_cut.content(3)
    document["snapshot"]["trip"]["file"] = str(tmp_path / "a.json")
    whole = json.dumps(document | {"records": records})
    (tmp_path / "a.json").write_text(whole)
    (tmp_path / "b.part").write_text(whole[:100])
    assert power_cut.damaged(tmp_path) == []
    (tmp_path / "b.json").write_text(whole[:100])
    (tmp_path / "c.json").write_text(json.dumps(document | {"records": records[:-1]}))
    (tmp_path / "d.json").write_text("")
    (tmp_path / "e.json").write_text('{"number": "x"}')
    assert [problem.split()[0] for problem in power_cut.damaged(tmp_path)] == ["b.json", "c.json", "d.json", "e.json"]


def test_a_writer_that_is_not_careful_is_found_out(tmp_path: Path) -> None:
    text = """
import json, os, sys, time
from twostage_servo.faults import power_cut
def write_file(folder, name, document, records):
    folder.mkdir(exist_ok=True)
    path = folder / f"{document['number'] % 5}.json"
    whole = json.dumps(document | {"records": records})
    with path.open("w") as file:
        file.write(whole[:5000])
        file.flush()
        time.sleep(0.002)
        file.write(whole[5000:])
power_cut.write_file = write_file
power_cut.main([str(os.getppid()), *sys.argv[1:]])
"""
    done = run_python(text, str(tmp_path / "trips"), "1", "20")
    assert done.returncode == 0, done
    assert json.loads(done.stdout)["damaged"]


# The service manager --------------------------------------------------------------------------------------------------


def test_the_watchdog_hears_a_service_until_it_falls_silent(tmp_path: Path) -> None:
    with Watchdog(tmp_path / "notify", 0.05) as watchdog:
        notifier = Notifier(watchdog.environment)
        assert notifier.watchdog_s == 0.05
        assert watchdog.heard() == set()
        notifier.ready()
        assert watchdog.heard() == {"READY=1"}
        now_s = 0.0

        def live() -> None:
            nonlocal now_s
            now_s += 1.0
            notifier.tick_completed(now_s)

        live()
        assert not watchdog.wait_for_silence(0.3, live)
        assert watchdog.wait_for_silence(LONGEST_S)
        assert watchdog.heard() == {"READY=1", "WATCHDOG=1"}
        notifier.close()
    assert list(tmp_path.iterdir()) == []


# The listener and the operator ----------------------------------------------------------------------------------------


@pytest.fixture
def listener() -> Iterator[Listener]:
    bus = BusSettings(interface="virtual", channel="hosted")
    listener = Listener(bus, compile_profile(load(None)))
    yield listener
    listener.close()


def test_the_listener_measures_from_where_the_axis_was_at_the_fault(listener: Listener) -> None:
    listener.reports += [Report(0.1 * n, min(n, 10) * 2.0, enabled=True) for n in range(21)]
    assert listener.place(0.25) == pytest.approx(5.0)
    assert listener.place(-1.0) == 0.0
    assert listener.place(9.0) == 20.0
    assert listener.travel(0.25) == pytest.approx(15.0)
    assert listener.rests(1.0, 0.5, 0.01)
    assert not listener.rests(1.8, 0.5, 0.01)  # too early to say
    assert not listener.rests(0.0, 1.5, 0.01)
    assert listener.rests(0.0, 1.5, 12.0)
    assert not listener.rests(1.0, 0.25, 0.01)  # three reports are not enough
    assert listener.longest_gap_s(0.0, 2.0) == pytest.approx(0.1)
    listener.orders += [Order(0.0, 1.0, enable=True), Order(0.5, 1.0, enable=True)]
    assert listener.longest_gap_s(0.0, 2.0, of_orders=True) == 0.5
    assert listener.longest_gap_s(0.4, 2.0, of_orders=True) == 0.0


def test_the_listener_unwraps_positions_and_ignores_what_it_cannot_read(listener: Listener) -> None:
    profile = compile_profile(load(None))
    period = profile.traits.position_period
    assert period > 0.0
    end = 0.5 * period - profile.traits.position_quantum
    with can.Bus(interface="virtual", channel="hosted") as drive:
        for counter, position in enumerate((end - 1.0, end, end + 1.0 - period, end)):
            data = profile.encode_feedback(Feedback(position, counter, True, False, 0))
            drive.send(can.Message(arbitration_id=profile.feedback_id.identifier, is_extended_id=False, data=data))
        drive.send(can.Message(arbitration_id=profile.feedback_id.identifier, is_extended_id=False, data=b"1"))
        data = profile.encode_command(1.5, enable=True, counter=1)
        drive.send(can.Message(arbitration_id=profile.command_id.identifier, is_extended_id=False, data=data))
    listener.read_frames()
    assert [report.position for report in listener.reports] == pytest.approx([end - 1.0, end, end + 1.0, end])
    assert [(order.effort, order.enable) for order in listener.orders] == [(1.5, True)]


def test_the_operator_keeps_snapshots_that_come_with_an_answer(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    snapshot = b'{"event": "snapshot", "n": %d}\n'
    with socket.socket(socket.AF_UNIX) as server, concurrent.futures.ThreadPoolExecutor(1) as pool:
        server.bind(str(path))
        server.listen()

        def serve() -> list[str]:
            peer, _ = server.accept()
            with peer, peer.makefile("rb") as requests:
                asked = []
                for answer in (
                    b'{"ok": true}\n' + snapshot % 1,
                    snapshot % 2 + b'{"ok": true, "done": 1}\n' + snapshot % 3,
                    b'{"ok": false, "error": {"code": "busy", "message": "later"}}\n' + snapshot % 4,
                    b'{"ok": true}\n',
                ):
                    asked.append(json.loads(requests.readline())["op"])
                    peer.sendall(answer)
                return asked

        asked = pool.submit(serve)
        operator = Operator(path)
        assert operator.ask(op="arm")["done"] == 1
        with pytest.raises(RefusalError, match="busy: later"):
            operator.ask(op="move", position=1.0)
        operator.close()
        assert asked.result(LONGEST_S) == ["watch", "arm", "move", "release"]
    assert [one["n"] for one in operator.unread] == [1, 2, 3, 4]
    assert operator.latest["n"] == 4


# Bench, plan and phases -----------------------------------------------------------------------------------------------


def test_a_bench_widens_what_a_late_host_would_break_and_nothing_else(tmp_path: Path) -> None:
    own = ["bus.interface=pcan", "bus.channel=PCAN_USBBUS1", "bus.bitrate=500000", "axis.limits.missed_ticks=50"]
    before = load(None, own).config
    after = load(None, [*own, *bench.bench_overrides(before, 4711, tmp_path)]).config
    assert after.bus.options == {"host": "127.0.0.1", "port": 4711}
    assert after.bus.bitrate is None
    limits = after.axis.limits
    assert (limits.stale_feedback_ms, limits.missed_ticks, limits.heartbeat_ms) == (150.0, 50, 1000.0)
    assert after.simulation.command_timeout_ms == 250.0
    assert Path(after.service.socket).parent == Path(after.service.trip_folder).parent == tmp_path
    same = {"velocity", "acceleration", "quick_stop_deceleration", "effort", "position_maximum"}
    assert limits.model_dump(include=same) == before.axis.limits.model_dump(include=same)
    assert after.axis.plant == before.axis.plant
    patient = load(None, ["axis.limits.stale_feedback_ms=900", "simulation.command_timeout_ms=2000"]).config
    widest = load(None, ["axis.limits.stale_feedback_ms=900", *bench.bench_overrides(patient, 1, tmp_path)]).config
    assert widest.axis.limits.stale_feedback_ms == 900.0
    assert widest.simulation.command_timeout_ms == 2000.0


def test_the_move_goes_to_where_there_is_room() -> None:
    axis = design(load(None))
    far, near = plan_target(axis, 0.0, 100.0, 1.0), plan_target(axis, 0.0, 100.0, 0.0)
    assert near == pytest.approx(0.9 * far)
    assert 150.0 < far < 300.0
    assert plan_target(axis, 100.0, 100.0, 0.5) < 100.0
    assert plan_target(axis, -2499.0, 250.0, 1.0, cruise_s=1000.0) == pytest.approx(-2499.0 + 0.9 * 4999.0)


def test_a_phase_begins_and_passes() -> None:
    loaded = load(None)
    stand_in = cast("bench.Bench", SimpleNamespace(loaded=loaded))

    def seen(state: State, velocity: float, to_go: float) -> dict[str, Any]:
        return {"axis": {"state": state.value, "velocity": velocity, "position": 200.0 - to_go, "target": 200.0}}

    start, half = seen(State.SPEED_STAGE, 20.0, 190.0), seen(State.SPEED_STAGE, -60.0, 180.0)
    cruise, late = seen(State.SPEED_STAGE, 100.0, 150.0), seen(State.SPEED_STAGE, 100.0, 60.0)
    change, settle = seen(State.POSITION_STAGE, 99.0, 50.0), seen(State.POSITION_STAGE, 20.0, 4.0)
    hold = seen(State.HOLDING, 0.0, 0.0)
    order = [start, half, cruise, late, change, settle, hold]
    papers = design(load(None, ["axis.law.type=paper"]))  # whose position stage begins 54.53 mm before the set-point
    for phase, begun, passed in (
        (Phase.ACCELERATING, [half, cruise, late], [cruise, late, change, settle, hold]),
        (Phase.CRUISING, [late], [change, settle, hold]),
        (Phase.CHANGEOVER, [change, settle], [start, half, cruise, late, settle, hold]),
        (Phase.SETTLING, [settle], [start, half, cruise, late, hold]),
        (Phase.HOLDING, [hold], [start, half, cruise, late, change, settle]),
    ):
        one = approach.Approach(stand_in, papers, phase, cast("Any", None))
        assert [now for now in order if one.has_begun(now)] == begun, phase
        assert [now for now in order if one.has_passed(now)] == passed, phase
    blind = seen(State.SPEED_STAGE, 100.0, 0.0)
    blind["axis"]["position"] = None
    assert approach.distance(blind) == float("inf")


def test_a_cell_that_is_missed_on_a_late_machine_is_run_again(monkeypatch: pytest.MonkeyPatch) -> None:
    good = Cell(38, "x", "cruising", "Z", "Z", "SIGKILL", 1.0, 2.0)
    bad = Cell(38, "x", "cruising", "Z", "Z", "SIGKILL", 3.0, 2.0)
    no_port = (bench.BenchError("no port"), True)
    for results, verdict in (
        ([(bad, True), no_port, (good, True)], good),
        ([(bad, False), (good, False)], bad),
        ([(bad, True)] * 6 + [(good, True)], bad),
        ([no_port] * 4 + [(good, False)], None),
    ):
        left = iter(results)

        def play(*_: object, left: Any = left) -> tuple[Cell, bool]:
            result, held_up = next(left)
            if isinstance(result, Exception):
                raise result
            return result, held_up

        monkeypatch.setattr(HostedRun, "play", play)
        if verdict is not None:
            assert run_hosted(38, Phase.CRUISING, None, (), 1) is verdict
            continue
        with pytest.raises(NotOperableError, match="fault 38, cruising: no port"):
            run_hosted(38, Phase.CRUISING, None, (), 1)
