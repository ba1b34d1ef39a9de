"""Copies of the tree, and what is common to the runs of pytest in them."""

import os
import shutil
from pathlib import Path

from tools.mutation.limits import SPENT

TREE = Path(__file__).resolve().parents[2]
PYTEST = ["-p", "no:cacheprovider", "-p", "tools.mutation.limits", "-m", "not processes"]
PYTEST += [
    # It starts a process of another user, in which mutmut's own code cannot find what it needs.
    "--deselect=tests/service/test_control_socket.py::test_who_may_not_enter_the_folder_of_the_socket_is_told_so",
]


def copied(target: Path) -> Path:
    """Copy the tree without what git ignores."""
    ignore = shutil.ignore_patterns(
        ".git", ".venv", "__pycache__", "*.egg-info", ".*_cache", ".hypothesis", "build", "dist", "mutants"
    )
    shutil.copytree(TREE, target, ignore=ignore)
    return target


def environment(tree: Path, spent: Path) -> dict[str, str]:
    """Return the environment in which a tree's tests see that tree, and how long each of them may take."""
    return os.environ | {
        "CI": "1",
        "PYTHONPATH": os.pathsep.join([str(tree), str(TREE)]),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OPENBLAS_NUM_THREADS": "1",
        SPENT: str(spent),
    }
