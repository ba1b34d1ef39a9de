"""The text of the shipped `demo.toml`, for tests that change it."""

import re

from twostage_servo.config.files import shipped_configuration

DEMO = shipped_configuration("demo.toml").read_text(encoding="utf-8")


def _law() -> str:
    found = re.search(r"^\[axis\.law\]\ntype = [^\n]*\n", DEMO, re.MULTILINE)
    assert found is not None
    return found.group()


LAW_OF_THE_DEMO = _law()
"""The head of its table ``[axis.law]`` and the law's type."""
