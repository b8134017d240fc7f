"""The discrete model of proximity sensors: a table of probabilities of steps along a beam, with dependent causes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gpusense._util import checks
from gpusense.world.compat import check_weights
from gpusense.world.parameters import BeamParameters, _Parameters
from gpusense.world.scanner import Reading, classes
from gpusense.world.sensor_table import SensorTable

# Steps along a beam: a table of this many takes 134 MB in float64.
MOST_BINS = 4096
# Rows of a table that are made at once: each needs some twenty numbers for each of its.
_BLOCK = 1 << 20


@dataclass(frozen=True)
class DiscreteCauses(_Parameters):
    """What can trigger a reading, each cause on its own; the first along the beam is measured and hides the others.

    ``c_r`` and ``c_d`` of Fox, Burgard and Thrun (1999) are ``1 - exp(-(lambda_short + lambda_rand) width)``, the
    probability that a step of the beam triggers without an obstacle of the map, and ``p_detect``.

    Raises:
        TypeError: a value is not a real number.
        ValueError: a value breaks its field's rule.
    """

    lambda_short: float = 0.05
    """The rate of unknown obstacles before the expected one, >= 0 [1/m]."""
    lambda_rand: float = 0.01
    """The rate of random triggers all along the beam, behind a missed obstacle too, >= 0 [1/m]."""
    p_detect: float = 0.95
    """The probability that the expected obstacle is detected where nothing triggers earlier, in [0, 1]."""
    sigma_hit: float = 0.05
    """The standard deviation of where it is detected, >= 0 [m]; 0 for always its own step."""

    def __post_init__(self) -> None:
        self._check("lambda_short", low=0)
        self._check("lambda_rand", low=0)
        self._check("p_detect", low=0, high=1)
        self._check("sigma_hit", low=0)


@dataclass(frozen=True)
class DiscreteFit:
    """How a :class:`DiscreteBeamModel` was learned."""

    log_likelihood: float
    """Sum over the readings of the logarithms of their probabilities, natural logarithm; of bins, not densities."""
    converged: bool
    """Whether the gradient vanishes at the result, as far as the bounds of the search allow."""
    standard_errors: Mapping[str, float]
    """Of each cause's parameter, in its unit, from the curvature of the likelihood; NaN where the data do not tell."""
    trace: tuple[float, ...]
    """Log-likelihood after each iteration of the search that found the result."""
    hits: int
    """Readings with a range."""
    max: int
    """Readings without a return."""
    missing: int
    """Readings left out because they say nothing."""
    status: str
    """In words: why the search ended, and what the data do not tell."""


@dataclass(frozen=True)
class DiscreteBeamModel(SensorTable):
    """p(bin of z | bin of z*): the discrete model of proximity sensors (Fox, Burgard and Thrun, JAIR 11, 1999).

    The beam goes through ``bins`` steps, and the first cause to trigger is what is measured: what triggers earlier
    hides what comes later. No return is what is left. The causes are either

    - :class:`DiscreteCauses`: unknown obstacles, the expected one, random triggers, each knowing nothing of the
      others. Far obstacles are hidden more often than near ones, and nothing is expected where the map is empty; or
    - :class:`BeamParameters`: at each step the causes trigger with such probabilities that they have the mixture's
      shares of the readings. As bins shrink, probability over width tends to the mixture's density at first order in
      the width, at every z* > 0 and z but z = z*, where p_short jumps, uniformly where the mixture has some mass left
      beyond z; and the probability of no return to z_max. What is left of the difference are two causes that trigger
      in the same step, which are one reading.

    The table belongs to a sensor, not to a map: ``gs.BeamModel(grid, scanner, table)`` scores with it, one look-up a
    beam.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule; the message names both.
    """

    causes: DiscreteCauses | BeamParameters
    """What triggers readings."""
    range_max: float
    """Readings of at least this are "no return", > 0 [m]."""
    bins: int = 100
    """Steps along the beam, 1 to 4096."""
    fit: DiscreteFit | None = None
    """How it was learned; None where it was not."""

    def __post_init__(self) -> None:
        if not isinstance(self.causes, (DiscreteCauses, BeamParameters)):
            raise TypeError(f"causes: must be DiscreteCauses or BeamParameters, got {checks.show(self.causes)}")
        if isinstance(self.causes, BeamParameters):
            check_weights(self.causes, None)
        object.__setattr__(self, "range_max", checks.real("range_max", self.range_max, above=0))
        object.__setattr__(self, "bins", checks.integer("bins", self.bins, low=1, high=MOST_BINS))
        if self.fit is not None and not isinstance(self.fit, DiscreteFit):
            raise TypeError(f"fit: must be a DiscreteFit or None, got {checks.show(self.fit)}")

    @classmethod
    def learn(cls, ranges: object, expected: object, range_max: float, bins: int = 100) -> Self:
        """The :class:`DiscreteCauses` under which readings are most likely.

        Readings are counted in a table of ``bins`` times ``bins`` first, so millions of them take no longer than a
        few.

        Args:
            ranges: Readings [m], any shape. NaN, -inf and what is below 0 is missing and left out; +inf and what is at
                least range_max is no return.
            expected: Expected ranges of that shape, >= 0 [m]; of at least range_max where the map has no obstacle.
            range_max: Readings of at least this are "no return", > 0 [m].
            bins: Steps along the beam, 1 to 4096.

        Returns:
            The model; its ``fit`` says how well it was determined.

        Raises:
            TypeError: an argument does not hold real numbers.
            ValueError: an argument breaks its rule, shapes differ, or every reading is missing.
        """
        from gpusense.learning.discrete.fit import learn_causes  # loads SciPy

        causes, fit = learn_causes(ranges, expected, range_max, bins)
        return cls(causes, range_max, bins, fit)

    def to_dict(self) -> dict[str, Any]:
        """Causes, range and bins as plain numbers and strings; how they were learned is left out."""
        kind = type(self.causes).__name__
        return {"kind": kind, "causes": self.causes.to_dict(), "range_max": self.range_max, "bins": self.bins}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The model that :meth:`to_dict` wrote.

        Raises:
            TypeError: ``values`` is not a mapping, or a value is not of its field's kind.
            ValueError: a key is missing or names no field, or a value breaks its field's rule.
        """
        if not isinstance(values, Mapping):
            raise TypeError(f"values: must be a mapping, got {checks.show(values)}")
        names = ("kind", "causes", "range_max", "bins")
        if set(values) != set(names):
            rule = f"must have the fields {', '.join(names)}"
            raise ValueError(f"{cls.__name__}: {rule}, got {checks.show(sorted(map(str, values)))}")
        kind = checks.choice("kind", values["kind"], ("DiscreteCauses", "BeamParameters"))
        causes = DiscreteCauses if kind == "DiscreteCauses" else BeamParameters
        return cls(causes.from_dict(values["causes"]), values["range_max"], values["bins"])

    @property
    def width(self) -> float:
        """Width of a step [m]."""
        return self.range_max / self.bins

    @cached_property
    def log_probabilities(self) -> NDArray[np.float64]:
        """(bins + 1, bins + 1) logarithms of probabilities; read-only.

        Row j is for an obstacle expected in step j, anywhere in it alike, and the last row for none within range.
        Column i is for a range in step i, and the last column for no return. -inf only where a reading is impossible.
        """
        table = self._rows(np.float64, density=False)
        table.setflags(write=False)
        return table

    @cached_property
    def probabilities(self) -> NDArray[np.float64]:
        """(bins + 1, bins + 1) probabilities, as in :attr:`log_probabilities`; every row sums to 1. Read-only."""
        table: NDArray[np.float64] = np.exp(self.log_probabilities)
        table.setflags(write=False)
        return table

    def log_likelihood(self, ranges: object, expected: object) -> NDArray[np.float64]:
        """What each reading adds to a scan's log-likelihood.

        Args:
            ranges: Readings of any value, any shape [m].
            expected: Expected ranges of that shape, >= 0 [m].

        Returns:
            float64 of that shape: log density [1/m] of a range, its bin's probability over the width; log probability
            of no return; 0 where a reading is missing.

        Raises:
            TypeError, ValueError: not real numbers, shapes that differ, or an expected range below 0 or not a number
                beside a reading that is not missing.
        """
        z, z_exp = check_pairs(ranges, expected, self.range_max)
        i, j = bins_of(z, self.range_max, self.bins), bins_of(z_exp, self.range_max, self.bins)
        found = self.log_probabilities[j, np.maximum(i, 0)] - np.where(i < self.bins, math.log(self.width), 0.0)
        return np.where(i < 0, 0.0, found)

    def sensor_table(self, dtype: DTypeLike) -> NDArray[Any]:
        """(bins + 1, bins + 1) what scoring looks up: by reading, then by expected range, a log density or probability.

        Raises:
            ValueError: some logarithm does not fit the dtype.
        """
        return np.ascontiguousarray(self._rows(dtype, density=True).T)

    def _rows(self, dtype: DTypeLike, *, density: bool) -> NDArray[Any]:
        from gpusense.learning.discrete.probabilities import separate_causes, shared_causes  # loads SciPy

        table = np.empty((self.bins + 1, self.bins + 1), dtype)
        step = max(_BLOCK // self.bins, 1)
        for first in range(0, self.bins + 1, step):
            rows = np.arange(first, min(first + step, self.bins + 1))
            shape, values = (self.bins, self.width), self.causes.to_dict()
            if isinstance(self.causes, DiscreteCauses):
                log_p = separate_causes(*shape, **values, rows=rows[:, None], steps=np.arange(self.bins + 1))
            else:
                log_p = shared_causes(*shape, **values, rows=rows)
            if density:
                log_p[:, :-1] -= math.log(self.width)
            with np.errstate(over="ignore"):
                table[rows] = log_p
            if np.isnan(log_p).any() or (np.isneginf(table[rows]) & np.isfinite(log_p)).any():
                raise ValueError(f"causes: must have logarithms that fit {np.dtype(dtype)}, got {self.causes}")
        return table


def bins_of(ranges: NDArray[np.float64], range_max: float, bins: int) -> NDArray[np.int64]:
    """Steps of ranges; ``bins`` for no return (inf), -1 for missing (NaN)."""
    finite = np.isfinite(ranges)
    steps = np.minimum(np.where(finite, ranges, 0) * (bins / range_max), bins - 1).astype(np.int64)
    found: NDArray[np.int64] = np.where(finite, steps, np.where(np.isnan(ranges), -1, bins))
    return found


def check_pairs(ranges: object, expected: object, range_max: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Readings and their expected ranges, classed; range_max is rounded to their own dtypes, as everywhere.

    Returns:
        float64 readings, NaN for missing and inf for no return, and expected ranges, inf for no obstacle.

    Raises:
        TypeError, ValueError: not real numbers, shapes that differ, or an expected range below 0 or not a number
            beside a reading that is not missing.
    """
    z = checks.array("ranges", ranges, finite=False, dtype=None)
    z_exp = checks.array("expected", expected, z.shape, finite=False, dtype=None)
    kinds = classes(z, 0.0, range_max)
    bad = ~(z_exp >= 0) & (kinds != Reading.MISSING)
    if bad.any():
        rule = "every value must be >= 0 where the reading is not missing"
        raise ValueError(f"expected: {rule}, got {checks.show(z_exp[bad].flat[0])}")
    with np.errstate(over="ignore"):  # a range_max beyond float16 is infinite there
        none = ~(z_exp < z_exp.dtype.type(range_max))
    wide = np.where(kinds == Reading.HIT, z, np.where(kinds == Reading.MAX, np.inf, np.nan)).astype(np.float64)
    return wide, np.where(none, np.inf, z_exp).astype(np.float64)
