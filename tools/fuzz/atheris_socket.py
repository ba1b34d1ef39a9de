"""Fuzz the control socket's lines, guided by coverage: `python tools/fuzz/atheris_socket.py --seconds 60`."""

import os
import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from fuzz.coverage_guided import fuzz  # noqa: E402 - found by the path above

if __name__ == "__main__":
    fuzz("SocketTarget", __doc__)
