"""The look-up table of expected ranges, filled by the exact caster from the centres of cells, some rows at a time."""

import numpy as np

from gpusense.interface import structs
from gpusense.reference.raycast import cast_ray

BLOCK = 1 << 15


def fill_lookup(flags, rectangles, ray, lookup, window, bins, first_row, count, limit):
    """Fill rows of the table; a hit is at most 65 534, and 65 535 means no hit."""
    real = ray.dtype.type
    block = max(BLOCK // bins, 1)
    none = real(0)
    for begin in range(first_row * window.cols, (first_row + count) * window.cols, block):
        index = np.arange(begin, min(begin + block, (first_row + count) * window.cols))
        cell = np.repeat(np.stack([index % window.cols, index // window.cols], axis=1), bins, axis=0)
        pose = np.empty((len(cell), 4), ray.dtype)
        pose[:, :2] = 0.5
        pose[:, 2:] = np.tile(ray[:bins], (len(index), 1))
        forward = np.broadcast_to(np.array([1, 0], ray.dtype), (len(cell), 2))
        t = cast_ray(flags, rectangles, window, cell, pose, forward, limit, structs.Caster(0, none, none))
        part = np.minimum((t * (real(65535) / limit) + real(0.5)).astype(np.int64), 65534)
        lookup[begin * bins : begin * bins + len(t)] = np.where(t >= limit, 65535, part)
