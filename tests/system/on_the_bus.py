"""What must hold on a real bus: absent, down, removed, blocked, full, bus-off."""

import contextlib
import json
import signal
import sys
import time
from pathlib import Path

from tests.system.checks import (
    IDLE_SHARE,
    Figures,
    check,
    controller_is,
    disarmed,
    move,
    recover,
    shows,
    tripped,
)  # fmt: skip
from tools.rig.bench import Bench, run


def starts_without_its_buses(bench: Bench) -> Figures:
    """can0 is down and vcan0 does not exist: the service starts, says what to do, and waits without being busy."""
    bench.start_drives()
    begun = time.monotonic()
    bench.service("start")
    ready_s = time.monotonic() - begun
    causes = {"x": "Network is down", "y": "No such device"}
    for axis, text in causes.items():
        bench.until(axis, text, shows(text))
    files, share, lines = bench.open_files(), bench.processor_share(3.0), bench.log("service").count("\n")
    more = bench.open_files() - files
    check(more <= 0, "some ten attempts leave no files open", more=more)
    check(bench.log("service").count("\n") == lines, "each cause is logged once")
    run("systemctl", "start", "systemd-networkd")  # its file brings both boards up, with their bit rate
    run("ip", "link", "add", "vcan0", "type", "vcan")
    run("ip", "link", "set", "vcan0", "mtu", "72", "up")
    opened_s = max(bench.until(axis, "opens by itself", disarmed) for axis in causes)
    check(share < IDLE_SHARE, "waits without being busy", share=share)
    check("bitrate 500000" in run("ip", "-details", "link", "show", "can0"), "networkd has set the bit rate")
    return {"ready_s": ready_s, "opened_s": opened_s, "processor_waiting": share}


def moves_by_the_command_line(bench: Bench) -> Figures:
    """400 mm on can0, -50 mm on vcan0 with CAN FD, as an operator does it; candump and cantools see the same."""
    log = bench.folder / "candump.log"
    bench.start("candump", "candump", "-L", "can0", "vcan0")
    begun = time.monotonic()
    bench.operate("arm")
    bench.operate("move", "x=400", "y=-50", "--wait")
    took = time.monotonic() - begun
    frames = {axis: bench.ask(axis)["frames"] for axis in ("x", "y")}
    places = {axis: bench.ask(axis)["axis"]["position"] for axis in ("x", "y")}
    bench.operate("disarm")
    bench.end("candump", signal.SIGINT)
    log.write_text(bench.log("candump"))
    decoded = json.loads(run(sys.executable, "-m", "tools.rig.decode", str(log), "can0", "vcan0"))
    seen = {"x": decoded["can0"], "y": decoded["vcan0"]}
    for axis, target in (("x", 400.0), ("y", -50.0)):
        check(abs(places[axis] - target) < 0.1, f"{axis} arrives", **places)
        check(abs(seen[axis]["last"] - target) < 0.1, "cantools agrees", **seen[axis])
        dropped = bench.ask(axis)["frames"][
            "dropped"
        ]  # by a machine that misses a tick; two in a row would have tripped
        check(seen[axis]["commands"] > 200 and seen[axis]["gaps"] <= dropped, "the other commands are on the bus",
              dropped=dropped, **seen[axis])  # fmt: skip
        check(frames[axis]["rejected"] == 0, "none was rejected", **frames[axis])
    check(seen["x"]["can_fd"] == 0 and seen["y"]["can_fd"] > 400, "CAN FD on vcan0 alone", **seen)
    ages = {axis: frames[axis]["age_us"] for axis in ("x", "y")}
    check(all(0.0 < age["p50"] < 1e6 for age in ages.values()), "the kernel's stamps date the frames", **ages)
    return {"took_s": took, "on_can0": seen["x"], "on_vcan0": seen["y"], "age_us": ages}


def filters_in_the_kernel(bench: Bench) -> Figures:
    """Let foreign frames pass by: the kernel's list has our identifiers, and a babbling node costs nothing."""
    listed = Path("/proc/net/can/rcvlist_fil").read_text()
    for identifier in ("181", "701", "201"):
        check(any(line.split()[:2] == ["can0", identifier] for line in listed.splitlines()), "filter", listed=listed)
    before, quiet = bench.ask("x")["frames"], bench.processor_share(3.0)
    bench.start("babble", "cangen", "can1", "-g", "2", "-I", "555", "-L", "8")
    share = bench.processor_share(3.0)
    bench.end("babble")
    after = bench.ask("x")["frames"]
    check(after["overruns"] == before["overruns"], "no drain ends at its bound", **after)
    check(after["rejected"] == before["rejected"], "nothing is rejected", **after)
    return {"processor_quiet": quiet, "processor_babble": share}


def interface_down(bench: Bench) -> Figures:
    """Take the interface down in mid-move: drive disabled, no busy loop, opened again disarmed."""
    move(bench, "x", 0.0)
    run("ip", "link", "set", "can0", "down")
    trip_s = tripped(bench, "x", "bus_failed", "Network is down")
    _is_told_to_the_manager(bench)
    before = bench.log("service").count("\n")
    share = bench.processor_share(3.0)
    lines = bench.log("service").count("\n") - before
    check(share < IDLE_SHARE and lines <= 4, "no busy loop", share=share, lines=lines)
    check(bench.ask("y")["bus"]["open"] and not bench.ask("y")["trip"], "the other bus goes on")
    run("ip", "link", "set", "can0", "up")
    open_s = bench.until("x", "opens by itself", lambda one: one["bus"]["open"])
    return {"trip_s": trip_s, "open_s": open_s, "processor_down": share, "log_lines": lines} | recover(bench, "x")


def _is_told_to_the_manager(bench: Bench) -> None:
    """See what `systemctl status` and the journal have of the trip."""
    time.sleep(1.0)
    shown = bench.shown("StatusText")
    check("x tripped (bus_failed): bus socketcan can0" in shown and "y disarmed" in shown, "in the status", shown=shown)
    # The line of its trip file has the code as well, but no cause.
    (entry,) = [one for one in bench.journal() if one.get("CODE") == "bus_failed" and "CAUSE" in one]
    fields = {name: str(entry.get(name)) for name in ("PRIORITY", "AXIS", "TICK", "CAUSE", "MESSAGE")}
    check((fields["PRIORITY"], fields["AXIS"]) == ("3", "x") and int(fields["TICK"]) > 0, "in the journal", **fields)


def board_removed(bench: Bench) -> Figures:
    """Remove the board from its slot in mid-move, and put it back."""
    move(bench, "x", 400.0)
    Path("/sys/class/net/can0/device/remove").write_text("1")
    trip_s = tripped(bench, "x", "bus_failed", "")
    cause = bench.ask("x")["trip"]["cause"]
    bench.until("x", "missed", lambda one: "No such device" in (one["bus"]["error"] or ""))
    share = bench.processor_share(3.0)
    check(share < IDLE_SHARE, "no busy loop", share=share)
    Path("/sys/bus/pci/rescan").write_text("1")
    open_s = bench.until("x", "opens by itself", lambda one: one["bus"]["open"])
    queue = Path("/sys/class/net/can0/tx_queue_len").read_text().strip()
    check(queue == "10", "the udev rule has set the length of the queue", queue=queue)
    return {"trip_s": trip_s, "cause": cause, "open_s": open_s, "processor_gone": share} | recover(bench, "x")


def bus_blocked(bench: Bench) -> Figures:
    """Nothing leaves the interface any more, though its queue has room for 1000: two commands in a row, then a trip.

    When the bus is free again, no more than one old command leaves.
    """
    run("ip", "link", "set", "can0", "txqueuelen", "1000")
    move(bench, "x", 0.0)
    before = bench.ask("x")["frames"]["sent"]
    run("tc", "qdisc", "add", "dev", "can0", "root", "tbf", "rate", "8bit", "burst", "16", "limit", "16000")
    trip_s = tripped(bench, "x", "commands_dropped", "did not accept 2 commands in a row")
    queued = next(line for line in run("tc", "-s", "qdisc", "show", "dev", "can0").splitlines() if "backlog" in line)
    waiting = int(queued.split()[2].removesuffix("p"))
    dropped = bench.ask("x")["frames"]["dropped"]
    check(waiting <= 1, "no stale command waits", queued=queued)
    share = bench.processor_share(3.0)
    run("tc", "qdisc", "del", "dev", "can0", "root")
    run("ip", "link", "set", "can0", "txqueuelen", "10")
    figures = {"trip_s": trip_s, "waiting_commands": waiting, "dropped": dropped, "processor_blocked": share}
    check(bench.ask("x")["frames"]["sent"] > before, "commands leave again")
    return figures | recover(bench, "x")


def queue_full_of_others(bench: Bench) -> Figures:
    """Another program has filled the queue: ENOBUFS at once, two commands in a row, then a trip."""
    move(bench, "x", 400.0)
    before = bench.ask("x")["frames"]["dropped"]
    run("tc", "qdisc", "add", "dev", "can0", "root", "tbf", "rate", "8bit", "burst", "16", "limit", "16")
    for _ in range(3):
        with contextlib.suppress(AssertionError):  # the last ones are told that the queue is full, as they should be
            run("cansend", "can0", "7FF#0102")
    trip_s = tripped(bench, "x", "commands_dropped", "did not accept 2 commands in a row")
    dropped = bench.ask("x")["frames"]["dropped"] - before
    check(dropped >= 2, "they are counted", dropped=dropped)
    check(bench.ask("x")["bus"]["open"], "the bus stays open: it is full, not gone")
    run("tc", "qdisc", "del", "dev", "can0", "root")
    return {"trip_s": trip_s, "dropped": dropped} | recover(bench, "x")


def error_frames(bench: Bench) -> Figures:
    """Warning and passive are told and tolerated; bus-off disables the drive. Its own bus alone is concerned."""
    move(bench, "y", 300.0)
    for status, counters, state in (
        (0x08, (100, 0), "warning"),
        (0x20, (130, 5), "passive"),
        (0x40, (90, 5), "active"),
    ):
        bench.error_frame("vcan0", 0x204, bytes((0, status, 0, 0, 0, 0, *counters)))
        bench.until("y", state, controller_is(state))
        shown = bench.ask("y")
        check(shown["bus"]["error_counters"] == list(counters), "the controller's counters", **shown["bus"])
        check(not shown["trip"], "is tolerated")
        check(f"state={state}" in bench.log("service") or f'"state":"{state}"' in bench.log("service").replace(" ", ""),
              "is logged", state=state)  # fmt: skip
    bench.error_frame("vcan0", 0x40, bytes(8))
    trip_s = tripped(bench, "y", "bus_failed", "went bus-off")
    kinds = bench.ask("y")["frames"]["errors_by_kind"]
    check(kinds == {"warning": 1, "passive": 1, "active": 1, "bus_off": 1}, "each is counted", **kinds)
    check(not bench.ask("x")["trip"], "the other bus goes on")
    return {"trip_s": trip_s, "errors_by_kind": kinds} | recover(bench, "y")
