"""A thread that asks for a jog again and again."""

import threading
from collections.abc import Callable

from twostage_servo.api.status import Status
from twostage_servo.client.errors import ServoError
from twostage_servo.client.verbs import JOG_INTERVAL_S, is_jogging, number_of


class JogThread:
    """Asks for a jog again and again, until it is told to end or something else has ended the jog.

    Parameters
    ----------
    begun
        The status as the jog has begun.
    again
        Asks for it once more, if it is still under way.
    """

    def __init__(self, begun: Status, again: Callable[[], Status]) -> None:
        self._status = begun
        self._again = again
        self._error: ServoError | None = None
        self._shall_end = threading.Event()
        self._thread = threading.Thread(target=self._renew, name="jog", daemon=True)
        self._thread.start()

    def _renew(self) -> None:
        number = number_of(self._status)
        while is_jogging(self._status, number) and not self._shall_end.wait(JOG_INTERVAL_S):
            try:
                self._status = self._again()
            except ServoError as error:
                self._error = error
                return

    def end(self) -> Status:
        """End, and return the newest status.

        Raises
        ------
        ServoError
            If the jog could not be asked for again.
        """
        self._shall_end.set()
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._status
