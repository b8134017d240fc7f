"""The discrete model of proximity sensors, a table of probabilities of steps along a beam, and its causes, learned."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers
from gpusense.learning.discrete.probabilities import (
    MOST_BINS,
    DiscreteCauses,
    bins_of,
    check_pairs,
    separate_causes,
    shared_causes,
)
from gpusense.learning.fitted import DiscreteFit, number_blocks
from gpusense.learning.point.problem import Problem, maximize, report
from gpusense.peers.weights import check_weights
from gpusense.world.parameters import BeamParameters
from gpusense.world.sensor_parameters import SensorTable

# Table entries per pass; each needs about twenty numbers.
_BLOCK = 1 << 20


@dataclass(frozen=True)
class DiscreteBeamModel(SensorTable):
    """p(bin of z | bin of z*): the discrete model of proximity sensors (Fox, Burgard and Thrun, JAIR 11, 1999).

    The beam goes through ``bins`` steps. The first cause to trigger determines the reading; no trigger is "no return".
    The causes are either

    - :class:`DiscreteCauses`: unknown obstacles, the expected obstacle and random triggers, independent of each other.
      Far obstacles are hidden more often than near ones, and an empty map has no expected obstacle; or
    - :class:`BeamParameters`: the causes trigger at rates that give them the mixture's shares of the readings. As bins
      shrink, probability over width converges to the mixture's density, at first order in the width, for all z* > 0 and
      z except z = z*, where p_short jumps; convergence is uniform where the mixture has mass beyond z. The probability
      of no return converges to z_max. The difference arises when two causes trigger in the same step.

    The table belongs to a sensor, not to a map: ``gs.BeamModel(grid, scanner, table)`` scores with one look-up per
    beam.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: An argument breaks its rule; the message names both.

    Example:
        >>> import gpusense as gs
        >>> table = gs.DiscreteBeamModel(gs.DiscreteCauses(p_detect=0.9), range_max=5.0, bins=50)
        >>> [round(float(p), 3) for p in table.log_likelihood([2.0, 1.0, 5.0], [2.0, 2.0, 2.0])]
        [1.585, -2.876, -2.458]
    """

    causes: DiscreteCauses | BeamParameters
    """Causes of readings."""
    range_max: float
    """Readings of at least ``range_max`` are "no return", > 0 [m]."""
    bins: int = 100
    """Number of steps along the beam, 1 to 4096."""
    fit: DiscreteFit | None = None
    """Result of learning; None if the causes were not learned."""

    def __post_init__(self) -> None:
        if not isinstance(self.causes, (DiscreteCauses, BeamParameters)):
            raise TypeError(f"causes: must be DiscreteCauses or BeamParameters, got {checks.show(self.causes)}")
        if isinstance(self.causes, BeamParameters):
            check_weights(self.causes, None)
            if self.causes.range_bias or self.causes.sigma_growth:
                rule = "range_bias and sigma_growth must be 0 in a table"
                raise ValueError(f"causes: {rule}, got {checks.show(self.causes)}")
            if self.causes.hit != "normal":
                raise ValueError(f"causes: hit must be 'normal' in a table, got {checks.show(self.causes)}")
        object.__setattr__(self, "range_max", checks.real("range_max", self.range_max, above=0))
        object.__setattr__(self, "bins", checks.integer("bins", self.bins, low=1, high=MOST_BINS))
        checks.instance("fit", self.fit, DiscreteFit, optional=True)

    @classmethod
    def learn(
        cls,
        ranges: ArrayLike,
        expected: ArrayLike,
        range_max: float,
        bins: int = 100,
        *,
        blocks: ArrayLike | None = None,
    ) -> Self:
        """Learn the :class:`DiscreteCauses` of maximum likelihood.

        Readings are counted in a table of ``bins`` times ``bins`` first, so that the search takes equally long for a
        few and for millions of readings.

        Args:
            ranges: Readings of any shape [m]. NaN and values below 0, including -inf, are missing; values of at least
                range_max, including +inf, are "no return".
            expected: Expected ranges of the same shape, >= 0 [m]; at least range_max if the map has no obstacle.
            range_max: Readings of at least ``range_max`` are "no return", > 0 [m].
            bins: Number of steps along the beam, 1 to 4096.
            blocks: Integer label of each reading's block, of the same shape, or None. Readings within a block (a scan)
                may be correlated; blocks are independent. Standard errors are then computed over blocks.

        Returns:
            The model; ``fit`` holds standard errors and status.

        Raises:
            TypeError: An argument does not hold real numbers.
            ValueError: An argument breaks its rule, the shapes differ, or every reading is missing.
        """
        causes, fit = learn_causes(ranges, expected, range_max, bins, blocks)
        return cls(causes, range_max, bins, fit)

    def to_dict(self) -> dict[str, Any]:
        """Return causes, range_max and bins as plain numbers and strings, without ``fit``."""
        kind = type(self.causes).__name__
        return {"kind": kind, "causes": self.causes.to_dict(), "range_max": self.range_max, "bins": self.bins}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Make the model from the result of :meth:`to_dict`.

        Raises:
            TypeError: ``values`` is not a mapping, or a value has the wrong type for its field.
            ValueError: A key is missing or names no field, or a value breaks its field's rule.
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
        """(bins + 1, bins + 1) log probabilities; read-only.

        Row j assumes an obstacle uniformly distributed in step j; the last row assumes no obstacle within range.
        Column i is a range in step i; the last column is no return. Only impossible readings have -inf.
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

    def log_likelihood(self, ranges: ArrayLike, expected: ArrayLike) -> NDArray[np.float64]:
        """Compute the contribution of each reading to a scan's log-likelihood.

        Args:
            ranges: Readings of any value and shape [m].
            expected: Expected ranges of the same shape, >= 0 [m].

        Returns:
            float64 of the same shape: log density [1/m] of a range, its bin's probability over the width; log
            probability of no return; 0 for a missing reading.

        Raises:
            TypeError, ValueError: An array does not hold real numbers, the shapes differ, or the expected range of a
                reading that is not missing is negative or NaN.
        """
        z, z_exp = check_pairs(ranges, expected, self.range_max)
        i, j = bins_of(z, self.range_max, self.bins), bins_of(z_exp, self.range_max, self.bins)
        log_p = self.log_probabilities[j, np.maximum(i, 0)] - np.where(i < self.bins, math.log(self.width), 0.0)
        return np.where(i < 0, 0.0, log_p)

    def sensor_table(self, dtype: DTypeLike) -> NDArray[Any]:
        return np.ascontiguousarray(self._rows(dtype, density=True).T)

    def _rows(self, dtype: DTypeLike, *, density: bool) -> NDArray[Any]:
        try:
            real = np.dtype(dtype)
        except (TypeError, ValueError):
            real = np.dtype(bool)
        if real not in (np.float32, np.float64):
            raise TypeError(f"dtype: must be float32 or float64, got {checks.show(dtype)}")
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


NAMES = ("lambda_short", "lambda_rand", "p_detect", "sigma_hit")
# Steps of first and second central differences; they balance rounding and truncation errors.
_FIRST, _SECOND = 1e-5, 1e-2
# Most iterations of a search, and the gain that ends it [nats].
_ITERATIONS, _TOLERANCE = 300, 1e-10
# Number of beam steps of the coarse problem in front of a search with many.
_FEW = 100


def learn_causes(
    ranges: object, expected: object, range_max: float, bins: int, blocks: object = None
) -> tuple[DiscreteCauses, DiscreteFit]:
    """Learn the most likely causes by Newton steps within bounds; see ``DiscreteBeamModel.learn``."""
    data, _ = count_pairs(ranges, expected, range_max, bins)
    end = maximize(_Causes(data), _ITERATIONS, _TOLERANCE)
    causes = _causes(end.theta)
    cells, labels = (data, None) if blocks is None else count_pairs(ranges, expected, range_max, bins, blocks)
    fit = report(_Causes(cells), end, causes, labels, data.missing)
    errors = {
        each: {name: error if math.isfinite(error) else math.nan for name, error in getattr(fit, each).items()}
        for each in ("standard_errors", "independent_errors")
    }
    hits, none = (int(data.counts[some].sum()) for some in (data.steps < data.bins, data.steps == data.bins))
    return causes, DiscreteFit(**vars(fit) | errors | {"readings": hits + none, "hits": hits, "max": none})


@dataclass(frozen=True, eq=False)
class _Causes(Problem):
    """Likelihood of counts by (log lambda_short, log lambda_rand, log odds of p_detect, log sigma_hit)."""

    flat: ClassVar[float] = 1e-4
    # A deviation of 30 of a logarithm says nothing.
    least: ClassVar[float] = 1e-3
    data: Counts

    @property
    def readings(self) -> int:
        return len(self.data.counts)

    def part(self, every: int) -> _Causes:
        return _Causes(self.data.coarser(_FEW)) if self.data.bins > 2 * _FEW else self

    def bounds(self) -> list[tuple[float, float]]:
        """Return bounds beyond which a table changes by less than a part in a million."""
        reach, width = self.data.bins * self.data.width, self.data.width
        rates = math.log(1e-9 / reach), math.log(30 / width)
        return [rates, rates, (-25.0, 25.0), (math.log(1e-6 * width), math.log(10 * reach))]

    def scales(self, theta: Floats) -> Floats:
        return np.ones(len(NAMES))

    def log_p(self, theta: Floats) -> tuple[Floats, Floats]:
        ends = [[self.data.log_p(_causes(theta + sign * step)) for sign in (1, -1)] for step in _FIRST * np.eye(4)]
        return self.data.log_p(_causes(theta)), np.stack([(a - b) / (2 * _FIRST) for a, b in ends], axis=1)

    def hessian(self, theta: Floats, free: NDArray[np.bool_]) -> Floats:
        def value(*shifts: Floats) -> float:
            return self.data.log_likelihood(_causes(theta + np.sum(shifts, axis=0)))

        steps, middle = _SECOND * np.eye(len(theta))[free], value(np.zeros(len(theta)))
        second = np.zeros((len(steps), len(steps)))
        for a, one in enumerate(steps):
            second[a, a] = value(one) - 2 * middle + value(-one)
            for b, two in enumerate(steps[:a]):
                mixed = value(one, two) - value(one, -two) - value(-one, two) + value(-one, -two)
                second[a, b] = second[b, a] = mixed / 4
        return second / _SECOND**2

    def values(self, theta: Floats) -> dict[str, float]:
        causes = _causes(theta)
        return {name: getattr(causes, name) for name in NAMES}

    def starts(self) -> list[Floats]:
        """Make starts from shares of readings before, at and behind the expected step, for several widths."""
        data, starts = self.data, []
        reach, total = data.bins * data.width, float(data.counts.sum())
        known, none = data.rows < data.bins, data.steps == data.bins
        for near in sorted({0, 1, 3, max(data.bins // 30, 1), max(data.bins // 8, 1)}):
            at = known & ~none & (np.abs(data.rows - data.steps) <= near)
            short, behind = (float(data.counts[where & ~at].sum()) / total for where in (data.steps < data.rows, ~none))
            expected = float(data.counts[known].sum())
            detected = float(data.counts[at].sum()) / expected if expected else 0.5
            guess = [
                math.log(max(short, 1e-3) / (0.5 * reach)), math.log(max(behind - short, 1e-3) / reach),
                math.log((detected + 0.01) / (1.01 - detected)), math.log(max(0.5 * near, 0.2) * data.width),
            ]  # fmt: skip
            starts.append(np.array(guess))
        return starts


def _causes(theta: Floats) -> DiscreteCauses:
    short, rand, odds, sigma = (float(value) for value in theta)
    return DiscreteCauses(math.exp(short), math.exp(rand), 1 / (1 + math.exp(-odds)), math.exp(sigma))


@dataclass(frozen=True)
class Counts:
    """Counts of readings: ``counts[k]`` readings in step ``steps[k]`` with an obstacle expected in ``rows[k]``."""

    rows: NDArray[np.int64]  # (K,) steps of expected ranges
    steps: NDArray[np.int64]  # (K,) steps of readings
    counts: Floats  # (K,) numbers of readings
    missing: int  # number of missing readings
    bins: int  # number of steps along the beam
    width: float  # width of a step [m]

    def log_p(self, causes: DiscreteCauses) -> Floats:
        """Return the (K,) log-likelihoods of the readings of each count."""
        values = causes.to_dict()
        return self.counts * separate_causes(self.bins, self.width, **values, rows=self.rows, steps=self.steps)

    def log_likelihood(self, causes: DiscreteCauses) -> float:
        """Return the log-likelihood of all readings, from the probabilities of their steps."""
        return float(self.log_p(causes).sum())

    def coarser(self, bins: int) -> Counts:
        """Return approximate counts in fewer steps."""
        scale = bins / self.bins
        both = np.trunc(np.stack([self.rows, self.steps]) * scale).astype(np.int64)
        cells, inverse = np.unique(both, axis=1, return_inverse=True)
        counts = np.bincount(inverse.ravel(), self.counts).astype(np.float64)
        return Counts(cells[0], cells[1], counts, self.missing, bins, self.bins * self.width / bins)


def count_pairs(
    ranges: object, expected: object, range_max: float, bins: int, blocks: object = None
) -> tuple[Counts, Integers | None]:
    """Count readings, of each block separately, and return the (K,) blocks; see ``DiscreteBeamModel.learn``."""
    range_max = checks.real("range_max", range_max, low=checks.SMALLEST, high=checks.FARTHEST)
    bins = checks.integer("bins", bins, low=1, high=MOST_BINS)
    z, z_exp = (
        checks.as_array(name, value, masked=True) for name, value in (("ranges", ranges), ("expected", expected))
    )
    if z.shape != z_exp.shape:
        shapes = checks.shape_text(z.shape), checks.shape_text(z_exp.shape)
        raise ValueError(f"expected: shape must be {shapes[0]}, got {shapes[1]}")
    i, j = (bins_of(each, range_max, bins) for each in check_pairs(z.reshape(-1), z_exp.reshape(-1), range_max))
    known = i >= 0
    if not known.any():
        raise ValueError(f"ranges: must have a reading that is not missing, got {len(i)} missing ones")
    labels = number_blocks(blocks, z.shape, known)
    cells = j[known] * (bins + 1) + i[known] + (0 if labels is None else labels * (bins + 1) ** 2)
    cells, times = np.unique(cells, return_counts=True)
    block, cell = np.divmod(cells, (bins + 1) ** 2)
    counts = Counts(
        cell // (bins + 1), cell % (bins + 1), times.astype(float), int(np.count_nonzero(~known)), bins,
        range_max / bins,
    )  # fmt: skip
    return counts, None if labels is None else block
