"""Expected range by a compressed directional distance transform (Walsh and Karaman 2018).

For each angle bin the map is cut into lines of one cell's width along the bin's direction. Each line has the sorted
positions at which obstacles begin. A ray uses the line of its origin in the nearest bin, so errors grow as range * pi /
bins.

Table of integers: number of lines of a bin; for each bin its cosine and sine in 2^-30 and its first line; from index 1
+ 3 bins on, the index of the first obstacle of each line (bins * lines + 1 numbers); then a bit for each cell, set
where it is occupied; then the obstacles in 2^-10 cells.
"""

import numpy as np

from gpusense.reference.ray import angle_bin, off_grid, ray_direction

ENTRY_UNIT = 1024.0
COSINE_UNIT = 2.0**-30
FARTHEST = 1048576.0


def cast_ray(flags, map_table, window, cell, pose, ray, limit, caster):
    """Return the distance in cells to the first obstacle of the line, limit where none is nearer.

    The arguments are those of ``dda.cast_ray``, with the table above and the angle bins of a full turn in ``caster``.
    """
    real = pose.dtype.type
    origin = cell.T.astype(np.int64)
    lines, first = int(map_table[0]), 1 + 3 * caster.bins
    outside = off_grid(origin, window.rows, window.cols)
    index = np.where(outside, 0, origin[1] * window.cols + origin[0])
    bits = map_table[first + caster.bins * lines + 1 + index // 32].astype(np.uint32)
    inside = ((bits >> (index % 32).astype(np.uint32)) & 1).astype(bool) & ~outside
    if "OUTSIDE_OCCUPIED" in flags:
        inside |= outside
    bin = angle_bin(np.stack(ray_direction(pose, ray)), caster.bins)
    c = map_table[1 + 3 * bin].astype(pose.dtype) * real(COSINE_UNIT)
    s = map_table[2 + 3 * bin].astype(pose.dtype) * real(COSINE_UNIT)
    x, y = origin.astype(pose.dtype) + pose[:, :2].T
    along, across = c * x + s * y, c * y - s * x
    near = np.abs(across) <= real(FARTHEST)
    line = np.floor(np.where(near, across, 0)).astype(np.int64) - map_table[3 + 3 * bin]
    known = near & (line >= 0) & (line < lines)
    place = first + bin * lines + np.where(known, line, 0)
    start = np.trunc(np.clip(along, real(-FARTHEST), real(FARTHEST)) * real(ENTRY_UNIT)).astype(np.int64)
    low, end = map_table[place].astype(np.int64), map_table[place + 1].astype(np.int64)
    high = end.copy()
    while (open_ := low < high).any():
        middle = low + (high - low) // 2
        below = map_table[np.minimum(middle, len(map_table) - 1)] < start
        low = np.where(open_ & below, middle + 1, low)
        high = np.where(open_ & ~below, middle, high)
    entry = map_table[np.minimum(low, len(map_table) - 1)].astype(pose.dtype)
    t = np.maximum(np.minimum(entry / real(ENTRY_UNIT) - along, limit), real(0))
    return np.where(inside, real(0), np.where(known & (low < end), t, limit))
