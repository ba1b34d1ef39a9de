"""Numbers as an operator types them: plain decimal ones, since what looks like a slip must not move an axis."""

import argparse
import re
from typing import Final

_WHOLE: Final = re.compile(r"[+-]?[0-9]+")
_DECIMAL: Final = re.compile(
    r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?(inf|infinity|nan)", re.IGNORECASE
)
"""Also what is not finite, which each verb refuses in its own words."""


def decimal(text: str) -> float:
    """Return a number: Python alone would take 1_0 for 10, and the digits of any script.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is none.
    """
    if not _DECIMAL.fullmatch(text.strip(" ")):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number such as 400, -12.5 or 1e3")
    return float(text)


def whole(text: str) -> int:
    """Return a whole number, likewise.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is none.
    """
    if not _WHOLE.fullmatch(text.strip(" ")):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number such as 10")
    try:
        return int(text)
    except ValueError as error:  # of thousands of digits
        raise argparse.ArgumentTypeError("the number has too many digits") from error
