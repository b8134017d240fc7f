"""Expected range by a look-up table over cells and angle bins (precomputed ranges, book section 6.3).

The table has, for each cell and bin, the range from the cell's centre in the bin's direction, in units of limit / 65
535.
"""

import numpy as np

from gpusense.reference.ray import angle_bin, make_ray, start_casts


def cast_ray(flags, map_table, window, cell, pose, ray, limit, caster):
    """Return the distance in cells from the table, limit where no obstacle is nearer.

    The arguments are those of ``dda.cast_ray``, with (rows * cols * bins) ranges as ``map_table`` and the angle bins of
    a full turn in ``caster``.
    """
    r = make_ray(pose, ray)
    origin, k, t, ranges, active = start_casts(flags, r, cell, window, limit)
    at = origin[:, active] + r.step[:, active] * k[:, active].astype(np.int64)
    part = map_table[(at[1] * window.cols + at[0]) * caster.bins + angle_bin(r.direction[:, active], caster.bins)]
    far = t[active] + part.astype(pose.dtype) * (limit / pose.dtype.type(65535))
    ranges[active] = np.where(part == 65535, limit, np.minimum(far, limit))
    return ranges
