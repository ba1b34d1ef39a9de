"""Fuzz the codec of frames, held to cantools, guided by coverage: `python tools/fuzz/atheris_codec.py --seconds 60`."""

import os
import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from fuzz.coverage_guided import fuzz  # noqa: E402 - found by the path above

if __name__ == "__main__":
    fuzz("CodecTarget", __doc__)
