"""Rules for the readings of a scan: the beams that are used, and the classes of readings that are evaluated."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpusense._util.checks import integer, show
from gpusense.backends import Backend
from gpusense.world.likelihood import Likelihood
from gpusense.world.plausible import FirstScans
from gpusense.world.range_causes import NoReturn
from gpusense.world.scanner import Reading, Scanner

Beams = int | Sequence[int] | np.ndarray | None


@functools.lru_cache(maxsize=256)
def _evenly(most: int, count: int) -> np.ndarray:
    """Return ``most`` evenly chosen places among ``count``."""
    return (np.arange(most) * count) // max(most, 1)


@dataclass(frozen=True)
class BeamChoice:
    """The beams that ``beams=`` chooses."""

    columns: np.ndarray  # beams that may be used
    most: int  # largest number of readings that are used, evenly chosen from more
    every: bool  # true if all beams are used

    @staticmethod
    def of(beams: Beams, count: int) -> BeamChoice:
        """Return the choice for a scanner of ``count`` beams."""
        if beams is None or isinstance(beams, (int, np.integer)):
            most = count if beams is None else min(int(beams), count)
            return BeamChoice(np.arange(count), most, most == count)
        columns = np.asarray(beams, np.intp)
        return BeamChoice(columns, len(columns), False)

    def used(self, informative: np.ndarray) -> np.ndarray:
        """Return which of the informative readings of a scan are used."""
        if len(self.columns) == len(informative):
            places = informative.nonzero()[0]
        else:
            places = self.columns.compress(informative.take(self.columns))
        if len(places) > self.most:
            places = places.take(_evenly(self.most, len(places)))
        used = np.zeros(len(informative), bool)
        used[places] = True
        return used

    def among(self, hit: np.ndarray, far: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which of the ranges and of the informative max readings of (S, K) scans are used."""
        informative = hit | far
        if len(informative) == 1:
            used = self.used(informative[0])[None]
        else:
            used = np.stack([self.used(each) for each in informative])
        return hit & used, far & used


@dataclass(frozen=True)
class BeamSelection:
    """Rules that class, thin and group readings."""

    scanner: Scanner  # the scanner's geometry
    vectors: np.ndarray  # (K, 2) float64 cosines and sines of the bearings, the mount's yaw included
    z_max: float  # probability of a max reading; 0 makes it missing
    beams: Beams  # the beams that are used
    specialize: bool  # false keeps readings without information, and casts equal bearings separately
    max_is_range: bool = False  # evaluate finite max readings like ranges
    max_depends: bool = False  # the probability of a max reading depends on the pose, so such readings are evaluated
    map_size: float | None = None  # diagonal of the map [m]; None without a map

    @functools.cached_property
    def choice(self) -> BeamChoice:
        """The beams that are used."""
        return BeamChoice.of(self.beams, self.scanner.count)

    @functools.cached_property
    def columns(self) -> np.ndarray:
        """(K,) positions of all readings."""
        return np.arange(self.scanner.count)

    @functools.cached_property
    def of_complete_scan(self) -> tuple[np.ndarray, ...]:
        """Parts of a scan of ranges alone, as ``ClassedScans`` names them.

        Which readings (K,) are used, their columns (M,), vectors (M, 2), ray offsets (M + 1,), count and constant (1,).
        """
        used = self.choice.used(np.ones(self.scanner.count, bool))
        columns, count = used.nonzero()[0], np.count_nonzero(used)
        begins = np.arange(count + 1, dtype=np.int32)
        return used, columns, self.vectors.take(columns, axis=0), begins, np.array([count]), np.zeros(1)

    @functools.cached_property
    def separate(self) -> bool:
        """Return whether each reading has a separate ray, because all bearings differ or nothing is left out."""
        return not self.specialize or len(set(map(tuple, self.vectors.tolist()))) == len(self.vectors)

    @functools.cached_property
    def ray_of(self) -> np.ndarray:
        """Number (K,) of the ray of each bearing; equal bearings have the same one."""
        return np.unique(self.vectors, axis=0, return_inverse=True)[1].ravel()

    @functools.cached_property
    def limits(self) -> tuple[float, float]:
        """Least range, and least max reading [m]."""
        return self.scanner.range_min, self.scanner.range_max

    @functools.cached_property
    def first_scans(self) -> FirstScans:
        """The check of the scanner's first scans for implausible readings."""
        return self.scanner._first_scans

    @functools.cached_property
    def max_is_constant(self) -> bool:
        """Return whether max readings are added as a constant term instead of being evaluated."""
        return self.specialize and not self.max_depends

    @functools.cached_property
    def log_max(self) -> float:
        """Log of the probability of a max reading; 0 if max readings do not count."""
        return float(NoReturn(self.z_max).log_mass) if self.z_max > 0 else 0.0


def choose_beams(kinds: np.ndarray, beams: Beams, informative_max: bool) -> np.ndarray:
    """Return whether each reading is used: all, an even choice of ``beams`` informative ones, or chosen indices."""
    informative = (kinds == Reading.HIT) | ((kinds == Reading.MAX) & informative_max)
    return BeamChoice.of(beams, len(kinds)).used(informative)


@dataclass(frozen=True)
class ModelContext:
    """The device, and the rules for readings, of a scan model."""

    backend: Backend  # the device
    real: np.dtype  # precision
    rules: BeamSelection  # how readings are classed; they hold the scanner
    weights: Likelihood  # the book's likelihood, or the program whose weights are reproduced
    cubes: bool  # whether the model sums cubes of densities instead of logarithms
    temperature: float  # multiplies the sum over readings
    constant_term: float  # the first term of that sum
    possible: bool  # true if some range is possible at some pose


def check_beams(beams: Beams, count: int) -> Beams:
    """Validate ``beams=`` for a scanner of ``count`` beams."""
    if beams is None:
        return None
    if isinstance(beams, (int, np.integer)):
        return integer("beams", beams, low=0)
    try:
        indices = np.asarray(beams)
    except ValueError:
        indices = np.empty((0, 0))
    if indices.ndim != 1 or (indices.size and indices.dtype.kind not in "iu"):
        raise TypeError(f"beams: must be a number of beams or a list of beam indices, got {show(beams)}")
    outside = (indices < 0) | (indices >= count)
    if outside.any():
        raise ValueError(f"beams: indices must be in [0, {count}), got {indices[outside][0]}")
    return np.unique(indices)
