"""A service with what is needed to look at it, and to ask it for something."""

from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

import structlog

from twostage_servo.api.fields import JsonObject
from twostage_servo.app.build import Parts, build_requests, build_service
from twostage_servo.axis.trips import TripFile
from twostage_servo.service.axis_loop import AxisLoop
from twostage_servo.service.control_socket import ControlSocket
from twostage_servo.service.reload import Change
from twostage_servo.service.runtime import Runtime
from twostage_servo.service.servo_service import Publisher, ServoService
from twostage_servo.telemetry.trip_files import Document, Records, TripFiles
from twostage_servo.timing.ticks import Tick


class ReplaceableTripFiles:
    """Trip files that may be given, and changed, while the service runs; at first there are none."""

    def __init__(self) -> None:
        self._files: TripFiles | None = None

    @property
    def files(self) -> TripFiles | None:
        """What writes them; None: the recordings of trips stay in memory only."""
        return self._files

    def use(self, files: TripFiles) -> None:
        """Let something write them from now on."""
        self._files = files

    def write(self, axis: str, code: str, document: Document, records: Records, file: TripFile) -> None:
        """Begin to write a file, if there is something to write it with."""
        if self._files is not None:
            self._files.write(axis, code, document, records, file)

    def fail(self, axis: str, code: str, error: BaseException, file: TripFile) -> None:
        """Tell that a file could not be written."""
        if self._files is not None:
            self._files.fail(axis, code, error, file)
        else:
            text = "no recording of the trip: out of memory"
            structlog.get_logger().error(text, axis=axis, code=code)


class ServiceHarness:
    """A service with what is needed to look at it and to ask it for something; it does not run by itself.

    Parameters
    ----------
    parts, runtime
        What the service consists of, and what surrounds it.
    prepare_reload
        Reads the configuration again; None where there is none to read.
    publishers
        Are told of each tick.
    make_service
        Makes the service of what :class:`~twostage_servo.service.servo_service.ServoService` takes.

    Attributes
    ----------
    parts
        As given.
    requests
        Carries out requests.
    service
        The service.
    trip_files
        Writes a file for each trip, as soon as it is given something to write it with.
    """

    def __init__(
        self,
        parts: Parts,
        runtime: Runtime,
        prepare_reload: Callable[[], Awaitable[Change]] | None = None,
        publishers: Sequence[Publisher] = (),
        make_service: Callable[..., ServoService] = ServoService,
    ) -> None:
        self.parts = parts
        self.trip_files = ReplaceableTripFiles()
        self.requests = build_requests(parts, runtime, prepare_reload)
        self._publishers = list(publishers)
        snapshot = self.requests.status.report.snapshot_of
        self.service = build_service(parts, runtime, snapshot, self.trip_files, (self._publish,), make_service)

    def listen(self, publisher: Publisher) -> None:
        """Tell somebody of each tick from now on."""
        self._publishers.append(publisher)

    def axis_loop(self, name: str | None = None) -> AxisLoop:
        """Return the axis of a name; without one, the only axis."""
        return self.parts.axis_loop(name)

    def snapshot(self) -> JsonObject:
        """Return the state of service and axes, ready for JSON."""
        return self.requests.status.report.snapshot()

    def control_socket(self, path: Path) -> ControlSocket:
        """Return a control socket, which has yet to be started, and is told of each tick from now on."""
        parts = self.parts
        control = ControlSocket(path, self.requests, parts.background, parts.names, parts.shutdown.fail)
        self.listen(control.publish)
        return control

    def _publish(self, tick: Tick) -> None:
        for publish in self._publishers:
            publish(tick)
