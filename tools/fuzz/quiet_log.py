"""The service's log while it is fuzzed."""

import logging

import structlog


def quiet_log() -> None:
    """Let the service's log be formatted as by default, and go nowhere."""
    structlog.configure(
        processors=[structlog.processors.add_log_level, structlog.processors.JSONRenderer()],
        wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        logger_factory=lambda *_: _Nowhere(),
        cache_logger_on_first_use=False,
    )


class _Nowhere:
    def msg(self, line: str) -> None:
        """Discard a line."""

    log = debug = info = warning = error = critical = msg
