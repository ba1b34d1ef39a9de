"""What one episode of fuzzing gives."""

from dataclasses import dataclass, field


class Failed(AssertionError):  # noqa: N818 - not an error of this program: a finding
    """A property that does not hold."""


@dataclass
class Outcome:
    """Cases that were tried, and what became of them by name.

    Attributes
    ----------
    cases
        How many.
    counts
        How often each thing happened.
    findings
        Inputs that broke a property, with what broke; for fuzzers that go on after one.
    """

    cases: int
    counts: dict[str, int] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)
