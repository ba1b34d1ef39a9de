"""A drive whose frames a DBC file describes, from its own end: for the simulated drive."""

from twostage_servo.axis.messages import Command, Feedback, Heartbeat, IndexMark
from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.frame import ReceivedFrame, SentFrame


class DbcDriveSide:
    """A :class:`~twostage_servo.drives.drive.DriveSide`, made from a compiled profile.

    Parameters
    ----------
    profile
        The compiled frames.

    Attributes
    ----------
    identifiers, has_heartbeat, has_index
        As in :class:`~twostage_servo.drives.drive.DriveSide`.
    """

    def __init__(self, profile: DriveProfile) -> None:
        self._profile = profile
        self.identifiers = (profile.command_id,)
        self.has_heartbeat = profile.heartbeat_id is not None
        self.has_index = profile.index_id is not None

    def decode(self, frame: ReceivedFrame) -> Command:
        """Read a command; an effort beyond the range of its signal is rejected.

        Raises
        ------
        FrameRejected
            If the frame must not be used.
        """
        return self._profile.decode_command(frame)

    def answers(self) -> tuple[SentFrame, ...]:
        """Return nothing: such a drive takes commands alone."""
        return ()

    def feedback(self, feedback: Feedback) -> tuple[SentFrame]:
        """Make the frame of a feedback; see :meth:`DriveProfile.encode_feedback`."""
        return (SentFrame(self._profile.feedback_id, self._profile.encode_feedback(feedback)),)

    def index(self, mark: IndexMark) -> tuple[SentFrame, ...]:
        """Make the frame of an index mark; none where the drive has no such message."""
        identifier = self._profile.index_id
        return () if identifier is None else (SentFrame(identifier, self._profile.encode_index(mark)),)

    def heartbeat(self, heartbeat: Heartbeat) -> tuple[SentFrame, ...]:
        """Make the frame of a heartbeat; none where the drive has none."""
        identifier = self._profile.heartbeat_id
        return () if identifier is None else (SentFrame(identifier, self._profile.encode_heartbeat(heartbeat)),)
