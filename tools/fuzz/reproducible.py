"""Random numbers that follow from a name."""

import random


def reproducible(*name: object) -> random.Random:
    """Return a generator that gives the same numbers for the same name."""
    return random.Random(" ".join(map(str, name)))  # noqa: S311 - to be foreseen is what it is for
