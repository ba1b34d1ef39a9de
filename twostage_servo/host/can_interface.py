"""Checks of a SocketCAN interface: whether it is there and up, and how its controller is set up."""

import json
from dataclasses import dataclass, field
from typing import Any, Final

from twostage_servo.host.findings import Finding, Host, Status

_ARPHRD_CAN: Final = "280"  # linux/if_arp.h
_IFF_UP: Final = 1  # linux/if.h
_LONGEST_QUEUE: Final = 100
_FD_MTU: Final = 72
"""Bytes of struct canfd_frame, linux/can.h: an interface that takes them says so by its mtu."""
_SAMPLE_POINTS: Final = (0.75, 0.9)
"""CiA 301 recommends 87.5 % of the bit time, and controllers cannot always meet it; nodes of one bus should agree."""


@dataclass(slots=True)
class CanInterface:
    """What is known about the interface.

    Attributes
    ----------
    findings
        One for each check.
    bit_rate
        Nominal bit rate, bit/s; None where it is not known.
    """

    findings: list[Finding] = field(default_factory=list)
    bit_rate: int | None = None

    def add(self, name: str, status: Status, found: str, remedy: str = "") -> None:
        """Add a finding."""
        self.findings.append(Finding(name, status, found, remedy))


def check_can_interface(host: Host, channel: str, *, fd: bool = False) -> CanInterface:
    """Check a SocketCAN interface, as far as sysfs and `ip` tell.

    Parameters
    ----------
    host
        Where to look.
    channel
        Name of the interface, such as ``can0``.
    fd
        Whether CAN FD frames are to be sent on it.
    """
    result = CanInterface()
    if not _check_presence(host, channel, result):
        return result
    try:
        output = host.run(["ip", "-details", "-json", "link", "show", channel])
    except FileNotFoundError:
        result.add("bus controller", Status.SKIP, "ip is not installed (package iproute2)")
        return result
    except OSError as error:
        result.add("bus controller", Status.SKIP, f"ip failed: {error}")
        return result
    link = _parse(output)
    if link is None:
        result.add("bus controller", Status.SKIP, "this version of ip does not print JSON")
        return result
    _check_queue(channel, link, result)
    _check_frames(channel, link, result, fd=fd)
    info = _table(link, "linkinfo")
    kind, data = info.get("info_kind"), _table(info, "info_data")
    if kind != "can" or not data:
        result.add("bus controller", Status.SKIP, f"{channel} is of kind {kind or 'unknown'}: it has no controller")
        return result
    _check_state(channel, data, _table(info, "info_xstats"), result)
    _check_modes(channel, data, result)
    _check_timing(channel, data, result)
    _check_restart(channel, data, result)
    return result


def _check_presence(host: Host, channel: str, result: CanInterface) -> bool:
    """Check that the interface is there, is a CAN interface and is up; False where nothing more can be asked of it."""
    networks = host.sys / "class" / "net"
    set_up = f"sudo ip link set {channel} up type can bitrate 500000 restart-ms 0 (with your bus' bit rate)"
    if not networks.is_dir():
        result.add("bus interface", Status.SKIP, f"{networks} cannot be read")
        return False
    if not channel or "/" in channel or not (networks / channel).exists():
        present = (
            ", ".join(sorted(n.name for n in networks.iterdir() if host.read(n / "type") == _ARPHRD_CAN)) or "none"
        )
        result.add(
            "bus interface",
            Status.FAIL,
            f"there is no {channel}; CAN interfaces present: {present}",
            "plug in the adapter and check that its driver loaded (sudo dmesg | grep -i can), or name another "
            f"interface in bus.channel; to try without one: sudo ip link add dev {channel} type vcan && "
            f"sudo ip link set {channel} up",
        )
        return False
    if host.read(networks / channel / "type") != _ARPHRD_CAN:
        result.add("bus interface", Status.FAIL, f"{channel} is not a CAN interface", "name one in bus.channel")
        return False
    flags = host.read(networks / channel / "flags") or "0x0"
    if not int(flags, 16) & _IFF_UP:
        at_boot = (
            f"at each boot: [Match] Name={channel} and [CAN] BitRate=500000 in /etc/systemd/network/80-can.network"
        )
        result.add("bus interface", Status.FAIL, f"{channel} is down", f"{set_up}; {at_boot}")
    else:
        result.add("bus interface", Status.OK, f"{channel} is up")
    return True


def _parse(output: str) -> dict[str, Any] | None:
    try:
        links = json.loads(output)
    except ValueError:
        return None
    if not isinstance(links, list):
        return None
    # Some versions of ip put empty objects before the one asked for.
    return next((link for link in links if isinstance(link, dict) and link.get("ifname")), None)


def _table(values: dict[str, Any], key: str) -> dict[str, Any]:
    table = values.get(key)
    return table if isinstance(table, dict) else {}


def _number(value: object) -> float | None:
    """Read a number; ip writes some of them as text."""
    try:
        return float(value) if isinstance(value, int | float | str) else None
    except ValueError:
        return None


def _check_queue(channel: str, link: dict[str, Any], result: CanInterface) -> None:
    length = _number(link.get("txqlen"))
    if length is None:
        result.add("transmit queue", Status.SKIP, "ip does not report its length")
    elif length > _LONGEST_QUEUE:
        result.add(
            "transmit queue",
            Status.WARN,
            f"{length:g} frames: while the bus is blocked, commands wait in it until they are long out of date",
            f'sudo ip link set {channel} txqueuelen 10; permanently, by udev: ACTION=="add", SUBSYSTEM=="net", '
            f'KERNEL=="{channel}", ATTR{{tx_queue_len}}="10"',
        )
    else:
        result.add("transmit queue", Status.OK, f"{length:g} frames")


def _check_state(channel: str, data: dict[str, Any], statistics: dict[str, Any], result: CanInterface) -> None:
    state = str(data.get("state", "unknown"))
    counters = _table(data, "berr_counter")
    found = state + (f", error counters {counters.get('tx')} tx, {counters.get('rx')} rx" if counters else "")
    if offs := _number(statistics.get("bus_off")):
        found += f", {offs:g} times bus-off since it was set up"
    wiring = "check both terminations (60 Ω between CAN_H and CAN_L), the bit rate of every node, cable and ground"
    if state == "ERROR-ACTIVE":
        result.add("bus controller", Status.OK, found)
    elif state in {"ERROR-WARNING", "ERROR-PASSIVE"}:
        result.add("bus controller", Status.WARN, found, f"{wiring}; check that another node is there to acknowledge")
    elif state == "BUS-OFF":
        restart = f"{wiring}; then sudo ip link set {channel} type can restart"
        result.add("bus controller", Status.FAIL, found, restart)
    elif state in {"STOPPED", "SLEEPING"}:
        result.add("bus controller", Status.FAIL, found, f"sudo ip link set {channel} up")
    else:
        result.add("bus controller", Status.SKIP, f"its state is {state}")


def _check_frames(channel: str, link: dict[str, Any], result: CanInterface, *, fd: bool) -> None:
    size = _number(link.get("mtu"))
    if size is None:
        result.add("frames", Status.SKIP, "ip does not report the interface's mtu")
    elif fd and size < _FD_MTU:
        result.add(
            "frames", Status.FAIL, f"bus.fd is true, but {channel} carries classic frames only (mtu {size:g})",
            f"set bus.fd = false, or: sudo ip link set {channel} down && sudo ip link set {channel} up type can "
            "bitrate RATE dbitrate RATE fd on (a vcan: mtu 72)",
        )  # fmt: skip
    else:
        able = "classic and CAN FD frames" if size >= _FD_MTU else "classic frames"
        result.add("frames", Status.OK, f"it carries {able}; the service sends {'CAN FD' if fd else 'classic'} ones")


def _check_modes(channel: str, data: dict[str, Any], result: CanInterface) -> None:
    listed = data.get("ctrlmode")
    modes = [str(mode) for mode in listed] if isinstance(listed, list) else []
    found = ", ".join(modes) if modes else "classic CAN, no special mode"
    for mode, option, why in (
        ("LISTEN-ONLY", "listen-only", "no command would reach the drive"),
        ("LOOPBACK", "loopback", "the controller talks to itself"),
    ):
        if mode in modes:
            remedy = f"sudo ip link set {channel} down && sudo ip link set {channel} up type can {option} off"
            result.add("bus mode", Status.FAIL, f"{found}: {why}", remedy)
            return
    if "ONE-SHOT" in modes or "PRESUME-ACK" in modes:
        option = "one-shot" if "ONE-SHOT" in modes else "presume-ack"
        remedy = f"sudo ip link set {channel} down && sudo ip link set {channel} up type can {option} off"
        result.add("bus mode", Status.WARN, f"{found}: a command that no node acknowledges is not sent again", remedy)
        return
    result.add("bus mode", Status.OK, found)


def _check_timing(channel: str, data: dict[str, Any], result: CanInterface) -> None:
    timing = _table(data, "bittiming")
    rate = _number(timing.get("bitrate", data.get("bittiming_bitrate")))
    if not rate:
        result.add("bit rate", Status.SKIP, "ip does not report it: the interface is not set up yet")
        return
    result.bit_rate = int(rate)
    result.add("bit rate", Status.OK, f"{rate / 1e3:g} kbit/s")
    point = _number(timing.get("sample_point"))
    if point is None:
        result.add("sample point", Status.SKIP, "ip does not report it")
    elif not _SAMPLE_POINTS[0] <= point <= _SAMPLE_POINTS[1]:
        result.add(
            "sample point",
            Status.WARN,
            f"{100 * point:g} % of the bit time; CiA 301 recommends 87.5 %",
            f"sudo ip link set {channel} down && "
            f"sudo ip link set {channel} up type can bitrate {rate:.0f} sample-point 0.875",
        )
    else:
        result.add("sample point", Status.OK, f"{100 * point:g} % of the bit time")


def _check_restart(channel: str, data: dict[str, Any], result: CanInterface) -> None:
    delay = _number(data.get("restart_ms")) or 0.0
    if not delay:
        result.add("restart after bus-off", Status.OK, "manual")
        return
    result.add(
        "restart after bus-off",
        Status.WARN,
        f"automatic after {delay:g} ms: a faulty controller disturbs the bus again and again",
        f"sudo ip link set {channel} down && sudo ip link set {channel} up type can restart-ms 0",
    )
