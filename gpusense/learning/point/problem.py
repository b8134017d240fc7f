"""Base class of likelihoods of readings at known poses, with bounded coordinates, log p and gradients."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers


def places_of(poses: Floats, mount: object) -> Floats:
    """Return the (S, 2) positions in the world of a point (x, y) on the robot at (S, 3) poses."""
    x, y = checks.array("mount", mount, (2,), largest=checks.FARTHEST)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return poses[:, :2] + np.stack([c * x - s * y, s * x + c * y], axis=1)


# Step of differences as a share of a coordinate's scale; the relative error is about its square.
_STEP = 1e-5


class Problem(ABC):
    """Likelihood of n independent readings by k coordinates.

    A subclass is a frozen dataclass. The first axis of attributes named in ``per_reading`` is the reading.
    """

    per_reading: ClassVar[tuple[str, ...]]

    @property
    def readings(self) -> int:
        """Number of readings."""
        return len(getattr(self, self.per_reading[0]))

    @abstractmethod
    def bounds(self) -> tuple[Floats, Floats]:
        """Return the smallest and largest values (k,) of the coordinates."""

    @abstractmethod
    def starts(self) -> list[Floats]:
        """Return starts (k,) of a search."""

    @abstractmethod
    def scales(self, theta: Floats) -> Floats:
        """Return the (k,) step sizes of the coordinates."""

    @abstractmethod
    def log_p(self, theta: Floats) -> tuple[Floats, Floats]:
        """Return (n,) log p and its (n, k) gradient by the coordinates."""

    @abstractmethod
    def values(self, theta: Floats) -> dict[str, float]:
        """Return the parameters by name."""

    def ordered(self, theta: Floats) -> Floats:
        """Return coordinates of the same likelihood with exchangeable parts in canonical order."""
        return theta

    def part(self, every: int) -> Problem:
        """Return the problem of every ``every``-th reading."""
        changes: dict[str, Any] = {name: getattr(self, name)[::every] for name in self.per_reading}
        return replace(self, **changes)  # type: ignore[type-var]

    def total(self, theta: Floats) -> tuple[float, Floats]:
        """Return the log-likelihood and its (k,) gradient."""
        log_p, gradient = self.log_p(theta)
        return float(log_p.sum()), gradient.sum(axis=0)

    def hessian(self, theta: Floats, free: NDArray[np.bool_]) -> Floats:
        """Return the (m, m) second derivatives by the free coordinates, by differences of gradients."""
        places = np.flatnonzero(free)
        rows = [self._slope(lambda at: self.total(at)[1][places], theta, int(place)) for place in places]
        matrix = np.array(rows).reshape(len(places), len(places))
        return (matrix + matrix.T) / 2

    def jacobian(self, theta: Floats) -> Floats:
        """Return the (p, k) derivatives of the parameters by the coordinates."""
        rows = [self._slope(lambda at: np.array(list(self.values(at).values())), theta, k) for k in range(len(theta))]
        return np.array(rows).T

    def _slope(self, function: Callable[[Floats], Floats], theta: Floats, place: int) -> Floats:
        """Return the derivative of a function by a coordinate, as a difference within the bounds."""
        low, high = self.bounds()
        step = _STEP * self.scales(theta)[place]
        room = max(theta[place] - low[place], 0.0), max(high[place] - theta[place], 0.0)
        # One-sided at a bound.
        if min(room) > 0:
            step = min(step, *room)
        ends = []
        for sign in (-1, 1):
            moved = theta.copy()
            moved[place] = min(max(theta[place] + sign * step, low[place]), high[place])
            ends.append((moved[place], function(moved)))
        (first, before), (last, after) = ends
        return np.asarray((after - before) / (last - first)) if last > first else np.zeros_like(after)


def mix(parts: list[tuple[float, Floats]]) -> tuple[Floats, Floats, list[Floats]]:
    """Return the (n,) log of a weighted sum of c densities, their (c, n) shares, and their ratios to the sum.

    The ratios are the derivatives by the weights.
    """
    logs = np.array([log for _, log in parts])
    with np.errstate(divide="ignore"):
        weighted = logs + np.log([weight for weight, _ in parts])[:, None]
    log_p = np.logaddexp.reduce(weighted, axis=0)
    floor = np.where(np.isfinite(log_p), log_p, -1e300)
    shares = np.exp(weighted - floor)
    # Beyond e^700 a ratio would overflow; the search needs only its sign.
    ratios = [np.exp(np.minimum(log - floor, 700.0)) for log in logs]
    return log_p, shares, ratios


def number_blocks(blocks: object, rows: int, of: NDArray[Any]) -> Integers | None:
    """Return the blocks of some rows, numbered from 0; None without blocks.

    ``blocks`` labels all rows; ``of`` holds the rows of the readings, as indices or a mask.
    """
    if blocks is None:
        return None
    labels: Integers = checks.array("blocks", blocks, (rows,), dtype=np.int64)
    known, numbers = np.unique(labels[of], return_inverse=True)
    if len(known) < 2:
        raise ValueError(f"blocks: must be at least 2 with a reading that is not missing, got {len(known)}")
    return numbers.ravel().astype(np.int64)


def of_weight(weight: float) -> float:
    """Return the step size for a weight in [0, 1]."""
    return max(min(weight, 1 - weight), 1e-4)
