"""A quick share of the fuzzing in tools/fuzz, and every number that no request and no signal may hold."""

import contextlib
import json
import math
import struct
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest
import structlog
from pydantic import BaseModel

from tools.fuzz import frames, lines, tomls
from tools.fuzz.bench import Bench
from tools.fuzz.drives import Drive, Kind, all_drives
from tools.fuzz.line_maker import Line
from tools.fuzz.lines import ControlSocketRig
from tools.fuzz.outcome import Failed
from tools.fuzz.quiet_log import quiet_log
from tools.fuzz.reference import refusal
from tools.fuzz.reproducible import reproducible
from tools.fuzz.request_maker import minimal_request, numeric_fields
from tools.fuzz.targets import CodecTarget, SocketTarget
from twostage_servo.api.requests import OPERATIONS
from twostage_servo.axis.messages import Feedback
from twostage_servo.config.errors import ConfigError
from twostage_servo.config.loader import load
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.dbc.settings import ProtocolSettings
from twostage_servo.drives.frame import FrameRejected

NUMBERS = ("NaN", "Infinity", "-Infinity", "1e308", "-1e308", "1e400", "-1e400")


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    quiet_log()
    yield
    structlog.reset_defaults()


# A quick share of what tools.fuzz.run does -------------------------------------------------------------------------


@pytest.mark.parametrize("episode", range(10))
def test_frames(episode: int) -> None:
    outcome = frames.run_episode(7, episode, 2000)
    assert outcome.cases >= 2000
    assert outcome.counts["rejected"] > 0


def test_late_frames_are_among_them() -> None:
    assert frames.run_episode(7, 3, 500).counts["late"] > 0


@pytest.mark.parametrize("episode", range(10))
def test_lines(episode: int) -> None:
    outcome = lines.run_episode(7, episode, 200)
    assert outcome.counts["answer.bad_request"] > 0


@pytest.mark.parametrize("episode", range(4))
def test_tomls(episode: int) -> None:
    outcome = tomls.run_episode(7, episode, 25)
    assert outcome.findings == []


def test_what_coverage_guides_begins_without_a_finding() -> None:
    codec, socket = CodecTarget(), SocketTarget()
    for data in codec.seeds():
        codec(data)
    with contextlib.closing(socket):
        for data in [b"", b"\0", *socket.seeds()[::9]]:
            socket(data)


def test_an_episode_follows_from_its_seed() -> None:
    again = [frames.run_episode(3, 2, 500).counts for _ in range(2)]
    assert again[0] == again[1]
    assert again[0] != frames.run_episode(4, 2, 500).counts


# Numbers in requests --------------------------------------------------------------------------------------------------


def test_every_numeric_field_of_every_request_is_among_those_tried() -> None:
    in_models = {
        (model.op, name)
        for model in OPERATIONS.values()
        for name, kind in typing.get_type_hints(model).items()
        if {int, float} & {kind, *typing.get_args(kind)}
    }
    assert len(in_models) == len(numeric_fields())
    assert {name for _, name in in_models} == {field.field for field in numeric_fields()}


@pytest.fixture(scope="module")
def socket_rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ControlSocketRig]:
    with contextlib.closing(
        ControlSocketRig(Bench(all_drives()[0], reproducible("socket_rig")), tmp_path_factory.mktemp("s") / "s")
    ) as socket_rig:
        yield socket_rig


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize(("op", "field"), [(field.op, field.field) for field in numeric_fields()])
def test_a_number_that_no_axis_takes_is_refused_by_the_name_of_its_field(
    socket_rig: ControlSocketRig, op: str, field: str, number: str
) -> None:
    request = json.dumps(minimal_request(op, **{field: "@"})).replace('"@"', number)
    answer = socket_rig.ask(Line(request.encode(), refused=True))
    assert answer["error"]["code"] == "bad_request" or answer["error"]["code"].endswith("_limit")
    assert field in answer["error"]["message"]


# Numbers in signals ---------------------------------------------------------------------------------------------------


def layouts() -> list[Drive]:
    """Each DBC once."""
    drives = reversed(all_drives())  # the first one of each remains
    return list({drive.loaded.config.protocol.model_dump_json(): drive for drive in drives}.values())


def unusable_frames(kind: Kind, signal: str) -> list[can.Message]:
    """Frames that are right but for one signal, in which they hold what it must not."""
    description = kind.message.get_signal_by_name(signal)
    length = description.length
    raws = (
        range(1 << length)
        if length <= 8
        else {1 << bit for bit in range(length)} | {(1 << bit) - 1 for bit in range(length + 1)}
    )
    if description.is_float:
        form, whole = {16: ("<e", "<H"), 32: ("<f", "<I"), 64: ("<d", "<Q")}[length]
        raws = {struct.unpack(whole, struct.pack(form, value))[0] for value in (math.nan, math.inf, -math.inf)}
    base = bytes(kind.of())
    found = []
    for raw in raws:
        data = kind.repaired(_with_raw(base, description, raw))
        message = can.Message(0.0, kind.identifier.identifier, kind.identifier.extended, data=data)
        if refusal(kind, message) == signal:
            found.append(message)
    return found


def _with_raw(base: bytes, signal: Any, raw: int) -> bytearray:
    """Put the bits of a signal into a frame, one by one and by the book."""
    data, at = bytearray(base), signal.start
    for number in range(signal.length):
        bit = number if signal.byte_order == "little_endian" else signal.length - 1 - number
        byte, place = divmod(at, 8)
        data[byte] = data[byte] & ~(1 << place) | (raw >> bit & 1) << place
        at = at + 1 if signal.byte_order == "little_endian" or place else at + 15
        if signal.byte_order == "big_endian" and place:
            at -= 2
    return data


SIGNALS = [
    pytest.param(drive, kind, signal, id=f"{drive.name}-{kind.name}-{signal}")
    for drive in layouts()
    for kind in drive.kinds.values()
    for signal in kind.signals.values()
    if unusable_frames(kind, signal)
]


def test_the_signals_tried_are_those_that_can_hold_what_they_must_not() -> None:
    tried = {parameters.id for parameters in SIGNALS}
    for name in (
        "shipped-feedback-Position",
        "shipped-command-Effort",
        "shipped-index-Position",
        "shipped-heartbeat-State",
    ):
        assert name in tried
    assert len(tried) >= 12


@pytest.mark.parametrize(("drive", "kind", "signal"), SIGNALS)
def test_a_value_that_a_signal_must_not_hold_is_rejected_by_its_name(drive: Drive, kind: Kind, signal: str) -> None:
    for message in unusable_frames(kind, signal):
        with pytest.raises(FrameRejected) as rejection:
            kind.decode(message)
        assert rejection.value.reason in {"reserved_value", "not_finite"}
        assert signal in str(rejection.value) or kind.name == "heartbeat"


def test_the_service_counts_each_of_them_and_does_nothing_else() -> None:
    drive = all_drives()[0]
    bench = Bench(drive, reproducible("counted"))
    bad = [
        message
        for kind in drive.kinds.values()
        if kind.name != "command"
        for signal in kind.signals.values()
        for message in unusable_frames(kind, signal)
    ]
    assert bad

    async def prepare() -> None:
        bench.answer_as_drive(heartbeat=False)
        if bad:
            bench.bus.queue.append(bad.pop())
        elif not bench.service.shutdown.is_ending:
            bench.service.shut_down()

    expected = len(bad)
    bench.run(prepare)
    counters = bench.axis_loop.bus.link.counters
    assert counters.rejected_by_reason == {"reserved_value": expected}
    assert bench.position == 0.0
    assert bench.axis_loop.axis.drive.position == 0.0


def float_profile(folder: Path, length: int, limits: str) -> DriveProfile:
    (folder / "float.dbc").write_text(
        'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A B\n\n'
        'BO_ 256 Order: 8 A\n SG_ Force : 0|16@1- (0.01,0) [-300|300] "" B\n SG_ On : 16|1@1+ (1,0) [0|1] "" B\n\n'
        f'BO_ 257 Report: 8 B\n SG_ Place : 0|{length}@1- (1,0) [{limits}] "mm" A\n\n'
        f"SIG_VALTYPE_ 257 Place : {1 if length == 32 else 2};\n",
        encoding="ascii",
    )
    tables: dict[str, Any] = {
        "feedback": {"message": "Report", "position": "Place"},
        "command": {"message": "Order", "effort": "Force", "enable": "On"},
        "heartbeat": {"message": False},
        "index": {"message": False},
    }
    for name, field in ProtocolSettings.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            table = tables.setdefault(name, {})
            for key, setting in field.annotation.model_fields.items():
                if isinstance(setting.default, str) and "False" in str(setting.annotation):
                    table.setdefault(key, False)
    settings = ProtocolSettings.model_validate({"dbc": "float.dbc", "checksum": "none", **tables})
    return DriveProfile.compile(settings, folder, "mm")


@pytest.mark.parametrize(
    ("length", "value", "reason"),
    [
        *((length, value, "not_finite") for length in (32, 64) for value in (math.nan, math.inf, -math.inf)),
        (32, 3.4e38, "reserved_value"),
        (64, 1e308, "reserved_value"),
        (64, -1e308, "reserved_value"),
        (64, 1000.0000000001, "reserved_value"),
    ],
)
def test_a_position_that_is_an_ieee_float_is_finite_and_within_its_limits(
    tmp_path: Path, length: int, value: float, reason: str
) -> None:
    profile = float_profile(tmp_path, length, "-1000|1000")

    def frame(position: float) -> can.Message:
        data = struct.pack("<f" if length == 32 else "<d", position).ljust(8, b"\0")
        return can.Message(0.0, 257, False, data=data)

    assert profile.decode_feedback(frame(-999.5)) == Feedback(-999.5, *[None] * (len(Feedback._fields) - 1))
    with pytest.raises(FrameRejected, match="Place") as rejection:
        profile.decode_feedback(frame(value))
    assert rejection.value.reason == reason


# What is known, and what checks the checks ----------------------------------------------------------------------------


def test_an_integer_of_thousands_of_digits_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "huge.toml"
    path.write_text(f"[service]\ntick_ms = {'9' * 5000}\n")
    with pytest.raises(ConfigError) as error:
        load(path)
    assert all(problem.line == 2 or problem.key for problem in error.value.problems)


def test_the_bench_finds_a_rejection_that_is_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twostage_servo.canbus.link.LinkCounters.count_rejection", lambda *_: None)
    with pytest.raises(Failed, match="0 times counted as rejected"):
        frames.run_episode(7, 0, 2000)


def test_the_bench_finds_an_effort_beyond_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twostage_servo.axis.motion.Motion.step", lambda *_: 25.0)
    monkeypatch.setattr("twostage_servo.app.assembly.check_detection", lambda _: None)  # which steps as well
    with pytest.raises(Failed, match="the effort is 25"):
        frames.run_episode(7, 0, 2000)


def test_the_rig_finds_a_number_that_is_carried_out(socket_rig: ControlSocketRig) -> None:
    with pytest.raises(Failed, match="carried out"):
        socket_rig.ask(Line(b'{"op": "status"}', refused=True))


@pytest.mark.parametrize(
    "data", [b'{"ok": NaN}\n', b'{"ok": 1e999}\n', b'{"ok": true, "ok": true}\n', b"{\n", b"\xff\n"]
)
def test_an_answer_that_is_not_strict_json_is_found(data: bytes) -> None:
    with pytest.raises(Failed):
        lines.strict_json(data)
