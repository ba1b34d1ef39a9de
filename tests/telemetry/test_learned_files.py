"""The files of what laws have learned: their names, and what is told of a disk that does not do what it should."""

import asyncio
import threading
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import pytest
import structlog

from twostage_servo.api.fields import JsonObject
from twostage_servo.telemetry import learned_files
from twostage_servo.telemetry.learned_files import LearnedFile, LearnedFiles
from twostage_servo.timing.virtual_clock import run


def read_state_of(file: LearnedFile) -> tuple[str | None, bool]:
    return file.error, file.would_return


def logged(script: Coroutine[Any, Any, None]) -> list[tuple[str, str]]:
    with structlog.testing.capture_logs() as logs:
        run(script)
    return [(line["log_level"], line["event"]) for line in logs]


def test_each_axis_has_a_file_of_its_own_in_the_folder(tmp_path: Path) -> None:
    files = LearnedFiles(tmp_path)
    assert files.path("x-1").name == "learned-x-1.json"
    names = ["x-1", "a/b", "a_b", "../../etc/passwd", "ä", "x y", "x.y", "🙂" * 64, "\ud800"]
    paths = {files.path(name) for name in names}
    assert len(paths) == len(names)
    assert all(path.parent == tmp_path and len(path.name) < 100 and path.name.isascii() for path in paths)


def test_what_is_written_last_stays_and_what_is_erased_last_is_gone(tmp_path: Path) -> None:
    async def script() -> None:
        files = LearnedFiles(tmp_path)
        file = LearnedFile()
        assert not files.exists("x")
        files.write("x", {"moves": 1}, file)
        files.write("x", {"moves": 2}, file)
        assert files.exists("x")
        assert files.read("x") == {"moves": 2}
        files.write("x", {"moves": 3}, file)
        files.erase("x", file)
        files.erase("x", file)
        assert files.read("x") is None
        await files.close()

    assert logged(script()) == []


def test_a_folder_that_cannot_be_written_is_told_once_for_each_axis_until_it_can_be(tmp_path: Path) -> None:
    obstacle = tmp_path / "state"
    obstacle.write_text("a file where the folder should be", "utf-8")

    async def script() -> None:
        files = LearnedFiles(obstacle)
        file = LearnedFile()
        for axis in ("x", "y", "x"):
            files.write(axis, {}, file)
        await asyncio.sleep(0.01)
        assert not files.exists("x")
        assert files.read("x") is None
        obstacle.unlink()
        files.write("x", {}, file)
        await asyncio.sleep(0.01)
        assert files.read("x") == {}
        await files.close()

    text = "what a law has learned cannot be written, and ends with the service"
    with structlog.testing.capture_logs() as logs:
        run(script())
    assert [(line["log_level"], line["event"], line["axis"]) for line in logs] == [
        ("warning", text, "x"), ("warning", text, "y"),
    ]  # fmt: skip


def test_what_cannot_be_erased_counts_as_erased_which_is_a_warning(tmp_path: Path) -> None:
    async def script() -> None:
        files = LearnedFiles(tmp_path)
        file = LearnedFile()
        files.path("x").mkdir()
        for _ in range(2):
            files.erase("x", file)
            assert await files.settled()
        assert not file.would_return
        assert file.error is not None
        assert file.error.endswith("and is not used any more: remove it")
        files.path("x").rmdir()
        files.write("x", {"moves": 1}, file)
        assert await files.settled()
        assert not file.error
        assert files.read("x") == {"moves": 1}
        await files.close()

    text = "what a law has learned cannot be erased, and is not used any more: remove the file"
    assert logged(script()) == [("warning", text)]


def test_what_would_be_used_again_is_an_error_until_it_is_erased(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nothing_can_be_changed(path: Path) -> None:
        raise OSError(f"{path} is on a read-only file system")

    async def script() -> None:
        files = LearnedFiles(tmp_path, nothing_written)
        file = LearnedFile()
        with monkeypatch.context() as patch:
            patch.setattr(learned_files, "erase_state", nothing_can_be_changed)
            files.erase("x", file)
            files.erase("x", file)
            files.write("x", {}, file)
            assert await files.settled()
            error, would_return = read_state_of(file)
            assert would_return
            assert str(error).endswith("and the next start of the service would use it: remove it before")
        files.erase("x", file)
        assert await files.settled()
        assert read_state_of(file) == (None, False)
        await files.close()

    def nothing_written(*_: object) -> None:
        raise OSError("read-only file system")

    text = "what a law has learned cannot be erased: remove the file before the service starts again"
    unwritten = "what a law has learned cannot be written, and ends with the service"
    assert logged(script()) == [("error", text), ("warning", unwritten)]


def test_without_a_thread_the_service_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def script() -> None:
        files = LearnedFiles(tmp_path)
        file = LearnedFile()

        def no_thread(*_: object) -> None:
            raise RuntimeError("can't start new thread")

        monkeypatch.setattr(asyncio.get_running_loop(), "run_in_executor", no_thread)
        files.write("x", {}, file)
        files.erase("x", file)
        await files.close()

    assert [level for level, _ in logged(script())] == ["warning", "error"]


def test_a_disk_that_hangs_keeps_no_service_from_ending(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learned_files, "_LONGEST_END_S", 0.0)
    goes_on = threading.Event()

    def hangs(*_: object) -> None:
        goes_on.wait(10.0)

    async def script() -> None:
        files = LearnedFiles(tmp_path, hangs)
        file = LearnedFile()
        files.start()
        files.write("x", {}, file)
        await files.close()

    with structlog.testing.capture_logs() as logs:
        asyncio.run(script())
    goes_on.set()
    assert [line["event"] for line in logs] == ["what a law has learned is not written: the disk does not respond"]


def test_in_real_time_a_thread_does_it_and_the_end_waits_for_it(tmp_path: Path) -> None:
    threads = []

    def write(path: Path, document: JsonObject) -> None:
        threads.append(threading.current_thread().name)
        path.write_text(str(document), "utf-8")

    async def script() -> None:
        files = LearnedFiles(tmp_path, write)
        file = LearnedFile()
        files.start()
        files.write("x", {"moves": 1}, file)
        await files.close()

    asyncio.run(script())
    assert threads == ["learned_files"]
    assert (tmp_path / "learned-x.json").read_text("utf-8") == "{'moves': 1}"
