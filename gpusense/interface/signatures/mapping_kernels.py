"""Kernels that build maps from scans."""

from __future__ import annotations

from gpusense.interface.signatures.rows import Kernel, kernel

KERNELS: dict[str, Kernel] = {
    "count_rays": kernel(
        "ray_counts", "ray", "int2 start_cell [rays]", "int2 start_inside [rays]", "int2 end_cell [rays]",
        "int2 end_inside [rays]", "int hit [rays]", "out int hits [rows * cols]", "out int misses [rows * cols]",
        "int rows", "int cols", "int rays",
    ),
}  # fmt: skip
