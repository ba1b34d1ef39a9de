"""Decode a log of candump with cantools and the shipped DBC, without a line of the package.

`python -m tools.rig.decode LOG CHANNEL...` prints as JSON, for each channel, the number of commands and feedbacks, the
commands that their counter shows to be lost, the first and last position, the last command, how many commands braked.
"""

import itertools
import json
import sys
from pathlib import Path

import cantools
from cantools.database.can import Database, Message


def _signal(message: Message, data: str, name: str) -> float:
    value = message.decode_simple(bytes.fromhex(data), decode_choices=False)[name]
    if not isinstance(value, int | float):
        raise TypeError(f"{message.name}.{name} is {value!r}, a number was expected")
    return value


def main() -> None:
    """Decode, and print."""
    log, *channels = sys.argv[1:]
    database = cantools.database.load_file(Path(__file__).resolve().parents[2] / "config/servo_drive.dbc")
    if not isinstance(database, Database):
        raise TypeError("servo_drive.dbc is no database of CAN frames")
    command, feedback = (database.get_message_by_name(name) for name in ("DriveCommand", "DriveFeedback"))
    lines = Path(log).read_text().splitlines()
    print(json.dumps({channel: _decoded(lines, channel, command, feedback) for channel in channels}))


def _decoded(lines: list[str], channel: str, command: Message, feedback: Message) -> dict[str, object]:
    modulus = 1 << command.get_signal_by_name("AliveCounter").length
    counters, efforts, enables, positions, fd = [], [], [], [], 0
    for line in lines:
        _, interface, frame = line.split()[:3]
        identifier, _, data = frame.partition("#")
        if interface != channel or len(identifier) > 3:
            continue
        if data.startswith("#"):  # CAN FD: a second # and a digit of flags
            data, fd = data[2:], fd + 1
        if int(identifier, 16) == command.frame_id:
            counters.append(int(_signal(command, data, "AliveCounter")))
            efforts.append(_signal(command, data, "Effort"))
            enables.append(int(_signal(command, data, "Enable")))
        elif int(identifier, 16) == feedback.frame_id:
            positions.append(_signal(feedback, data, "Position"))
    gaps = sum((later - one) % modulus != 1 for one, later in itertools.pairwise(counters))
    result: dict[str, object] = {"commands": len(counters), "gaps": gaps, "feedbacks": len(positions), "can_fd": fd}
    result |= {"last_command": {"effort": efforts[-1], "enable": enables[-1]}}
    forward = positions[-1] - positions[0]
    braking = sum(enable and effort * forward < 0.0 for effort, enable in zip(efforts, enables, strict=True))
    result |= {"braking_commands": braking}
    return result | {"first": positions[0], "last": positions[-1], "highest": max(positions)}


if __name__ == "__main__":
    main()
