"""A kernel that grants or refuses, and files of a host, for the tests."""

import errno
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from twostage_servo.host.findings import Host
from twostage_servo.host.kernel import Kernel


class FakeKernel(Kernel):
    """Grants everything but what is in `refused`."""

    def __init__(
        self,
        refused: Sequence[str] = (),
        capabilities: Sequence[int] = (),
        limit: int | None = None,
        online: Sequence[int] = (0, 1, 2, 3),
    ) -> None:
        super().__init__()
        self.refused = refused
        self.capabilities = capabilities
        self.soft_limit = limit
        self.allowed = set(online)
        self.fifo = 0
        self.slack_ns = 50_000
        self.slice_ns = 0
        self.interval_s = 5e-3
        self.locked = False
        self.prefaulted = False

    def _grant(self, what: str) -> None:
        if what in self.refused:
            raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    def set_fifo(self, priority: int) -> None:
        self._grant("fifo")
        self.fifo = priority

    def scheduling(self) -> tuple[bool, int]:
        return self.fifo > 0, self.fifo

    def set_cpus(self, cpus: set[int]) -> None:
        self._grant("cpus")
        self.allowed &= cpus

    def cpus(self) -> set[int]:
        return self.allowed

    def set_timer_slack(self, slack_ns: int) -> None:
        self._grant("slack")
        self.slack_ns = slack_ns

    def timer_slack(self) -> int:
        self._grant("slack read")
        return self.slack_ns

    def set_time_slice(self, slice_ns: int) -> None:
        self._grant("slice")
        self.slice_ns = slice_ns

    def time_slice(self) -> int:
        self._grant("slice")
        return self.slice_ns

    def set_switch_interval(self, interval_s: float) -> None:
        self.interval_s = interval_s

    def switch_interval(self) -> float:
        return self.interval_s

    def lock_memory(self) -> None:
        self._grant("memory")
        self.locked = True

    def prefault(self) -> None:
        self.prefaulted = True

    def status_kib(self, name: str) -> int:
        return {"VmSize": 100_000, "VmLck": 100_000 if self.locked else 0}[name]

    def has_capability(self, number: int) -> bool:
        return number in self.capabilities

    def limit(self, number: int) -> int | None:
        return self.soft_limit


def fake_host(folder: Path, files: dict[str, str], run: Callable[[Sequence[str]], str] | None = None) -> Host:
    """A host with these files below ``sys`` and ``proc``, and no program at all unless `run` is given."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return Host(folder / "sys", folder / "proc", run or not_installed)


def not_installed(arguments: Sequence[str]) -> str:
    raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), arguments[0])
