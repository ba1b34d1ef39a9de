"""Fuzz the control socket's lines, guided by coverage: `python -m tools.fuzz.atheris_socket --seconds 60`."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tools.fuzz.coverage_guided import fuzz

if __name__ == "__main__":
    fuzz("SocketTarget", __doc__)
