"""What some verbs need beyond what every installation has, and how to install it."""

from importlib.util import find_spec
from typing import Final

from twostage_servo.cli.output import CommandError, ExitCode

MODULES: Final = {"paper": ("latex2mathml",), "multicast": ("msgpack",)}
"""Modules that an extra of the package brings, as pyproject.toml has them."""


def require(extra: str, what: str) -> None:
    """Refuse what needs an extra that is not installed, before any work is done.

    Parameters
    ----------
    extra
        Name of the extra.
    what
        What needs it, for the operator.

    Raises
    ------
    CommandError
        As bad usage, with the line that installs it.
    """
    missing = [module for module in MODULES[extra] if find_spec(module) is None]
    if missing:
        text = f"{what} needs {', '.join(missing)}, not installed here: pip install 'twostage-servo[{extra}]'"
        raise CommandError(ExitCode.USAGE, "not_installed", text, {"extra": extra, "missing": missing})
