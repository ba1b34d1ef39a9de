from pathlib import Path

import pytest

from twostage_servo.canbus.profile import DriveProfile, ProtocolSettings


@pytest.fixture(scope="session")
def profile() -> DriveProfile:
    """Protocol of the shipped DBC."""
    return DriveProfile.compile(ProtocolSettings(), Path(), "mm")
