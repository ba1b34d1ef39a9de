"""What the real-time settings need of kernel and interpreter, in one place, so that a test can stand in for them."""

import ctypes
import errno
import os
import platform
import resource
import struct
import sys
from pathlib import Path
from typing import Final

_PR_SET_TIMERSLACK: Final = 29  # linux/prctl.h
_PR_GET_TIMERSLACK: Final = 30
_MCL_CURRENT_AND_FUTURE: Final = 3  # linux/mman.h
_SCHED_SETATTR_GETATTR: Final = {"x86_64": (314, 315), "aarch64": (274, 275), "riscv64": (274, 275)}
"""Numbers of the two system calls, for which glibc has functions from 2.41 on only; of the kernel's syscall tables."""
_SCHED_ATTR: Final = struct.Struct("=IIQiIQQQ")
"""size, policy, flags, nice, priority, runtime, deadline, period: linux/sched/types.h, first version."""
_M_TRIM_THRESHOLD: Final = -1  # malloc.h of glibc
_M_MMAP_MAX: Final = -4

HEAP_BYTES: Final = 8 << 20
STACK_BYTES: Final = 256 << 10
"""What is faulted in beforehand: more than the loop has ever been seen to take after its start."""

CAP_IPC_LOCK: Final = 14  # linux/capability.h
CAP_SYS_NICE: Final = 23


class Kernel:
    """The kernel of this host; each method raises OSError where it refuses.

    Parameters
    ----------
    proc
        Where procfs is.
    """

    def __init__(self, proc: Path = Path("/proc")) -> None:
        self._proc = proc
        self._libc = ctypes.CDLL(None, use_errno=True)

    def set_fifo(self, priority: int) -> None:
        """Schedule this thread first in, first out. Threads and processes that it starts do not inherit that."""
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))

    def scheduling(self) -> tuple[bool, int]:
        """Return whether this thread is scheduled first in, first out, and its priority."""
        policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
        return policy == os.SCHED_FIFO, os.sched_getparam(0).sched_priority

    def set_time_slice(self, slice_ns: int) -> None:
        """Ask for a time slice of this thread under time-sharing, ns: the shorter it is, the sooner it gets its turn.

        Linux takes it from 6.12 on, between 0.1 and 100 ms, and takes no notice of it before.
        """
        set_number, _ = self._sched_attr_numbers()
        size, policy, flags, nice, priority, _, deadline, period = _SCHED_ATTR.unpack(self._scheduling_attributes())
        attributes = _SCHED_ATTR.pack(size, policy, flags, nice, priority, slice_ns, deadline, period)
        self._check(self._libc.syscall(set_number, 0, attributes, 0))

    def time_slice(self) -> int:
        """Return the time slice of this thread under time-sharing, ns; 0 where the kernel does not say, before 6.12."""
        return int(_SCHED_ATTR.unpack(self._scheduling_attributes())[5])

    def _scheduling_attributes(self) -> bytes:
        _, get_number = self._sched_attr_numbers()
        buffer = ctypes.create_string_buffer(_SCHED_ATTR.size)
        self._check(self._libc.syscall(get_number, 0, buffer, _SCHED_ATTR.size, 0))
        return buffer.raw

    def _sched_attr_numbers(self) -> tuple[int, int]:
        try:
            return _SCHED_SETATTR_GETATTR[platform.machine()]
        except KeyError:
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS)) from None

    def set_cpus(self, cpus: set[int]) -> None:
        """Let this thread, and those that it starts from now on, run on these CPUs alone."""
        os.sched_setaffinity(0, cpus)

    def cpus(self) -> set[int]:
        """Return the CPUs that this thread may run on."""
        return os.sched_getaffinity(0)

    def set_timer_slack(self, slack_ns: int) -> None:
        """Set by how much the kernel may put a wake-up of this thread off, ns."""
        self._check(self._libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(slack_ns), 0, 0, 0))

    def timer_slack(self) -> int:
        """Return by how much the kernel may put a wake-up of this thread off, ns."""
        return int(self._check(self._libc.prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)))

    def set_switch_interval(self, interval_s: float) -> None:
        """Set for how long another thread of this process may go on in Python while the loop's waits, s."""
        sys.setswitchinterval(interval_s)

    def switch_interval(self) -> float:
        """Return for how long another thread of this process may go on in Python while the loop's waits, s."""
        return sys.getswitchinterval()

    def lock_memory(self) -> None:
        """Lock all pages of the process, those to come included, and keep what malloc has been given."""
        self._check(self._libc.mlockall(_MCL_CURRENT_AND_FUTURE))
        if hasattr(self._libc, "mallopt"):  # glibc: never give memory back, and never take it as a mapping of its own
            self._libc.mallopt(_M_TRIM_THRESHOLD, -1)
            self._libc.mallopt(_M_MMAP_MAX, 0)

    def prefault(self) -> None:
        """Touch heap and stack that will be needed, so that no tick takes those page faults."""
        heap = ctypes.create_string_buffer(HEAP_BYTES)  # comes zeroed, so every page of it has been written
        ctypes.memset(heap, 1, HEAP_BYTES)
        del heap
        # An argument passed by value lies on the stack; getpid does not look at it.
        getpid = ctypes.CDLL(None).getpid
        getpid.argtypes = [_StackBlock]
        getpid(_StackBlock())

    def status_kib(self, name: str) -> int:
        """Return a size in ``/proc/self/status``, such as VmSize or VmLck, KiB; 0 where it is not told."""
        return int((self.status(name).split() or ["0"])[0])

    def status(self, name: str) -> str:
        """Return a field of ``/proc/self/status``; empty where it is not there."""
        try:
            lines = (self._proc / "self" / "status").read_text("utf-8").splitlines()
        except OSError:
            return ""
        return next((line.partition(":")[2].strip() for line in lines if line.startswith(f"{name}:")), "")

    def has_capability(self, number: int) -> bool:
        """Whether the process has a capability in effect."""
        return bool(int(self.status("CapEff") or "0", 16) >> number & 1)

    def limit(self, number: int) -> int | None:
        """Return a soft resource limit of the process, such as ``resource.RLIMIT_MEMLOCK``; None for no limit."""
        soft, _ = resource.getrlimit(number)
        return None if soft == resource.RLIM_INFINITY else soft

    def _check(self, result: int) -> int:
        if result < 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        return result


class _StackBlock(ctypes.Structure):
    _fields_ = [("bytes", ctypes.c_char * STACK_BYTES)]
