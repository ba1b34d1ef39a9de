"""Two-stage servo control over CAN for Linux.

``connect()`` and ``connect_async()`` are clients of a running service, in the standard library alone.
"""

from typing import TYPE_CHECKING

from twostage_servo.version import __version__

if TYPE_CHECKING:
    from twostage_servo.api.status import Status
    from twostage_servo.client.asynchronous import AsyncServoClient, connect_async
    from twostage_servo.client.blocking import ServoClient, connect
    from twostage_servo.client.errors import (
        ConfigError,
        Interrupted,
        Refused,
        ServoError,
        TimedOut,
        Tripped,
        Unreachable,
    )

__all__ = [
    "AsyncServoClient",
    "ConfigError",
    "Interrupted",
    "Refused",
    "ServoClient",
    "ServoError",
    "Status",
    "TimedOut",
    "Tripped",
    "Unreachable",
    "__version__",
    "connect",
    "connect_async",
]

_HOMES = {
    "AsyncServoClient": "client.asynchronous",
    "connect_async": "client.asynchronous",
    "ServoClient": "client.blocking",
    "connect": "client.blocking",
    "Status": "api.status",
}
"""Where the public names are; those of no mention are errors."""


def __getattr__(name: str) -> object:
    """Import a public name when it is first used: the command line must start without a client."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib  # noqa: PLC0415

    module = importlib.import_module(f"twostage_servo.{_HOMES.get(name, 'client.errors')}")
    value = globals()[name] = getattr(module, name)
    return value
