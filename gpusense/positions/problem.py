"""Beacons and what was measured of them: residuals, their derivatives and the information they hold."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense.positions.closed_forms import EPS, Complexes, wrap
from gpusense.positions.fix import STATUSES, PositionFix

Floats = NDArray[np.float64]

# rho(z), rho'(z) and rho''(z) of the squared residual z, as scipy.optimize.least_squares names them.
LOSSES: dict[str, Callable[[Floats], tuple[Floats, Floats, Floats]]] = {
    "linear": lambda z: (z, np.ones_like(z), np.zeros_like(z)),
    "soft_l1": lambda z: (2 * z / (np.sqrt(1 + z) + 1), (1 + z) ** -0.5, -0.5 * (1 + z) ** -1.5),
    "huber": lambda z: (
        np.where(z <= 1, z, 2 * np.sqrt(z) - 1),
        np.maximum(z, 1.0) ** -0.5,
        np.where(z <= 1, 0.0, -0.5 * np.maximum(z, 1.0) ** -1.5),
    ),
    "cauchy": lambda z: (np.log1p(z), 1 / (1 + z), -1 / (1 + z) ** 2),
    "arctan": lambda z: (np.arctan(z), 1 / (1 + z * z), -2 * z / (1 + z * z) ** 2),
}
# A Jacobian is rounded to some 1e-16: a larger condition number is rounding.
SINGULAR = 1e12
# Nearer to a beacon, in the scene's spread, a robot stands at it: bad geometry makes that of some 1e-15 of rounding.
TOUCH = 1e-12
# Subsets of the beacons of which closed forms are taken to start from.
STARTS = 300


@dataclass(frozen=True, eq=False)
class Problem:
    """Measurements of M beacons that the weights leave, and what is looked for.

    Attributes:
        xy: (M, 2) beacons, relative to ``origin``.
        origin: (2,) in the world: what keeps the digits of beacons at UTM coordinates.
        ranges: (M,) or None.
        bearings: (M,) or None.
        heading: The known heading, or None.
        sigma_range: (M,) deviations.
        sigma_bearing: (M,) deviations.
        weights: (M,) factors > 0 of the squared residuals.
        loss: A name out of LOSSES.
        loss_scale: Where the loss bends, in sigmas.
        keep: (M',) which of the beacons that the caller gave are left.
    """

    xy: Floats
    origin: Floats
    ranges: Floats | None
    bearings: Floats | None
    heading: float | None
    sigma_range: Floats
    sigma_bearing: Floats
    weights: Floats
    loss: str
    loss_scale: float
    keep: NDArray[np.bool]

    @property
    def dimension(self) -> int:
        """2 for a position, 3 for a pose."""
        return 2 if self.bearings is None or self.heading is not None else 3

    @property
    def points(self) -> Complexes:
        """(M,) the beacons as complex numbers."""
        return self.xy[:, 0] + 1j * self.xy[:, 1]

    @property
    def spread(self) -> float:
        """A length of the scene: the largest distance of a beacon from their middle, or of a range."""
        reach = float(np.hypot(*(self.xy - self.xy.mean(axis=0)).T).max())
        return max(reach, 0.0 if self.ranges is None else float(self.ranges.max()))

    @functools.cached_property
    def touch(self) -> float:
        """Within this of a beacon the robot stands at it: the direction to it is rounding."""
        return max(TOUCH * self.spread, 4 * self.noise)

    def at_beacon(self, state: Floats) -> bool:
        """Whether the robot stands at a beacon."""
        return bool(np.hypot(*(self.xy - state[:2]).T).min() <= self.touch)

    @property
    def noise(self) -> float:
        """Rounding of the beacons' coordinates in the world, and of differences of them."""
        return 2 * EPS * float(np.abs(self.xy + self.origin).max())

    def residuals(self, states: Floats) -> Floats:
        """(S, M) or, for ranges and bearings, (S, 2 M): measured less expected, at (S, d) states."""
        offset = self.xy - states[:, None, :2]
        parts = []
        if self.ranges is not None:
            parts.append(self.ranges - np.hypot(offset[..., 0], offset[..., 1]))
        if self.bearings is not None:
            theta = states[:, 2:] if self.heading is None else self.heading
            parts.append(wrap(self.bearings + theta - np.arctan2(offset[..., 1], offset[..., 0])))
        return np.concatenate(parts, axis=1)

    def jacobian(self, state: Floats) -> Floats:
        """(R, d) derivatives of the expected measurements at one state; zero where the robot stands at the beacon."""
        dx, dy = (self.xy - state[:2]).T
        rho = np.hypot(dx, dy)
        known = rho > self.touch
        safe = np.where(known, rho, 1.0)
        cosine, sine = np.where(known, dx / safe, 0.0), np.where(known, dy / safe, 0.0)
        parts = []
        if self.ranges is not None:
            parts.append(np.column_stack([-cosine, -sine, np.zeros_like(rho)]))
        if self.bearings is not None:
            parts.append(np.column_stack([sine / safe, -cosine / safe, np.where(known, -1.0, 0.0)]))
        return np.concatenate(parts)[:, : self.dimension]

    @property
    def sigmas(self) -> Floats:
        """(R,) deviations of the measurements in the order of the residuals."""
        parts = [] if self.ranges is None else [self.sigma_range]
        return np.concatenate(parts if self.bearings is None else [*parts, self.sigma_bearing])

    @property
    def scales(self) -> Floats:
        """(R,) what turns residuals into those whose squares are added: sqrt(weight) / sigma."""
        both = self.ranges is not None and self.bearings is not None
        return np.sqrt(np.tile(self.weights, 2) if both else self.weights) / self.sigmas

    def rho(self, scaled: Floats) -> tuple[Floats, Floats]:
        """The loss of scaled residuals and the weight that it leaves them."""
        value, slope, _ = LOSSES[self.loss]((scaled / self.loss_scale) ** 2)
        return value * self.loss_scale**2, slope

    def costs(self, states: Floats) -> Floats:
        """(S,) sums of the losses."""
        return self.rho(self.residuals(states) * self.scales)[0].sum(axis=1)

    def information(self, state: Floats) -> tuple[Floats, float]:
        """Covariance of a solution and the condition number of its Jacobian.

        The estimate moves by A^-1 J^T V e for noise e in sigmas, with the weights V and A = J^T V J; so its
        covariance is A^-1 J^T V^2 J A^-1, which for V = 1 is the inverse of the information matrix. A robust
        loss's weights count as given.
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
        """The result for states in the order given.

        Args:
            states: (S, d) solutions.
            status: Of the best; "unique" and the like become "singular" where it is.
            flat: Whether the information is known to be singular, whatever rounding makes of it.
        """
        found = np.asarray(states, np.float64).reshape(-1, self.dimension)
        assert status in STATUSES
        pairs = [self.information(state) for state in found]
        if flat:
            pairs = [(np.full_like(covariance, np.nan), math.inf) for covariance, _ in pairs]
        singular = not pairs or not pairs[0][1] < SINGULAR
        if singular and status in ("unique", "two", "mirror", "ambiguous"):
            status = "singular"
        residuals = self.residuals(found)
        kinds = residuals.shape[1] // len(self.xy)
        # Beacons that are left out have residuals of NaN.
        blocks = np.full((len(found), kinds, len(self.keep)), np.nan)
        blocks[:, :, self.keep] = residuals.reshape(len(found), kinds, len(self.xy))
        world = found.copy()
        world[:, :2] += self.origin
        if self.dimension == 3:
            world[:, 2] = wrap(world[:, 2])
        return PositionFix(
            world,
            np.array([p[0] for p in pairs]).reshape(-1, self.dimension, self.dimension),
            blocks[:, 0] if kinds == 1 else blocks.swapaxes(1, 2),
            self.costs(found),
            np.array([p[1] for p in pairs], np.float64),
            status,
            singular,
        )


def deviations(name: str, sigma: ArrayLike | None, count: int) -> Floats:
    """(M,) deviations from one, M of them, or None, which stands for 1."""
    if sigma is None:
        return np.ones(count)
    values = checks.array(name, sigma)
    if values.shape not in ((), (count,)):
        raise ValueError(f"{name}: shape must be () or ({count},), got {checks.shape_text(values.shape)}")
    if values.size and not values.min() > 0:
        raise ValueError(f"{name}: must be > 0, got {values.min()}")
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
    """A checked problem without the beacons of weight 0.

    Raises:
        TypeError, ValueError: an argument breaks its rule.
    """
    places = checks.array("xy", xy, ("M", 2))
    count = len(places)
    values = {}
    for name, given in (("ranges", ranges), ("bearings", bearings)):
        values[name] = None if given is None else checks.array(name, given, (count,))
    lengths = values["ranges"]
    if lengths is not None and lengths.size and lengths.min() < 0:
        index = int(np.argmin(lengths))
        raise ValueError(f"ranges: must be >= 0, got {lengths[index]} at index {index}")
    known = None if heading is None else checks.real("heading", heading)
    sigma_r, sigma_b = deviations(names[0], sigma_range, count), deviations(names[1], sigma_bearing, count)
    factors = np.ones(count) if weights is None else checks.array("weights", weights, (count,))
    if factors.size and factors.min() < 0:
        raise ValueError(f"weights: must be >= 0, got {factors.min()} at index {int(np.argmin(factors))}")
    kind = checks.choice("loss", loss, tuple(LOSSES))
    bend = checks.real("loss_scale", loss_scale, above=0)
    keep = factors > 0
    if np.count_nonzero(keep) < least:
        noun = f"beacon{'s' * (least > 1)}"
        if count >= least:
            raise ValueError(f"weights: must be > 0 for at least {least} {noun}{reason}, got {np.count_nonzero(keep)}")
        raise ValueError(f"xy: must hold at least {least} {noun}{reason}, got {count}")
    places, factors = places[keep], factors[keep]
    # The middle of the box, rounded as little as the beacons are: differences of near numbers are exact.
    origin = places.min(axis=0) / 2 + places.max(axis=0) / 2
    return Problem(
        places - origin,
        origin,
        None if lengths is None else lengths[keep],
        None if values["bearings"] is None else values["bearings"][keep],
        known,
        sigma_r[keep],
        sigma_b[keep],
        factors,
        kind,
        bend,
        keep,
    )


def subsets(count: int, size: int) -> NDArray[np.intp]:
    """(N, size) index subsets of ``count`` beacons: all, or STARTS of them drawn with a fixed seed."""
    if math.comb(count, size) <= STARTS:
        return np.array(list(itertools.combinations(range(count), size)), np.intp).reshape(-1, size)
    rng = np.random.default_rng(0)
    return np.array([rng.choice(count, size, replace=False) for _ in range(STARTS)], np.intp)
