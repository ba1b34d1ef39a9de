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
from twostage_servo.telemetry.learned_files import LearnedFiles
from twostage_servo.timing.virtual_clock import run


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
        assert not files.exists("x")
        files.write("x", {"moves": 1})
        files.write("x", {"moves": 2})
        assert files.exists("x")
        assert files.read("x") == {"moves": 2}
        files.write("x", {"moves": 3})
        files.erase("x")
        files.erase("x")
        assert files.read("x") is None
        await files.close()

    assert logged(script()) == []


def test_a_folder_that_cannot_be_written_is_told_once_for_each_axis_until_it_can_be(tmp_path: Path) -> None:
    obstacle = tmp_path / "state"
    obstacle.write_text("a file where the folder should be", "utf-8")

    async def script() -> None:
        files = LearnedFiles(obstacle)
        for axis in ("x", "y", "x"):
            files.write(axis, {})
        await asyncio.sleep(0.01)
        assert not files.exists("x")
        assert files.read("x") is None
        obstacle.unlink()
        files.write("x", {})
        await asyncio.sleep(0.01)
        assert files.read("x") == {}
        await files.close()

    text = "what a law has learned cannot be written, and ends with the service"
    with structlog.testing.capture_logs() as logs:
        run(script())
    assert [(line["log_level"], line["event"], line["axis"]) for line in logs] == [
        ("warning", text, "x"), ("warning", text, "y"),
    ]  # fmt: skip


def test_what_cannot_be_erased_is_an_error_since_it_would_come_back(tmp_path: Path) -> None:
    async def script() -> None:
        files = LearnedFiles(tmp_path)
        files.path("x").mkdir()
        files.erase("x")
        await files.close()

    ((level, event),) = logged(script())
    assert level == "error"
    assert "remove the file before the service starts again" in event


def test_without_a_thread_the_service_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def script() -> None:
        files = LearnedFiles(tmp_path)

        def no_thread(*_: object) -> None:
            raise RuntimeError("can't start new thread")

        monkeypatch.setattr(asyncio.get_running_loop(), "run_in_executor", no_thread)
        files.write("x", {})
        files.erase("x")
        await files.close()

    assert [level for level, _ in logged(script())] == ["warning", "error"]


def test_a_disk_that_hangs_keeps_no_service_from_ending(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learned_files, "_LONGEST_END_S", 0.0)
    goes_on = threading.Event()

    def hangs(*_: object) -> None:
        goes_on.wait(10.0)

    async def script() -> None:
        files = LearnedFiles(tmp_path, hangs)
        files.start()
        files.write("x", {})
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
        files.start()
        files.write("x", {"moves": 1})
        await files.close()

    asyncio.run(script())
    assert threads == ["learned_files"]
    assert (tmp_path / "learned-x.json").read_text("utf-8") == "{'moves': 1}"
