"""Compare how two backends rank the same particles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.evaluation.tolerances import scan_tolerance
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.field import LikelihoodFieldModel

Array = NDArray[Any]
Model = BeamModel | LikelihoodFieldModel


@dataclass
class Agreement:
    """Agreement of two backends about the ranks of the same particles, over all scans.

    Attributes:
        same_rank: Number of scans in which the logged pose has the same rank.
        same_order: Number of scans in which no two particles change places; ties on one side may differ on the other.
        spearman: Smallest rank correlation of all particles.
        difference: Largest difference of log-likelihoods [nats].
        gap: Largest difference in log-likelihood between two particles that change places [nats].
        allowed: Largest difference that rounding explains [nats].
    """

    left: str
    right: str
    scans: int = 0
    same_rank: int = 0
    same_order: int = 0
    spearman: float = 1.0
    difference: float = 0.0
    gap: float = 0.0
    allowed: float = 0.0

    @property
    def same(self) -> bool:
        """Return whether particles change places only where rounding explains it."""
        return self.gap <= self.allowed

    def add(self, models: Sequence[Model], left: Array, right: Array) -> None:
        """Add the log-likelihoods of one scan's particles by two models; the first particle is the logged pose."""
        self.scans += 1
        a, b = ranks(left), ranks(right)
        self.same_rank += int(a[0] == b[0])
        gap = max(largest_gap(left, right), largest_gap(right, left))
        self.same_order += int(gap == 0)
        self.spearman = min(self.spearman, correlation(a, b))
        with np.errstate(invalid="ignore"):
            apart = np.where(left == right, 0.0, np.abs(left.astype(np.float64) - right))
        self.difference = max(self.difference, float(np.max(apart, initial=0.0)))
        self.gap = max(self.gap, gap)
        largest = float(np.max(np.abs(left), initial=0.0, where=np.isfinite(left)))
        tolerances = [scan_tolerance(m.precision, min(m.scanner.count, 10_000)) for m in models]
        allowed = sum(t.value * (1.0 if t.unit == "nats" else 1.0 + largest) for t in tolerances)
        self.allowed = max(self.allowed, allowed)


def ranks(values: Array) -> Floats:
    """Return ranks, 1 for the smallest value; ties have their mean rank."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - (counts - 1) / 2)[inverse]


def correlation(left: Floats, right: Floats) -> float:
    """Return Pearson's correlation, for ranks Spearman's; if a side is constant, 1 for equal sides, else 0."""
    a, b = left - left.mean(), right - right.mean()
    size = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / size if size else float(np.array_equal(left, right))


def largest_gap(left: Array, right: Array) -> float:
    """Return the largest lead in the right scores between two particles that the left scores rank in reverse."""
    order = np.lexsort((-right, -left))
    b = right[order].astype(np.float64)
    lowest = np.minimum.accumulate(b)
    with np.errstate(invalid="ignore"):
        return float(np.max(np.where(b == lowest, 0.0, b - lowest), initial=0.0))
