"""What each contender needs, and how to get it where it is missing."""

import importlib.util
import shutil
import sysconfig
from pathlib import Path
from typing import Final

_MODULES: Final = {
    "soft_realtime_loop": ("NeuroLocoMiddleware", "pip install NeuroLocoMiddleware"),
    "canopen_sync": ("canopen", "pip install canopen"),
    "filterpy": ("filterpy", "pip install filterpy"),
    "python_control": ("control", "pip install control"),
}


def what_is_missing(contender: str) -> str | None:
    """Return why a contender cannot take part, with the line that installs what it needs; None if it can."""
    if contender == "cyclictest" and shutil.which("cyclictest") is None:
        return "cyclictest is not installed: apt install rt-tests"
    if contender.split("_", maxsplit=1)[0] == "c":
        return _what_a_compiler_lacks()
    module, line = _MODULES.get(contender, ("", ""))
    if module and importlib.util.find_spec(module) is None:
        return f"the package {module} is not installed: {line}"
    return None


def _what_a_compiler_lacks() -> str | None:
    if shutil.which("cc") is None:
        return "there is no C compiler: apt install gcc"
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        return "Python.h is missing: apt install python3-dev"
    return None
