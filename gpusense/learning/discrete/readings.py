"""Convert readings and expected ranges to steps along a beam."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense.world.scanner import Reading, reading_classes

# Largest number of steps along a beam: its table takes 134 MB in float64.
MOST_BINS = 4096


def bins_of(ranges: NDArray[np.float64], range_max: float, bins: int) -> NDArray[np.int64]:
    """Return the steps of ranges; ``bins`` for no return (inf), -1 for missing (NaN)."""
    finite = np.isfinite(ranges)
    steps = np.minimum(np.where(finite, ranges, 0) * (bins / range_max), bins - 1).astype(np.int64)
    result: NDArray[np.int64] = np.where(finite, steps, np.where(np.isnan(ranges), -1, bins))
    return result


def check_pairs(ranges: object, expected: object, range_max: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Classify readings and expected ranges; range_max is rounded to their dtypes, as in ``classify``.

    Returns:
        float64 readings, NaN for missing and inf for no return, and float64 expected ranges, inf for no obstacle.
    """
    z = checks.array("ranges", ranges, finite=False, dtype=None)
    z_exp = checks.array("expected", expected, z.shape, finite=False, dtype=None)
    kinds = reading_classes(z, 0.0, range_max)
    bad = ~(z_exp >= 0) & (kinds != Reading.MISSING)
    if bad.any():
        rule = "every value must be >= 0 where the reading is not missing"
        raise ValueError(f"expected: {rule}, got {checks.show(z_exp[bad].flat[0])}")
    with np.errstate(over="ignore"):  # range_max may exceed float16
        none = ~(z_exp < z_exp.dtype.type(range_max))
    wide = np.where(kinds == Reading.HIT, z, np.where(kinds == Reading.MAX, np.inf, np.nan)).astype(np.float64)
    return wide, np.where(none, np.inf, z_exp).astype(np.float64)
