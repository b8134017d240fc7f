"""range_libc, compiled from a copy of its sources that the variable RANGE_LIBC names; for baselines.py."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from gpusense.evaluation.benchmark.runner import LeftOutError

SOURCE = "RANGE_LIBC"
CODE = Path(__file__).resolve().parents[1] / "accuracy" / "peer_code" / "range_libc.cpp"
KINDS = ("BL", "RM", "CDDT", "PCDDT", "GLT")
# range_libc's release options.
_FLAGS = ("-w", "-std=c++11", "-march=native", "-ffast-math", "-fno-math-errno", "-O3", "-fPIC", "-shared")
# Rays of the look-up table, of one thread: at some millions a second.
_MOST_RAYS = 100_000_000
_kept: list[tempfile.TemporaryDirectory[str]] = []


def load() -> tuple[ctypes.CDLL | None, str]:
    """Compile range_libc; return the library, or the reason where it fails."""
    source = os.environ.get(SOURCE, "")
    if not source:
        return None, f"not compiled: {SOURCE} must name a copy of its sources"
    _kept.append(tempfile.TemporaryDirectory())
    library = Path(_kept[-1].name) / "range_libc.so"
    # lodepng is a header and a source.
    sources = [str(CODE), str(Path(source) / "vendor" / "lodepng" / "lodepng.cpp")]
    command = ["g++", *_FLAGS, f"-I{source}", "-DUSE_CUDA=0", "-o", str(library), *sources]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()
        return None, f"not compiled: {reason[0] if reason else error}"
    loaded = ctypes.CDLL(str(library))
    loaded.make.restype = ctypes.c_void_p
    return loaded, ""


class Caster:
    """A caster of range_libc on a map in cells.

    Attributes:
        table_bytes: Size of its tables where it is known, otherwise 0.
    """

    def __init__(self, library: ctypes.CDLL, kind: str, occupied: np.ndarray, range_max: float, bins: int) -> None:
        rows, cols = occupied.shape
        if kind == "GLT" and rows * cols * bins > _MOST_RAYS:
            raise LeftOutError(f"its table of {rows * cols * bins:.1e} rays would take too long on one thread")
        self._library, self._kind = library, KINDS.index(kind)
        cells = np.ascontiguousarray(occupied, np.uint8)
        self.table_bytes = 2 * rows * cols * bins if kind == "GLT" else 0
        # It prints while it builds tables.
        sys.stdout.flush()
        with open(os.devnull, "w") as silent:
            shown = os.dup(1)
            os.dup2(silent.fileno(), 1)
            try:
                self._caster = ctypes.c_void_p(
                    library.make(self._kind, _pointer(cells), cols, rows, ctypes.c_float(range_max), bins)
                )
            finally:
                os.dup2(shown, 1)
                os.close(shown)

    def cast(self, poses: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Return (N, K) ranges of (N, 3) poses, all in cells."""
        placed, turned = np.ascontiguousarray(poses, np.float32), np.ascontiguousarray(angles, np.float32)
        found = np.empty((len(placed), len(turned)), np.float32)
        self._library.cast(
            self._kind, self._caster, _pointer(placed), ctypes.c_long(len(placed)), _pointer(turned),
            ctypes.c_long(len(turned)), _pointer(found),
        )  # fmt: skip
        return found

    def __del__(self) -> None:
        if hasattr(self, "_caster"):
            self._library.destroy(self._kind, self._caster)


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
