"""What is counted on a bus."""

from dataclasses import dataclass, field


@dataclass(slots=True)
class LinkCounters:
    """What went over a link since it was made, over all its openings.

    Attributes
    ----------
    received : int
        Frames with an accepted identifier.
    sent : int
        Frames handed over to the interface.
    rejected : int
        Received frames that could not be used; counted by whoever decodes them, with :meth:`count_rejection`.
    dropped : int
        Frames not sent because the queue was full, or an older frame still in it.
    errors : int
        Error frames: the controller reports trouble on the bus.
    errors_by_kind : dict of str to int
        The error frames by what they say about the controller: ``"warning"``, ``"passive"``, ``"active"``,
        ``"bus_off"``, ``"restarted"``; ``"other"`` is trouble on the bus, or an interface whose error frames carry no
        more than that.
    overflowed : int
        Received frames that the kernel has thrown away because nobody read them in time; known with SocketCAN only.
    overruns : int
        Drains that ended at their bound. One after another, they mean that frames pile up and are read late.
    rejected_by_reason : dict of str to int
        The rejected frames by :attr:`FrameRejected.reason`.
    """

    received: int = 0
    sent: int = 0
    rejected: int = 0
    dropped: int = 0
    errors: int = 0
    overflowed: int = 0
    overruns: int = 0
    errors_by_kind: dict[str, int] = field(default_factory=dict)
    rejected_by_reason: dict[str, int] = field(default_factory=dict)

    def count_rejection(self, reason: str) -> None:
        """Count a frame that could not be used."""
        self.rejected += 1
        self.rejected_by_reason[reason] = self.rejected_by_reason.get(reason, 0) + 1

    def count_error(self, kind: str) -> None:
        """Count an error frame."""
        self.errors += 1
        self.errors_by_kind[kind] = self.errors_by_kind.get(kind, 0) + 1
