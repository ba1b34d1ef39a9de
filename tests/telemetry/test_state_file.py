"""A state file is there whole or not at all, whatever happens as it is written, and whatever lies in its place."""

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from twostage_servo.telemetry.state_file import (
    CountsAsErasedError,
    erase_state,
    read_state,
    remove_remains,
    write_state,
)

_KILLED_BEFORE_IT_REPLACES = """
import os, pathlib, signal, sys
from twostage_servo.telemetry.state_file import write_state
os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
write_state(pathlib.Path(sys.argv[1]), {"new": True})
"""


def test_what_was_written_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "state" / "trips" / "learned-x.json"
    assert read_state(path) is None
    write_state(path, {"gain": 0.1, "load": [None, 1.0]})
    write_state(path, {"gain": 0.2})
    assert read_state(path) == {"gain": 0.2}
    assert [one.name for one in path.parent.iterdir()] == ["learned-x.json"]
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.processes
def test_a_process_that_is_killed_before_it_replaces_the_file_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "learned-x.json"
    write_state(path, {"old": True})
    done = subprocess.run(  # noqa: S603 - our own code
        [sys.executable, "-c", _KILLED_BEFORE_IT_REPLACES, str(path)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        check=False,
        timeout=60,
    )
    assert done.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 2
    assert read_state(path) == {"old": True}
    remove_remains(path)
    assert [one.name for one in tmp_path.iterdir()] == ["learned-x.json"]
    write_state(path, {"new": True})
    assert read_state(path) == {"new": True}


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    path = tmp_path / "learned-x.json"
    write_state(path, {"old": True})

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, call, full)
    with pytest.raises(OSError, match="No space left"):
        write_state(path, {"new": True})
    assert read_state(path) == {"old": True}
    assert [one.name for one in tmp_path.iterdir()] == ["learned-x.json"]


def test_a_number_that_is_none_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "learned-x.json"
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_state(path, {"gain": float("nan")})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "data",
    [
        b"", b"{", b'{"gain": 1.0', b"[]", b"1", b'{"gain": NaN}', b'{"gain": -Infinity}', b"\xff\xfe", b"[" * 60_000,
        b'{"a":' * 10_000, b'{"gain": ' + b"9" * 60_000 + b"}", json.dumps({"long": "x" * 70_000}).encode(),
    ],
    ids=range(12),
)  # fmt: skip
def test_what_is_no_whole_document_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "learned-x.json"
    path.write_bytes(data)
    with pytest.raises(ValueError):  # noqa: PT011 - each has its own text
        read_state(path)


def test_a_pipe_of_that_name_keeps_nobody_waiting(tmp_path: Path) -> None:
    path = tmp_path / "learned-x.json"
    os.mkfifo(path)
    with pytest.raises(ValueError, match="Expecting value"):
        read_state(path)
    write_state(path, {"new": True})
    assert read_state(path) == {"new": True}


def test_a_folder_in_its_place_is_told(tmp_path: Path) -> None:
    path = tmp_path / "learned-x.json"
    path.mkdir()
    with pytest.raises(OSError, match=r"learned-x\.json"):
        read_state(path)
    with pytest.raises(CountsAsErasedError, match=r"learned-x\.json"):
        erase_state(path)


def immovable(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a file be such as nobody but root may remove or replace, as another user's in a sticky folder."""
    unlink, replace = os.unlink, os.replace

    def refusing_unlink(name: str | Path, **folder: int) -> None:
        if Path(name) == path:
            raise PermissionError(errno.EPERM, "Operation not permitted", str(path))
        unlink(name, **folder)

    def refusing_replace(source: str, name: str | Path) -> None:
        if Path(name) == path:
            raise PermissionError(errno.EPERM, "Operation not permitted", str(path))
        replace(source, name)

    monkeypatch.setattr(os, "unlink", refusing_unlink)
    monkeypatch.setattr(os, "replace", refusing_replace)


def test_what_cannot_be_removed_is_not_read_any_more_until_it_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "learned-x.json"
    write_state(path, {"old": True})
    with monkeypatch.context() as patch:
        immovable(path, patch)
        for _ in range(2):
            with pytest.raises(CountsAsErasedError, match=r"not permitted: '.*/learned-x.json'"):
                erase_state(path)
        with pytest.raises(PermissionError):
            write_state(path, {"new": True})
        remove_remains(path)
        with pytest.raises(ValueError, match=r"counts as erased \(.*/learned-x.json.erased\)"):
            read_state(path)
    write_state(path, {"new": True})
    assert read_state(path) == {"new": True}
    assert [one.name for one in tmp_path.iterdir()] == ["learned-x.json"]


def test_the_mark_of_a_file_that_somebody_has_removed_goes_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "learned-x.json"
    write_state(path, {"old": True})
    with monkeypatch.context() as patch:
        immovable(path, patch)
        with pytest.raises(CountsAsErasedError):
            erase_state(path)
    path.unlink()
    assert read_state(path) is None
    remove_remains(path)
    assert list(tmp_path.iterdir()) == []


def test_where_nothing_can_be_changed_it_is_told_that_nothing_is_erased(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "learned-x.json"
    write_state(path, {"old": True})

    def read_only(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "unlink", read_only)
    monkeypatch.setattr(Path, "touch", read_only)
    with pytest.raises(OSError, match="Read-only") as raised:
        erase_state(path)
    assert not isinstance(raised.value, CountsAsErasedError)
    assert read_state(path) == {"old": True}


def test_what_is_erased_is_gone_and_what_is_not_there_can_be_erased(tmp_path: Path) -> None:
    path = tmp_path / "none" / "learned-x.json"
    erase_state(path)
    remove_remains(path)
    write_state(path, {"old": True})
    erase_state(path)
    assert read_state(path) is None
    (tmp_path / "file").write_text("no folder", "utf-8")
    erase_state(tmp_path / "file" / "learned-x.json")
    assert read_state(tmp_path / "file" / "learned-x.json") is None


def test_only_what_is_left_of_this_file_is_removed(tmp_path: Path) -> None:
    names = ["learned-x.json.abc.part", "learned-xy.json.abc.part", "000001-20260101T000000Z-x.part", "learned-x.json"]
    for name in names:
        (tmp_path / name).write_text("{}", "utf-8")
    remove_remains(tmp_path / "learned-x.json")
    assert {one.name for one in tmp_path.iterdir()} == set(names[1:])
