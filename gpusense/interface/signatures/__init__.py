"""One row per kernel: file, launch shape and arguments in order. Every backend binds arguments by this table.

A kernel has three bodies (NumPy reference, OpenCL, Warp) with the same name and the same arguments; a test compares
them with this table. ``real`` is the precision of a model, float32 or float64; ``double`` is always float64, and
``coordinate`` (poses) and ``measured`` (readings) are float64, or float32 with POSES_FLOAT32 and RANGES_FLOAT32.
"""

from __future__ import annotations

from gpusense.interface.signatures import matching_kernels, point_kernels, scan_kernels
from gpusense.interface.signatures.rows import LANES, Argument, Kernel, lanes_of, team_of

__all__ = ["KERNELS", "LANES", "Argument", "Kernel", "lanes_of", "team_of"]

KERNELS: dict[str, Kernel] = {**scan_kernels.KERNELS, **point_kernels.KERNELS, **matching_kernels.KERNELS}
