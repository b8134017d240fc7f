"""Measurements of beacons: residuals, their derivatives, costs and information."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats
from gpusense.positions.fix import EPS, STATUSES, Complexes, PositionFix, wrap
from gpusense.world.plausible import look_at_bearings

# rho(z) and rho'(z) of the squared residual z, by the names of scipy.optimize.least_squares.
LOSSES: dict[str, Callable[[Floats], tuple[Floats, Floats]]] = {
    "linear": lambda z: (z, np.ones_like(z)),
    "soft_l1": lambda z: (2 * z / (np.sqrt(1 + z) + 1), (1 + z) ** -0.5),
    "huber": lambda z: (np.where(z <= 1, z, 2 * np.sqrt(z) - 1), np.maximum(z, 1.0) ** -0.5),
    "cauchy": lambda z: (np.log1p(z), 1 / (1 + z)),
    "arctan": lambda z: (np.arctan(z), 1 / (1 + z * z)),
}
# Least condition number of a singular Jacobian, given rounding errors of about 1e-16.
SINGULAR = 1e12
# A robot within this share of the scene's spread is at the beacon: bad geometry amplifies rounding of 1e-15 to this.
TOUCH = 1e-12
# Limits of deviations, scales of losses and weights; their squares stay far within float64.
_SMALL, _LARGE = 1e-12, 1e12
# Differences of coordinates below this are 0 [m].
_SAME_PLACE = 1e-100
# Largest number of subsets of beacons whose closed forms are starts.
STARTS = 300


@dataclass(frozen=True, eq=False)
class Problem:
    """Measurements of M beacons of positive weight, and the unknowns: a position or a pose."""

    xy: Floats  # (M, 2) beacons relative to ``origin`` [m]
    origin: Floats  # (2,) origin in the world [m]; it keeps all digits of UTM coordinates
    ranges: Floats  # (M,), or (0,) if they were not measured [m]
    bearings: Floats  # (M,), or (0,) if they were not measured [rad]
    heading: float | None  # the known heading, or None [rad]
    sigma_range: Floats  # standard deviations of the ranges [m]
    sigma_bearing: Floats  # standard deviations of the bearings [rad]
    weights: Floats  # (M,) factors > 0 of the squared residuals
    loss: str  # name of one of LOSSES
    loss_scale: float  # residual at which the loss bends [sigma]
    used: NDArray[np.bool]  # (M',) mask of the caller's beacons that are in ``xy``

    @property
    def dimension(self) -> int:
        """Number of unknowns: 2 for a position, 3 for a pose."""
        return 3 if self.bearings.size and self.heading is None else 2

    @property
    def points(self) -> Complexes:
        """(M,) beacons as complex numbers."""
        return self.xy[:, 0] + 1j * self.xy[:, 1]

    @property
    def spread(self) -> float:
        """Length scale of the scene: the largest distance of a beacon from the mean, or the largest range."""
        reach = np.hypot(*(self.xy - self.xy.mean(axis=0)).T).max()
        return float(self.ranges.max(initial=reach))

    @functools.cached_property
    def touch(self) -> float:
        """Largest distance of a robot at a beacon; closer, the beacon's direction is rounding error."""
        return max(TOUCH * self.spread, 4 * self.noise)

    def at_beacon(self, state: Floats) -> bool:
        """Return whether the robot is at a beacon."""
        return bool(np.hypot(*(self.xy - state[:2]).T).min() <= self.touch)

    @property
    def noise(self) -> float:
        """Rounding error of the beacons' coordinates in the world, and of their differences."""
        return 2 * EPS * float(np.abs(self.xy + self.origin).max())

    def residuals(self, states: Floats) -> Floats:
        """Return measured less expected values at (S, d) states: (S, M), or (S, 2 M) for ranges and bearings."""
        offset = self.xy - states[:, None, :2]
        parts = []
        if self.ranges.size:
            parts.append(self.ranges - np.hypot(offset[..., 0], offset[..., 1]))
        if self.bearings.size:
            theta = states[:, 2:] if self.heading is None else self.heading
            parts.append(wrap(self.bearings + theta - np.arctan2(offset[..., 1], offset[..., 0])))
        return np.concatenate(parts, axis=1)

    def jacobian(self, state: Floats) -> Floats:
        """Return the (R, d) derivatives of the expected measurements at a state; 0 for a robot at the beacon."""
        dx, dy = (self.xy - state[:2]).T
        rho = np.hypot(dx, dy)
        known = rho > self.touch
        safe = np.where(known, rho, 1.0)
        cosine, sine = np.where(known, dx / safe, 0.0), np.where(known, dy / safe, 0.0)
        parts = []
        if self.ranges.size:
            parts.append(np.column_stack([-cosine, -sine, np.zeros_like(rho)]))
        if self.bearings.size:
            parts.append(np.column_stack([sine / safe, -cosine / safe, np.where(known, -1.0, 0.0)]))
        return np.concatenate(parts)[:, : self.dimension]

    @property
    def sigmas(self) -> Floats:
        """(R,) standard deviations of the measurements in the order of the residuals."""
        return np.concatenate([self.sigma_range, self.sigma_bearing])

    @property
    def scales(self) -> Floats:
        """(R,) factors sqrt(weight) / sigma of the residuals in the cost."""
        return np.sqrt(np.resize(self.weights, self.sigmas.shape)) / self.sigmas

    def rho(self, scaled: Floats) -> tuple[Floats, Floats]:
        """Return the losses of scaled residuals, and their weights under a robust loss."""
        value, slope = LOSSES[self.loss]((scaled / self.loss_scale) ** 2)
        return value * self.loss_scale**2, slope

    def costs(self, states: Floats) -> Floats:
        """Return (S,) sums of the losses at (S, d) states."""
        return self.rho(self.residuals(states) * self.scales)[0].sum(axis=1)

    def information(self, state: Floats) -> tuple[Floats, float]:
        """Return the covariance of a solution and the condition number of its Jacobian.

        Noise e in sigmas moves the estimate by A^-1 J^T V e, with the weights V and A = J^T V J. The covariance is
        therefore A^-1 J^T V^2 J A^-1; for V = 1 it is the inverse of the information matrix. Weights of a robust loss
        count as constants.
        """
        scaled = self.residuals(state[None])[0] * self.scales
        weight = (self.scales * self.sigmas) ** 2 * self.rho(scaled)[1]
        rows = self.jacobian(state) / self.sigmas[:, None]
        balance = np.ones(self.dimension)
        if self.dimension == 3:
            place, turn = np.linalg.norm(rows[:, :2]), np.linalg.norm(rows[:, 2])
            balance[2] = place / math.sqrt(2) / turn if place > 0 and turn > 0 else 1.0
        root = np.sqrt(weight)
        left, values, right = np.linalg.svd(rows * balance * root[:, None], full_matrices=False)
        condition = float(values[0] / values[-1]) if len(values) == self.dimension and values[-1] > 0 else math.inf
        if not condition < SINGULAR:
            return np.full((self.dimension, self.dimension), np.nan), condition
        # A^-1 J^T V = pinv(V^1/2 J) V^1/2.
        gain = (right.T / values) @ left.T * root * balance[:, None]
        return gain @ gain.T, condition

    def fix(self, states: Sequence[Floats] | Floats, status: str, *, flat: bool = False) -> PositionFix:
        """Make the result for (S, d) solutions, the best first; ``flat``: their information is known to be singular."""
        solutions = np.asarray(states, np.float64).reshape(-1, self.dimension)
        assert status in STATUSES
        pairs = [self.information(state) for state in solutions]
        if flat:
            pairs = [(np.full_like(covariance, np.nan), math.inf) for covariance, _ in pairs]
        singular = not pairs or not pairs[0][1] < SINGULAR
        if singular and status in ("unique", "two", "mirror", "ambiguous"):
            status = "singular"
        residuals = self.residuals(solutions)
        kinds = residuals.shape[1] // len(self.xy)
        # Residuals of beacons of weight 0 are NaN.
        blocks = np.full((len(solutions), kinds, len(self.used)), np.nan)
        blocks[:, :, self.used] = residuals.reshape(len(solutions), kinds, len(self.xy))
        world = solutions.copy()
        world[:, :2] += self.origin
        if self.dimension == 3:
            world[:, 2] = wrap(world[:, 2])
        return PositionFix(
            world,
            np.array([p[0] for p in pairs]).reshape(-1, self.dimension, self.dimension),
            blocks[:, 0] if kinds == 1 else blocks.swapaxes(1, 2),
            self.costs(solutions),
            np.array([p[1] for p in pairs], np.float64),
            status,
            singular,
        )


def deviations(name: str, sigma: ArrayLike | None, count: int) -> Floats:
    """Return (M,) standard deviations from one number, M numbers, or None for 1."""
    if sigma is None:
        return np.ones(count)
    values = checks.array(name, sigma)
    if values.shape not in ((), (count,)):
        raise ValueError(f"{name}: shape must be () or ({count},), got {checks.shape_text(values.shape)}")
    if values.size and not values.min() > 0:
        raise ValueError(f"{name}: must be > 0, got {values.min()}")
    if values.size and not (values.min() >= _SMALL and values.max() <= _LARGE):
        worst = values.min() if values.min() < _SMALL else values.max()
        raise ValueError(f"{name}: must be from {_SMALL:g} to {_LARGE:g}, got {worst}")
    return np.broadcast_to(values, (count,)).astype(np.float64)


def make_problem(
    xy: ArrayLike,
    *,
    ranges: ArrayLike | None = None,
    bearings: ArrayLike | None = None,
    heading: float | None = None,
    sigma_range: ArrayLike | None = None,
    sigma_bearing: ArrayLike | None = None,
    names: tuple[str, str] = ("sigma", "sigma"),
    weights: ArrayLike | None = None,
    loss: str = "linear",
    loss_scale: float = 1.0,
    least: int = 1,
    reason: str = "",
) -> Problem:
    """Check the arguments of a public function and make a problem without the beacons of weight 0."""
    positions = checks.array("xy", xy, ("M", 2), largest=checks.FARTHEST)
    count = len(positions)
    none = np.zeros(0)
    distances = none if ranges is None else _not_negative("ranges", ranges, count, checks.FARTHEST)
    angles = none if bearings is None else checks.array("bearings", bearings, (count,), largest=checks.FARTHEST)
    look_at_bearings("bearings", angles)
    theta = None if heading is None else checks.real("heading", heading)
    if theta is not None:
        checks.array("heading", theta, largest=checks.FARTHEST)
    sigma_r = none if ranges is None else deviations(names[0], sigma_range, count)
    sigma_b = none if bearings is None else deviations(names[1], sigma_bearing, count)
    factors = np.ones(count) if weights is None else _not_negative("weights", weights, count, _LARGE)
    loss = checks.choice("loss", loss, tuple(LOSSES))
    loss_scale = checks.real("loss_scale", checks.real("loss_scale", loss_scale, above=0), low=_SMALL, high=_LARGE)
    used = factors > 0
    number, rule = int(np.count_nonzero(used)), f"at least {least} beacon{'s' * (least > 1)}{reason}"
    if count < least:
        raise ValueError(f"xy: must hold {rule}, got {count}")
    if number < least:
        raise ValueError(f"weights: must be > 0 for {rule}, got {number}")
    positions, factors = positions[used], factors[used]
    # The middle of the box has the same spacing of floats as the beacons, so that differences are exact.
    origin = positions.min(axis=0) / 2 + positions.max(axis=0) / 2
    relative = positions - origin
    relative[np.abs(relative) < _SAME_PLACE] = 0.0
    distances, angles, sigma_r, sigma_b = (
        one[used] if len(one) else one for one in (distances, angles, sigma_r, sigma_b)
    )
    return Problem(relative, origin, distances, angles, theta, sigma_r, sigma_b, factors, loss, loss_scale, used)


def _not_negative(name: str, values: ArrayLike, count: int, largest: float) -> Floats:
    """Return (M,) numbers from 0 to ``largest``."""
    checked = checks.array(name, values, (count,), largest=largest)
    if checked.size and checked.min() < 0:
        raise ValueError(f"{name}: must be >= 0, got {checked.min()} at index {int(np.argmin(checked))}")
    return checked


def subsets(count: int, size: int) -> NDArray[np.intp]:
    """Return (N, size) index subsets of ``count`` beacons: all, or STARTS drawn with a fixed seed."""
    if math.comb(count, size) <= STARTS:
        return np.array(list(itertools.combinations(range(count), size)), np.intp).reshape(-1, size)
    rng = np.random.default_rng(0)
    return np.array([rng.choice(count, size, replace=False) for _ in range(STARTS)], np.intp)
