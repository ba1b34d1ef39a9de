"""What the Debian package says of itself: what it needs, and under which licences its parts are."""

import platform
import re
from collections.abc import Sequence
from importlib.metadata import Distribution
from typing import Final

NAME: Final = "twostage-servo"
_MAINTAINER: Final = f"The maintainers of {NAME} <maintainers@{NAME}.invalid>"
_MANYLINUX: Final = {"manylinux1": (2, 5), "manylinux2010": (2, 12), "manylinux2014": (2, 17)}
"""The oldest C library of the tags that do not say it."""
_DESCRIPTION: Final = """\
 Closes a position loop over a CAN bus on a fixed tick, without a speed
 sensor: a Kalman filter estimates velocity and disturbance.
 .
 The package starts nothing by itself and enables no drive. It brings systemd's
 units, a network file and a udev rule for CAN interfaces, and the group of
 those who may command the axes. Everything that is not from Debian lies below
 /opt/twostage-servo.
"""


def control_text(build: str, architecture: str, python: tuple[int, int], libc: tuple[int, int], size_kib: int) -> str:
    """Return the package's control file.

    Parameters
    ----------
    build
        The package's version.
    architecture
        As Debian calls it.
    python
        What the environment was made with; byte code and extensions fit no other.
    libc
        Version of the C library that the extensions need at least.
    size_kib
        Of what it installs, KiB.
    """
    major, minor = python
    needs = (
        f"python3 (>= {major}.{minor})", f"python3 (<< {major}.{minor + 1})", "libc6 (>= {}.{})".format(*libc),
        "libstdc++6", "systemd", "udev",
    )  # fmt: skip
    return (
        f"Package: {NAME}\nVersion: {build}\nArchitecture: {architecture}\nMaintainer: {_MAINTAINER}\n"
        f"Installed-Size: {size_kib}\nDepends: {', '.join(needs)}\nSection: misc\nPriority: optional\n"
        f"Description: two-stage servo controller over CAN\n{_DESCRIPTION}"
    )


def oldest_libc(packages: Sequence[Distribution]) -> tuple[int, int]:
    """Return the oldest C library that all packages run with, by the tags of their wheels.

    A wheel that was compiled here has no such tag, and needs what is here.
    """
    here = re.findall(r"\d+", platform.libc_ver()[1])
    needed = (2, 17)
    for package in packages:
        tags = re.findall(r"^Tag: \S+-(\w+)$", package.read_text("WHEEL") or "", re.MULTILINE)
        versions = [_MANYLINUX[old] for tag in tags if (old := tag.partition("_")[0]) in _MANYLINUX]
        told = (re.match(r"manylinux_(\d+)_(\d+)", tag) for tag in tags)
        versions += [(int(found[1]), int(found[2])) for found in told if found]
        if versions:
            needed = max(needed, min(versions))
        elif any("linux" in tag for tag in tags):
            needed = max(needed, (int(here[0]), int(here[1])))
    return needed


def copyright_text(packages: Sequence[Distribution]) -> str:
    """Return the package's copyright file: its own licence, and where those of the others are."""
    lines = [
        "Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/",
        f"Upstream-Name: {NAME}",
        "Comment: The files of each package below /opt/twostage-servo/lib are under its own licence, whose text is in",
        " its folder NAME-VERSION.dist-info there:",
        *(f" {one.name} {one.version}: {_licence(one)}" for one in packages if one.name != NAME),
        "",
        "Files: *",
        f"Copyright: the authors of {NAME}",
        "License: Apache-2.0",
        " On Debian systems the full text is in /usr/share/common-licenses/Apache-2.0.",
    ]
    return "\n".join(lines) + "\n"


def _licence(package: Distribution) -> str:
    data = package.metadata
    classified = [one.rpartition(" :: ")[2] for one in data.get_all("Classifier") or () if one.startswith("License ::")]
    expressed, called = ((data.get_all(key) or [""])[0] for key in ("License-Expression", "License"))
    return expressed or ", ".join(classified) or called.partition("\n")[0] or "see there"
