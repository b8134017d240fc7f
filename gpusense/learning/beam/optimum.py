"""Search for the highest maximum: try several starts, and causes that a search dropped too early.

A search may end at a lower maximum, or drive the weight of a cause to 0, from where no small step leads back. Three
checks follow each search from an automatic start:

- An unused start whose likelihood exceeds the end of the search begins another search.
- A cause of weight 0 gets the weight of a hundredth of a reading, with each shape of a coarse list. If it then accounts
  for more than this, the likelihood rises with its weight (it is concave in the weight), and the search continues with
  this cause: Lindsay's condition of optimality (1983) for the components of a mixture.
- The status counts searches that end lower.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpusense.learning.beam.em import Climb, Watch
from gpusense.learning.beam.point import HIT, SHORT, Floats, Point, possible_causes
from gpusense.learning.beam.problem import NOTHING, Problem, Value
from gpusense.learning.beam.starts import choose_starts

# Gain [nats] below which two ends count as the same maximum.
_SAME = 1e-3
# Largest number of continued searches.
_MOST = 4
# Number of shapes to try per cause, and weights to try.
_SHAPES, _WEIGHTS = 9, (1e-4, 1e-3, 1e-2, 0.1, 0.3)

Method = Callable[[Problem, Point, Watch], Climb]


@dataclass
class Search:
    """Search for the highest maximum by one method.

    Attributes:
        problem: The problem.
        method: The search from one start.
        watch: Function called after each iteration.
    """

    problem: Problem
    method: Method
    watch: Watch

    def from_readings(self, start: Point, more: list[Point], known: Point | None = None) -> Climb:
        """Search from the likeliest start, and from starts that exceed the result.

        Args:
            start: A start; starts of the same causes are chosen from the readings.
            more: Further starts, each followed to its maximum.
            known: Another start, possibly without some of these causes, or None.
        """
        values = [self.problem.value(point) for point in (start, known) if point is not None] + self._others(start)
        values = sorted(values, key=lambda value: -value.objective)
        causes = start.weights > 0
        climb = self._climb(values[0].point, causes)
        for value in values[1:]:
            if value.objective > climb.value.objective + _SAME:
                climb = max(climb, self._climb(value.point, causes), key=_objective)
        ends = [climb, *(self._climb(point, causes) for point in more)]
        best = max(ends, key=_objective)
        best.notes += _lower([best.value.objective - end.value.objective for end in ends])
        return best

    def from_user(self, start: Point, more: list[Point]) -> Climb:
        """Search from a user's start and further starts; a note reports a higher likelihood elsewhere."""
        ends = [self._climb(point, start.weights > 0) for point in (start, *more)]
        best = max(ends, key=_objective)
        best.notes += _lower([best.value.objective - end.value.objective for end in ends])
        higher = max((value.objective for value in self._others(start)), default=-math.inf) - best.value.objective
        if higher > _SAME:
            best.notes.append(f"another start is at least {higher:.3g} nats higher: leave out 'initial'")
        return best

    def _others(self, start: Point) -> list[Value]:
        problem = self.problem
        points = choose_starts(problem.pairs, problem.bounds, start.weights > 0, problem.fit_bias)
        values = [problem.value(replace(point, shape=start.shape)) for point in points]
        return [value for value in values if math.isfinite(value.objective)]

    def _climb(self, start: Point, causes: NDArray[np.bool_]) -> Climb:
        """Search from a start, and continue with causes that the search dropped too early."""
        causes = causes & possible_causes(self.problem.pairs)
        climb = self.method(self.problem, start, self.watch)
        for _ in range(_MOST):
            point = self._revived(climb.value, causes) if climb.converged else None
            if point is None:
                return climb
            following = self.method(self.problem, point, self._watch_after(len(climb.trace) - 1))
            if following.value.objective <= climb.value.objective + _SAME:
                return climb
            climb = replace(following, trace=climb.trace + following.trace[1:])
        return climb

    def _watch_after(self, done: int) -> Watch:
        """Return the watch of a search that continues after some iterations."""
        return lambda iteration, value: self.watch(done + iteration, value)

    def _revived(self, value: Value, causes: NDArray[np.bool_]) -> Point | None:
        """Return a likelier point where a cause of weight 0 gets some weight, or None."""
        best = value
        for cause in np.flatnonzero(causes & (value.point.weights == 0)):
            tried = [self._with(value.point, int(cause), shape, NOTHING / self.problem.total)
                     for shape in _shapes(self.problem, int(cause))]  # fmt: skip
            values = [self.problem.value(point) for point in tried]
            likeliest = max(values, key=lambda each: each.totals[cause])
            if likeliest.totals[cause] <= NOTHING * (1 + 1e-6):
                continue
            for weight in _WEIGHTS:
                candidate = self.problem.value(self._with(likeliest.point, int(cause), None, weight))
                best = max(best, candidate, key=lambda each: each.objective)
        return best.point if best.objective > value.objective + _SAME else None

    def _with(self, point: Point, cause: int, shape: float | None, weight: float) -> Point:
        """Return the point with another weight of a cause, and another shape."""
        others = np.where(np.arange(4) == cause, 0.0, point.weights)
        weights: Floats = others * (1 - weight) / others.sum()
        weights[cause] = weight
        if shape is not None:
            point = replace(point, sigma=shape) if cause == HIT else replace(point, rate=shape)
        return replace(point, weights=weights)


def _shapes(problem: Problem, cause: int) -> list[float | None]:
    """Return a coarse list of shapes of a cause within their bounds; [None] for a cause without a shape."""
    if cause not in (HIT, SHORT):
        return [None]
    low, high = problem.bounds.sigma if cause == HIT else problem.bounds.rate
    return list(np.geomspace(low, high, _SHAPES))


def _objective(climb: Climb) -> float:
    return climb.value.objective


def _lower(differences: list[float]) -> list[str]:
    """Return a note on searches that ended lower than the best."""
    lower = [each for each in differences if each > _SAME]
    if not lower:
        return []
    return [f"{len(lower)} of {len(differences)} starts ended lower, by up to {max(lower):.3g} nats"]
