"""Count readings in a table of (step of z*, step of z)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense.learning.discrete.causes import DiscreteCauses
from gpusense.learning.discrete.probabilities import separate_causes
from gpusense.learning.discrete.readings import MOST_BINS, bins_of, check_pairs

Floats = NDArray[np.float64]

# Number of readings per pass.
_BLOCK = 1 << 20


@dataclass(frozen=True)
class Counts:
    """Counts of readings: ``counts[k]`` readings in step ``steps[k]`` with an obstacle expected in ``rows[k]``.

    Attributes:
        rows: (K,) steps of expected ranges.
        steps: (K,) steps of readings.
        counts: (K,) numbers of readings.
        missing: Number of missing readings.
        bins: Number of steps along the beam.
        width: Width of a step [m].
    """

    rows: NDArray[np.int64]
    steps: NDArray[np.int64]
    counts: Floats
    missing: int
    bins: int
    width: float

    @property
    def total(self) -> float:
        """Number of readings that are not missing."""
        return float(self.counts.sum())

    def log_likelihood(self, causes: DiscreteCauses) -> float:
        """Return the log-likelihood of all readings, from the probabilities of their steps."""
        log_p = separate_causes(self.bins, self.width, **causes.to_dict(), rows=self.rows, steps=self.steps)
        return float(self.counts @ log_p)

    def coarser(self, bins: int) -> Counts:
        """Return approximate counts in fewer steps."""
        scale = bins / self.bins
        both = np.trunc(np.stack([self.rows, self.steps]) * scale).astype(np.int64)
        cells, inverse = np.unique(both, axis=1, return_inverse=True)
        counts = np.bincount(inverse.ravel(), self.counts).astype(np.float64)
        return Counts(cells[0], cells[1], counts, self.missing, bins, self.bins * self.width / bins)


def count_pairs(ranges: object, expected: object, range_max: float, bins: int) -> Counts:
    """Count readings; see ``DiscreteBeamModel.learn`` for arguments and errors."""
    range_max = checks.real("range_max", range_max, low=checks.SMALLEST, high=checks.FARTHEST)
    bins = checks.integer("bins", bins, low=1, high=MOST_BINS)
    z, z_exp = (
        checks.as_array(name, value, masked=True) for name, value in (("ranges", ranges), ("expected", expected))
    )
    if z.shape != z_exp.shape:
        shapes = checks.shape_text(z.shape), checks.shape_text(z_exp.shape)
        raise ValueError(f"expected: shape must be {shapes[0]}, got {shapes[1]}")
    z, z_exp = z.reshape(-1), z_exp.reshape(-1)
    table, missing = np.zeros((bins + 1) ** 2, np.int64), 0
    for first in range(0, max(len(z), 1), _BLOCK):
        block = slice(first, first + _BLOCK)
        readings, expected_ranges = check_pairs(z[block], z_exp[block], range_max)
        i, j = bins_of(readings, range_max, bins), bins_of(expected_ranges, range_max, bins)
        missing += int(np.count_nonzero(i < 0))
        # bincount returns bins up to the last occupied one.
        counts = np.bincount((j * (bins + 1) + i)[i >= 0])
        table[: len(counts)] += counts
    cells = np.flatnonzero(table)
    if cells.size == 0:
        raise ValueError(f"ranges: must have a reading that is not missing, got {missing} missing ones")
    return Counts(cells // (bins + 1), cells % (bins + 1), table[cells].astype(float), missing, bins, range_max / bins)
