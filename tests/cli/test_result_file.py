"""Files that verbs write where the operator says: whole, or what was there before stays."""

import csv
import errno
import os
import stat
from pathlib import Path
from typing import IO, Any, Self, cast

import pytest

from twostage_servo.cli.main import main
from twostage_servo.cli.output import CommandError, ExitCode
from twostage_servo.cli.result_file import as_csv, check_result, write_result


class FullDisk:
    """A file on a disk with room for a few bytes."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file = file

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def fileno(self) -> int:
        return self.file.fileno()

    def write(self, content: bytes) -> int:
        self.file.write(content[:3])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("former", [b"what was worth keeping", None])
def test_a_full_disk_leaves_what_was_there_and_nothing_else(
    tmp_path: Path, former: bytes | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "recording.csv"
    if former is not None:
        path.write_bytes(former)
    normal = Path.open
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", lambda path, mode: FullDisk(cast("IO[bytes]", normal(path, mode))))
        with pytest.raises(CommandError) as told:
            write_result(path, b"new content", "recording")
    assert (told.value.exit_code, told.value.code) == (ExitCode.FAILED, "recording")
    text = f"the recording cannot be written: {path}: No space left on device; make room there or name another file"
    assert str(told.value) == text
    assert [(one.name, one.read_bytes()) for one in tmp_path.iterdir()] == [
        (path.name, content) for content in [former] if content is not None
    ]


def test_a_link_stays_a_link_and_a_mode_that_mode(tmp_path: Path) -> None:
    path, link = tmp_path / "file", tmp_path / "link"
    path.write_bytes(b"old")
    path.chmod(0o640)
    link.symlink_to(path)
    write_result(link, b"new", "trace")
    assert (link.is_symlink(), path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (True, b"new", 0o640)
    former = os.umask(0o027)
    try:
        write_result(tmp_path / "another", b"new", "trace")
    finally:
        os.umask(former)
    assert stat.S_IMODE((tmp_path / "another").stat().st_mode) == 0o640


def test_a_device_gets_the_result_and_is_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        check_result(pipe, "trace")
        write_result(pipe, b"content", "trace")
        assert os.read(reader, 100) == b"content"
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_check_tells_what_writing_would_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "trace.csv"
    path.write_bytes(b"a good trace")
    check_result(path, "trace")
    assert [(one.name, one.read_bytes()) for one in tmp_path.iterdir()] == [("trace.csv", b"a good trace")]
    for wrong in (tmp_path, tmp_path / "no" / "folder", path / "below a file"):
        for act in (check_result, lambda path, name: write_result(path, b"", name)):
            with pytest.raises(CommandError, match=r"^the trace cannot be written: .*; make room there"):
                act(wrong, "trace")


def test_rows_are_read_back_as_they_were() -> None:
    rows: list[list[Any]] = [["a,b", 'say "no"', "two\nlines", ""], [1, -2.5, True, None]]
    read = list(csv.reader(as_csv(rows).decode().splitlines(keepends=True)))
    assert read == [rows[0], ["1", "-2.5", "True", ""]]


def test_a_demo_that_is_refused_leaves_the_former_trace(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "trace.csv"
    path.write_text("a good trace")
    assert main(["demo", "--fast", "--to", "99999", "--trace", str(path)]) == ExitCode.USAGE
    assert "99999" in capsys.readouterr().err
    assert path.read_text() == "a good trace"


def test_a_page_that_cannot_be_written_is_told_before_the_campaign(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["faults", "--simulated", "--html", str(tmp_path / "no" / "page.html")]) == ExitCode.FAILED
    told = capsys.readouterr()
    assert (told.out, "the page cannot be written" in told.err) == ("", True)
