from pathlib import Path

import pytest

from twostage_servo.drives.dbc.profile import DriveProfile
from twostage_servo.drives.dbc.settings import ProtocolSettings


@pytest.fixture(scope="session")
def profile() -> DriveProfile:
    """Protocol of the shipped DBC."""
    return DriveProfile.compile(ProtocolSettings(), Path(), "mm")
