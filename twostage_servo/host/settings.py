"""The table ``[realtime]``: what the service asks of its host."""

from typing import ClassVar, Literal

from pydantic import Field, field_validator

from twostage_servo.settings.base import Settings, quantity


class RealtimeSettings(Settings):
    """Punctual ticks: busy-wait, scheduling, memory, garbage collection."""

    renamed: ClassVar = {"spin": "busy_wait", "send_at": "output_offset"}

    busy_wait: Literal["off", "auto"] | float = quantity(
        "auto",
        unit="µs",
        description="How long before a tick to wake up and busy-wait: off, auto (from the host), or up to 1000 µs",
        union_mode="left_to_right",
    )
    output_offset: Literal["off", "auto"] | float = quantity(
        "auto",
        unit="µs",
        description="How long after the deadline of a tick its commands are sent, for even intervals: "
        "off (as soon as they are ready), auto (adapts; off if busy_wait is off), or up to 1000 µs",
        union_mode="left_to_right",
    )
    priority: int = quantity(
        0,
        unit="1",
        description="SCHED_FIFO priority of the loop's thread; 0 keeps the scheduling unchanged",
        ge=0,
        le=99,
    )
    cpus: list[int] = Field(
        default_factory=list,
        description="CPUs that the service may run on; empty keeps them unchanged",
        max_length=1024,
    )
    lock_memory: bool = Field(False, description="Keep the whole process in memory, so that no tick waits for the disk")
    collect_garbage: Literal["between_ticks", "python"] = Field(
        "between_ticks",
        description="When Python collects cyclic garbage: in the idle time after a tick, or at any time",
    )

    @field_validator("busy_wait", "output_offset")
    @classmethod
    def _is_a_share_of_a_tick(cls, time_us: str | float) -> str | float:
        if not isinstance(time_us, str) and not 0.0 <= time_us <= 1000.0:
            raise ValueError('"off", "auto", or a number of µs from 0 to 1000 is needed')
        return time_us

    @field_validator("cpus")
    @classmethod
    def _are_numbers_of_cpus(cls, cpus: list[int]) -> list[int]:
        if any(not 0 <= cpu <= 8191 for cpu in cpus):
            raise ValueError("name a CPU by its number, 0 or greater, as in /proc/cpuinfo")
        if len(set(cpus)) < len(cpus):
            raise ValueError("a CPU is named twice; name each once")
        return sorted(cpus)
