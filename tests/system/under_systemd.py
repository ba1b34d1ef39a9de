"""What must hold under a real systemd: rights, permissions, restarts, the watchdog, the stop, and no file left."""

import grp
import json
import os
import signal
import stat
import sys
import time
from pathlib import Path

from tests.system.checks import Figures, check, disarmed, move
from tools.rig.bench import GROUP, OPERATOR, PROGRAM, SOCKET, UNIT, Bench, run

_PRIORITY = 40


def has_its_rights_and_no_more(bench: Bench) -> Figures:
    """Real-time priority and locked memory are granted; capabilities, root and other system calls are not."""
    pid = bench.pid
    status = dict(
        line.split(":", maxsplit=1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line
    )
    policies = {
        int(thread): os.sched_getscheduler(int(thread)) & ~os.SCHED_RESET_ON_FORK
        for thread in os.listdir(f"/proc/{pid}/task")  # noqa: PTH208 - threads may end meanwhile
    }
    locked_kib = int(status["VmLck"].split()[0])
    check(policies.pop(pid) == os.SCHED_FIFO, "the loop is scheduled first in, first out")
    check(set(policies.values()) <= {os.SCHED_OTHER}, "the other threads are not", policies=policies)
    check(os.sched_getparam(pid).sched_priority == _PRIORITY, "with the unit's priority")
    check(locked_kib > 50_000, "its memory is locked", locked_kib=locked_kib)
    check(int(status["CapEff"], 16) == int(status["CapBnd"], 16) == 0, "it has no capability", **status)
    check(status["NoNewPrivs"].strip() == "1", "and gets none", **status)
    check(status["Seccomp"].strip() == "2", "its system calls are filtered", **status)
    check("0" not in status["Uid"].split(), "it is not root", uid=status["Uid"])
    granted = bench.ask("x")["realtime"]
    check(granted["refused"] == [], "the service was refused nothing", **granted)
    return {"priority": _PRIORITY, "locked_kib": locked_kib, "uid": status["Uid"].split()[0]}


def obeys_the_group_alone(bench: Bench) -> Figures:
    """Let the operators' group in, and nobody else: the kernel refuses them."""
    there = SOCKET.stat()
    mode = stat.S_IMODE(there.st_mode)
    check(grp.getgrgid(there.st_gid).gr_name == GROUP, "the socket is the group's")
    check(mode & 0o007 == 0, "nobody else may connect", mode=oct(mode))
    refused = bench.as_stranger("status")
    said = refused.stdout + refused.stderr
    check(refused.returncode != 0 and "you may not use it" in said, "a stranger is refused, in words", said=said)
    bench.operate("disarm")
    peers = [entry["PEER"] for entry in bench.journal() if "PEER" in entry]
    check(f"uid {OPERATOR} " in peers[-1], "the journal says who has commanded", peers=peers)
    return {
        "peer": peers[-1],
        "socket_mode": oct(mode),
        "stranger_exit_code": refused.returncode,
        "stranger_is_told": said.strip()[:200],
    }


def is_restarted_after_a_kill(bench: Bench) -> Figures:
    """Kill the service in mid-move: the drive stops by itself; systemd starts the service again, disarmed."""
    bench.start_without_check()
    move(bench, "x", 0.0)
    stopped, restarts = _times_stopped(bench), bench.restarts
    bench.signal_service(signal.SIGKILL)
    stop_s = _drive_stops_by_itself(bench, stopped)
    restart_s = bench.restarted(restarts + 1)
    for axis in ("x", "y"):
        bench.until(axis, "starts disarmed", disarmed)
    check(_moves(bench) < 0.01, "nothing moves")
    return {"drive_stops_s": stop_s, "ready_again_s": restart_s}


def is_killed_by_the_watchdog(bench: Bench) -> Figures:
    """Stop the service's process in mid-move: the drive stops by itself, the manager kills and starts it again."""
    move(bench, "x", 400.0)
    stopped, restarts = _times_stopped(bench), bench.restarts
    bench.signal_service(signal.SIGSTOP)
    stop_s = _drive_stops_by_itself(bench, stopped)
    restart_s = bench.restarted(restarts + 1)
    for axis in ("x", "y"):
        bench.until(axis, "starts disarmed", disarmed)
    said = [str(entry.get("MESSAGE")) for entry in bench.journal()]
    reason = [text for text in said if "watchdog" in text.lower()]
    check(bool(reason), "the journal says why", said=said[-20:])
    return {"drive_stops_s": stop_s, "ready_again_s": restart_s, "journal": reason[:2]}


def stops_as_it_should(bench: Bench) -> Figures:
    """`systemctl stop` in mid-move: a controlled ramp, a command that disables the drive, exit code 0."""
    move(bench, "x", 0.0)
    bench.start("stop", "candump", "-L", "can0")
    deadline = time.monotonic() + 20.0
    while not bench.log("stop"):
        check(time.monotonic() < deadline, "candump sees frames")
        time.sleep(0.05)
    begun = time.monotonic()
    bench.service("stop")
    took = time.monotonic() - begun
    code, result = bench.shown("ExecMainStatus"), bench.shown("Result")
    bench.end("stop", signal.SIGINT)
    log = bench.folder / "stop.log"
    seen = json.loads(run(sys.executable, "-m", "tools.rig.decode", str(log), "can0"))["can0"]
    check((code, result) == ("0", "success"), "exit code 0", code=code, result=result)
    check(seen["last_command"] == {"effort": 0.0, "enable": 0}, "the last command disables the drive", **seen)
    check(seen["braking_commands"] > 0, "the axis was braked, not let go", **seen)
    return {"took_s": took, "exit_code": int(code), **seen}


def leaves_no_file(bench: Bench) -> Figures:
    """Uninstall: every file that was placed is gone again."""
    placed = [Path(entry["path"]) for entry in json.loads(run(str(PROGRAM), "install-service", "--json"))["files"]]
    check(all(path.exists() for path in placed), "they were there")
    bench.uninstall()
    left = [str(path) for path in placed if path.exists()]
    check(not left, "they are gone", left=left)
    check(bench.shown("LoadState") in {"not-found", "masked"}, "systemd has forgotten the unit", unit=UNIT)
    return {"removed": len(placed)}


def _times_stopped(bench: Bench) -> int:
    return bench.log("drives").count("no command in time")


def _drive_stops_by_itself(bench: Bench, times_before: int) -> float:
    begun = time.monotonic()
    while _times_stopped(bench) == times_before:
        check(time.monotonic() - begun < 30.0, "the drive's own time-out stops it within 30 s", log=bench.log("drives"))
        time.sleep(0.1)
    return time.monotonic() - begun


def _moves(bench: Bench) -> float:
    before = bench.ask("x")["axis"]["position"]
    time.sleep(1.0)
    moved: float = abs(bench.ask("x")["axis"]["position"] - before)
    return moved
