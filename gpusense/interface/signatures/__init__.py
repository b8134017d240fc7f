"""One row per kernel: file, launch shape and arguments in order. Every backend binds arguments by this table.

A kernel has three bodies (NumPy reference, OpenCL, Warp) with the same name and the same arguments; a test compares
them with this table. ``real`` is the precision of a model, float32 or float64; ``double`` is always float64, and
``coordinate`` (poses) and ``measured`` (readings) are float64, or float32 with POSES_FLOAT32 and RANGES_FLOAT32.
"""

from __future__ import annotations

from gpusense.interface.signatures import (
    feature_kernels,
    learning_kernels,
    map_kernels,
    matching_kernels,
    particle_kernels,
    point_kernels,
    scan_kernels,
    world_kernels,
)
from gpusense.interface.signatures.rows import LANES, Argument, Kernel, lanes_of, team_of

__all__ = ["KERNELS", "LANES", "Argument", "Kernel", "lanes_of", "team_of"]

# All kernels; each subject has a file in this folder.
KERNELS: dict[str, Kernel] = {
    **map_kernels.KERNELS,
    **scan_kernels.KERNELS,
    **world_kernels.KERNELS,
    **point_kernels.KERNELS,
    **learning_kernels.KERNELS,
    **matching_kernels.KERNELS,
    **feature_kernels.KERNELS,
    **particle_kernels.KERNELS,
}
