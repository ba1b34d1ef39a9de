"""Numbers in texts, with as many digits as it takes to tell them from their bound."""


def exact(value: float) -> str:
    """Return a number as short as it can be written without becoming another one: 2500.0000001 is not 2500."""
    short = f"{value:g}"
    return short if float(short) == value or value != value else repr(value)  # noqa: PLR0124 - NaN is shown as such
