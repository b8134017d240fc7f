"""Likelihoods of readings at known poses, with bounded coordinates; the search for a maximum, and its report.

Newton steps begin at the likeliest of several starts. A coordinate at a bound stays there while the gradient points
outwards. In the remaining coordinates a step follows the eigenvectors of the second derivatives, uphill along each, and
is halved until the log-likelihood rises enough (Nocedal and Wright, *Numerical Optimization*, sections 3.4 and 16.7).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers
from gpusense.learning.fitted import (
    FEW_BLOCKS,
    P,
    PointFit,
    common_fields,
    errors_of,
    notes_on_blocks,
    scatter_of,
    shortened,
)
from gpusense.world.pose_algebra import rotated


def places_of(poses: Floats, mount: object) -> Floats:
    """Return the (S, 2) positions in the world of a point (x, y) on the robot at (S, 3) poses."""
    place = checks.array("mount", mount, (2,), largest=checks.FARTHEST)
    return poses[:, :2] + rotated(place[None], poses[:, 2])


# Step of differences as a share of a coordinate's scale; the relative error is about its square.
_STEP = 1e-5


class Problem(ABC):
    """Likelihood of n independent readings by k coordinates.

    A subclass is a frozen dataclass. The first axis of attributes named in ``per_reading`` is the reading.
    """

    per_reading: ClassVar[tuple[str, ...]]
    # Share of the largest scaled information, and information per squared step of a coordinate, that count as none.
    flat: ClassVar[float] = 1e-7
    least: ClassVar[float] = 0.0

    @property
    def readings(self) -> int:
        """Number of readings."""
        return len(getattr(self, self.per_reading[0]))

    @abstractmethod
    def bounds(self) -> Sequence[tuple[float, float]] | Floats:
        """Return the smallest and largest value (k, 2) of each coordinate."""

    @cached_property
    def limits(self) -> tuple[Floats, Floats]:
        """The smallest and the largest values (k,) of the coordinates."""
        low, high = np.array(self.bounds(), np.float64).T
        return low, high

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
        low, high = self.limits
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


def of_weight(weight: float) -> float:
    """Return the step size for a weight in [0, 1]."""
    return max(min(weight, 1 - weight), 1e-4)


# Number of starts to follow, and of readings for choosing them.
_CLIMBED, _SAMPLE = 3, 20_000
# Smallest share of the expected gain that a step must achieve, and largest number of halvings.
_ARMIJO, _HALVINGS = 1e-4, 50
# Scaled curvature below the first share of the largest counts as none; errors of differences stay below the second.
_FLAT, _NEGATIVE = 1e-10, 1e-7
# Slope below which a direction without curvature is level [nats per deviation], and the share of the largest
# information, per squared step of a coordinate, that differences cannot tell from none.
_LEVEL, _ROUNDED = 1e-3, 1e-8


@dataclass(frozen=True)
class Climb:
    """End of a search."""

    theta: Floats  # (k,) coordinates
    value: float  # log-likelihood
    trace: list[float]  # log-likelihood at the start and after each iteration
    converged: bool  # True if the end is a maximum
    free: NDArray[np.bool_]  # (k,) mask of the coordinates that are not held at a bound


def maximize(problem: Problem, max_iterations: int, tolerance: float) -> Climb:
    """Search from the likeliest starts, and return the end with exchangeable parts in canonical order."""
    checks.integer("max_iterations", max_iterations, low=1)
    checks.real("tolerance", tolerance, above=0)
    every = max(1, problem.readings // _SAMPLE)
    sample = problem.part(every) if every > 1 else problem
    low, high = problem.limits
    starts = [np.clip(each, low, high) for each in problem.starts()]
    starts = sorted(starts, key=lambda each: -sample.total(each)[0])[:_CLIMBED]
    ends = [climb(sample, each, max_iterations, tolerance) for each in starts]
    end = max(ends, key=lambda end: end.value)
    # Many readings are searched after a subset of them.
    end = end if sample is problem else climb(problem, end.theta, max_iterations, tolerance)
    theta = problem.ordered(end.theta)
    if np.array_equal(theta, end.theta):
        return end
    # Rounding decides which of several equal maxima a search reaches.
    return replace(end, theta=theta, free=free_coordinates(problem, theta))


def climb(problem: Problem, start: Floats, max_iterations: int, tolerance: float) -> Climb:
    """Search for a maximum from one start."""
    low, high = problem.limits
    theta: Floats = np.clip(start, low, high)
    value, gradient = problem.total(theta)
    trace, converged = [value], False
    for _ in range(max_iterations):
        step, gain, top = _step(problem, theta, gradient, _free(theta, gradient, low, high))
        if top and gain < tolerance:
            converged = True
            break
        moved = _line_search(problem, theta, value, gradient, step)
        if moved is None:
            # A gain below the sum's rounding error cannot be measured.
            converged = top and gain < 1e-12 * max(abs(value), 1.0)
            break
        theta, value, gradient = moved
        trace.append(value)
    return Climb(theta, value, trace, converged, _free(theta, gradient, low, high))


def free_coordinates(problem: Problem, theta: Floats) -> NDArray[np.bool_]:
    """Return the mask (k,) of the coordinates that are not held at a bound."""
    return _free(theta, problem.total(theta)[1], *problem.limits)


def _free(theta: Floats, gradient: Floats, low: Floats, high: Floats) -> NDArray[np.bool_]:
    return ~(((theta <= low) & (gradient <= 0)) | ((theta >= high) & (gradient >= 0)))


def _step(problem: Problem, theta: Floats, gradient: Floats, free: NDArray[np.bool_]) -> tuple[Floats, float, bool]:
    """Return the (k,) step, the expected gain, and whether the Hessian is negative semidefinite."""
    step = np.zeros(len(theta))
    if not free.any():
        return step, 0.0, True
    curve, g, scale = -problem.hessian(theta, free), gradient[free], problem.scales(theta)[free]
    diagonal = np.abs(np.diag(curve)) * scale**2
    scale = scale / np.sqrt(np.maximum(diagonal, max(1e-12 * float(diagonal.max()), 1e-300)))
    size, axes = np.linalg.eigh(curve * np.outer(scale, scale))
    flat = _FLAT * max(float(np.abs(size).max()), 1e-300)
    along: Floats = axes.T @ (scale * g)
    moves = along / np.maximum(np.abs(size), flat)
    # Along a direction without curvature and slope, rounding alone would move a step.
    moves[(np.abs(size) < problem.flat) & (np.abs(along) < _LEVEL)] = 0.0
    step[free] = scale * (axes @ moves)
    # Longer steps leave the region where the curvature is valid.
    limit = 4 * problem.scales(theta)
    step *= min(1.0, float((limit / np.maximum(np.abs(step), 1e-300)).min()))
    top = bool(size.min() >= -_NEGATIVE * float(np.abs(size).max()))
    return step, 0.5 * float(along @ moves), top


def _line_search(
    problem: Problem, theta: Floats, value: float, gradient: Floats, step: Floats
) -> tuple[Floats, float, Floats] | None:
    """Return the first point along the step that is likely enough, its log-likelihood and gradient; or None."""
    low, high = problem.limits
    for halvings in range(_HALVINGS):
        moved: Floats = np.clip(theta + step * 0.5**halvings, low, high)
        if np.array_equal(moved, theta):
            return None
        reached, slope = problem.total(moved)
        rise = float(gradient @ (moved - theta))
        if math.isfinite(reached) and reached > value and reached >= value + _ARMIJO * rise:
            return moved, reached, slope
    return None


def report(problem: Problem, end: Climb, parameters: P, blocks: Integers | None, missing: int) -> PointFit[P]:
    """Build the fit from the end of a search."""
    values = problem.values(end.theta)
    independent = standard_errors(problem, end.theta, end.free)
    errors, held, touched = dict(independent), {}, dict.fromkeys(values, FEW_BLOCKS)
    notes, count = [] if end.converged else ["did not converge"], 0
    if blocks is not None:
        count, touched = int(blocks.max()) + 1, _blocks_of(problem, end, blocks)
        errors = standard_errors(problem, end.theta, end.free, blocks)
        notes += notes_on_blocks(count)
    for name, error in independent.items():
        if math.isnan(error):
            held[name] = "at a bound"
        elif error < math.inf and touched[name] < 2:
            held[name], errors[name] = "the readings that determine it are in one block", math.nan
    rough = [name for name, error in errors.items() if math.isfinite(error) and touched[name] < FEW_BLOCKS]
    if rough and count >= FEW_BLOCKS:
        notes.append(f"standard errors from fewer than {FEW_BLOCKS} blocks are rough: {shortened(rough)}")
    return PointFit(
        parameters=parameters,
        **common_fields(end.value, end.trace, end.converged, errors, held, notes, missing),
        independent_errors=independent,
        values=values,
        readings=problem.readings,
        blocks=count,
    )


def standard_errors(
    problem: Problem, theta: Floats, free: NDArray[np.bool_], blocks: Integers | None = None
) -> dict[str, float]:
    """Return the standard errors by name; NaN for parameters that depend only on coordinates at bounds."""
    rows = problem.jacobian(theta)[:, free]
    scatter = None
    if blocks is not None:
        size, gradients = int(blocks.max()) + 1, problem.log_p(theta)[1][:, free]
        scatter = scatter_of(np.stack([np.bincount(blocks, column, size) for column in gradients.T], axis=1))
    curve = -problem.hessian(theta, free)
    known = np.diag(curve) * problem.scales(theta)[free] ** 2
    rounded = known <= max(_ROUNDED * float(known.max(initial=0.0)), problem.least)
    curve[rounded], curve[:, rounded] = 0.0, 0.0
    errors = errors_of(curve, rows, scatter, problem.flat)
    errors[~rows.any(axis=1)] = math.nan
    return dict(zip(problem.values(theta), errors.tolist(), strict=True))


def _blocks_of(problem: Problem, end: Climb, blocks: Integers) -> dict[str, int]:
    """Return the least number of blocks that depend on a coordinate, for each parameter that it determines."""
    gradients, jacobian = problem.log_p(end.theta)[1], problem.jacobian(end.theta)
    counts = np.array([len(np.unique(blocks[column != 0])) for column in gradients.T])
    used = (jacobian != 0) & end.free
    least = np.where(used, counts, np.iinfo(np.int64).max).min(axis=1)
    return dict(zip(problem.values(end.theta), least.tolist(), strict=True))
