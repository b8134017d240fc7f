"""The readings to learn from, classed, beside the ranges that the map lets expect."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense.world.scanner import Reading, classes

# Readings that are looked at to find the step that a sensor rounds to.
_SAMPLE = 20_000


@dataclass(frozen=True)
class Pairs:
    """Readings and expected ranges of one shape.

    Attributes:
        reading: (M,) the hits' readings in their own precision [m].
        expected: (M,) expected ranges beside them, in [0, range_max] [m].
        places: (M,) where the hits were among all readings.
        kinds: (n,) the class of every reading.
        range_max: Longest range [m].
        quantum: What readings are multiples of, 0 where no such step shows [m].
    """

    reading: NDArray[np.floating]
    expected: NDArray[np.floating]
    places: NDArray[np.intp]
    kinds: NDArray[np.uint8]
    range_max: float
    quantum: float

    @property
    def hits(self) -> int:
        """How many readings are ranges."""
        return len(self.reading)

    @property
    def max_readings(self) -> int:
        """How many readings are "no return"."""
        return int(np.count_nonzero(self.kinds == Reading.MAX))

    @property
    def missing(self) -> int:
        """How many readings say nothing."""
        return int(np.count_nonzero(self.kinds == Reading.MISSING))

    def subset(self, chosen: NDArray[np.bool_]) -> Pairs:
        """The pairs of some readings; ``chosen`` (n,) says of which."""
        own = chosen[self.places]
        places = np.cumsum(chosen)[self.places[own]] - 1
        return Pairs(self.reading[own], self.expected[own], places, self.kinds[chosen], self.range_max, self.quantum)


def make_pairs(ranges: ArrayLike, expected: ArrayLike, range_max: float, range_min: float = 0.0) -> Pairs:
    """Class the readings and keep the hits.

    Args:
        ranges: Readings of any shape and value [m].
        expected: Expected ranges of the same shape [m].
        range_max: Longest range [m].
        range_min: Shortest range [m].

    Raises:
        TypeError: an argument does not hold real numbers.
        ValueError: the shapes differ, every reading is missing, or an expected range is not in [0, range_max] beside a
            reading that is not missing.
    """
    range_max = checks.real("range_max", range_max, above=0)
    range_min = checks.real("range_min", range_min, low=0, below=range_max)
    z = checks.array("ranges", ranges, finite=False, dtype=None)
    ahead = checks.array("expected", expected, finite=False, dtype=None)
    if z.shape != ahead.shape:
        raise ValueError(
            f"expected: shape must be that of ranges, {checks.shape_text(z.shape)}, got "
            f"{checks.shape_text(ahead.shape)}"
        )
    z, ahead = z.ravel(), ahead.ravel()
    kinds = classes(z, range_min, range_max)
    if not (kinds != Reading.MISSING).any():
        raise ValueError(f"ranges: must hold a reading that is not missing, got {z.size} of which none is")
    # What a float32 cast returns for "nothing" is range_max, rounded.
    outside = (kinds != Reading.MISSING) & ~((ahead >= 0) & (ahead <= max(ahead.dtype.type(range_max), range_max)))
    if outside.any():
        index = int(np.argmax(outside))
        raise ValueError(
            f"expected: every value must be in [0, range_max] where the reading is not missing, got {ahead[index]} at "
            f"index {index}"
        )
    places = np.flatnonzero(kinds == Reading.HIT)
    reading = z[places]
    return Pairs(reading, np.minimum(ahead[places], range_max), places, kinds, range_max, quantum_of(reading))


def quantum_of(reading: NDArray[np.floating]) -> float:
    """The step that readings are multiples of, 0 where none shows.

    A step shows where readings repeat and all gaps between different ones are whole multiples of the smallest; gaps of
    a few units in the last place of the readings' precision are none.
    """
    sample = reading[:: max(1, len(reading) // _SAMPLE)]
    distinct = np.unique(sample).astype(np.float64)
    if len(distinct) < 2 or len(distinct) == len(sample):
        return 0.0
    gaps = np.diff(distinct)
    noise = 8 * float(np.finfo(reading.dtype).eps) * float(distinct[-1])
    gaps = gaps[gaps > noise]
    if not len(gaps):
        return 0.0
    step = float(gaps.min())
    step = float(np.median(gaps[gaps < 1.5 * step]))
    steps = gaps / step
    return step if bool((np.abs(steps - np.round(steps)) < 0.05 + noise / step).all()) and math.isfinite(step) else 0.0
