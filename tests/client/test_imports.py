"""What importing the public client loads, and what it exports."""

import subprocess
import sys
from pathlib import Path

import pytest

import twostage_servo
from twostage_servo.client import errors

HEAVY = {"numpy", "scipy", "can", "cantools", "pydantic", "structlog", "asyncio", "control", "matplotlib"}


@pytest.mark.parametrize(("name", "may_load"), [("connect", set()), ("connect_async", {"asyncio"})])
def test_a_client_starts_without_heavy_imports(name: str, may_load: set[str], tmp_path: Path) -> None:
    script = f"import sys, twostage_servo; twostage_servo.{name}; print(*sys.modules)"
    finished = subprocess.run(  # noqa: S603 - our own interpreter and text
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60
    )
    loaded = {module.partition(".")[0] for module in finished.stdout.split()}
    assert "twostage_servo" in loaded
    assert loaded & HEAVY == may_load


def test_every_public_name_is_there_and_no_other() -> None:
    for name in twostage_servo.__all__:
        assert getattr(twostage_servo, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'fly'"):
        _ = twostage_servo.fly


def test_the_tree_of_errors_is_drawn_as_it_is() -> None:
    drawn = set((twostage_servo.ServoError.__doc__ or "").split())
    kinds = {kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, errors.ServoError)}
    assert {kind.__name__ for kind in kinds} <= drawn
    assert {kind.__name__ for kind in kinds} <= set(twostage_servo.__all__)
