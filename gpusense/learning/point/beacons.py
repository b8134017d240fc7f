"""Fit the parameters of ranges to beacons."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers
from gpusense.learning.fitted import PointFit, number_blocks
from gpusense.learning.point.densities import half_sample_mode, truncated
from gpusense.learning.point.problem import Problem, maximize, mix, of_weight, places_of, report
from gpusense.world.hit_shapes import NORMAL, StudentHit
from gpusense.world.range_causes import RandomDensity
from gpusense.world.sensor_parameters import MOST_DEGREES, BeaconParameters

BiasKind = Literal["none", "common", "each"]


@dataclass(frozen=True, eq=False)
class _Beacons(Problem):
    """Likelihood of ranges by (log sigma, z_rand[, log sigma_heavy, heavy_weight][, biases])."""

    per_reading: ClassVar[tuple[str, ...]] = ("ranges", "distances", "ids")
    ranges: Floats
    distances: Floats
    ids: Integers
    kind: str
    nu: int | None
    range_max: float
    biases: int
    spread: float

    @property
    def _first(self) -> int:
        return 4 if self.kind == "mixture" else 2

    def bounds(self) -> list[tuple[float, float]]:
        sigma = math.log(max(1e-3 * self.spread, 1e-9 * self.range_max)), math.log(self.range_max)
        return [sigma, (0.0, 1.0)] * (self._first // 2) + [(-self.range_max, self.range_max)] * self.biases

    def scales(self, theta: Floats) -> Floats:
        heavy = [1.0, of_weight(theta[3])] if self.kind == "mixture" else []
        return np.array([1.0, of_weight(theta[1]), *heavy, *[math.exp(theta[0])] * self.biases])

    def starts(self) -> list[Floats]:
        residual = self.ranges - self.distances
        mode = half_sample_mode(residual)
        centre = float(np.median(residual))
        starts = []
        for bias in sorted({centre, mode}) if self.biases else [0.0]:
            spread = 1.4826 * float(np.median(np.abs(residual - bias))) or self.spread
            each = [float(np.median(residual[self.ids == i])) if (self.ids == i).any() else bias
                    for i in range(self.biases)] if self.biases > 1 else [bias] * self.biases  # fmt: skip
            for narrow, weight in ((1.0, 0.05), (0.3, 0.3), (0.1, 0.5), (3.0, 0.01)):
                heavy = [math.log(4 * narrow * spread), 0.2] if self.kind == "mixture" else []
                starts.append(np.array([math.log(narrow * spread), weight, *heavy, *each]))
        return starts

    def ordered(self, theta: Floats) -> Floats:
        """See Problem.ordered: the narrow normal is first; a normal of weight 0 is last and repeats sigma."""
        if self.kind != "mixture":
            return theta
        ordered = theta.copy()
        if theta[3] == 1 or (theta[3] > 0 and theta[0] > theta[2]):
            ordered[[0, 2]], ordered[3] = theta[[2, 0]], 1 - theta[3]
        if ordered[3] == 0:
            ordered[2] = ordered[0]
        return ordered

    def log_p(self, theta: Floats) -> tuple[Floats, Floats]:
        biases = theta[self._first :]
        bias = biases[self.ids] if self.biases > 1 else float(biases.sum())
        mean = self.distances + bias
        residual = (self.ranges - self.distances) - bias
        rand, weights = theta[1], [1 - theta[3], theta[3]] if self.kind == "mixture" else [1.0]
        shape = NORMAL if self.nu is None else StudentHit(self.nu)
        hits = [truncated(residual, mean, self.range_max, math.exp(scale), shape) for scale in theta[: self._first : 2]]
        first, *heavy = (((1 - rand) * weight, hit[0]) for weight, hit in zip(weights, hits, strict=True))
        flat = np.full(len(mean), RandomDensity(self.range_max).log_peak(1.0))
        log_p, shares, ratios = mix([first, (rand, flat), *heavy])
        gradient, hit_shares, hit_ratios = np.zeros((len(mean), len(theta))), shares[::2], ratios[::2]
        for column, share, hit in zip((0, 2), hit_shares, hits, strict=False):
            gradient[:, column] = share * hit[1]
        gradient[:, 1] = ratios[1] - sum(weight * ratio for weight, ratio in zip(weights, hit_ratios, strict=True))
        if heavy:
            gradient[:, 3] = (1 - rand) * (hit_ratios[1] - hit_ratios[0])
        by_bias = sum(share * hit[2] for share, hit in zip(hit_shares, hits, strict=True))
        if self.biases:
            place = self.ids if self.biases > 1 else np.zeros(len(mean), np.int64)
            gradient[np.arange(len(mean)), self._first + place] = by_bias
        return log_p, gradient

    def values(self, theta: Floats) -> dict[str, float]:
        values = {"sigma_range": math.exp(theta[0])}
        if self.kind == "mixture":
            values |= {"sigma_heavy": math.exp(theta[2]), "heavy_weight": float(theta[3])}
        values |= {"z_hit": 1 - float(theta[1]), "z_rand": float(theta[1])}
        biases = theta[self._first :]
        if self.biases == 1:
            return values | {"bias": float(biases[0])}
        return values | {f"bias[{i}]": float(bias) for i, bias in enumerate(biases)}


def fit_beacon_parameters(
    poses: ArrayLike,
    ranges: ArrayLike,
    xy: ArrayLike,
    *,
    ids: ArrayLike | None = None,
    range_max: float = 100.0,
    kind: Literal["normal", "student_t", "mixture"] = "normal",
    nu: int = 4,
    bias: BiasKind = "common",
    mount: tuple[float, float] = (0.0, 0.0),
    blocks: ArrayLike | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-8,
) -> PointFit[BeaconParameters]:
    """Fit the parameters of ranges to beacons to readings at known poses, by maximum likelihood.

    The likelihood is :class:`BeaconModel`'s. Deviations, weights and offsets are fitted; the degrees of freedom of a
    Student t are fixed. In a mixture sigma_range is at most sigma_heavy. If one normal suffices, heavy_weight is 0 and
    sigma_heavy equals sigma_range. Starts come from the median and the densest part of the residuals, which resist
    outliers.

    Args:
        poses: (S, 3) robot poses [m, m, rad], or (F, 3) with ``ids``.
        ranges: (S, M) ranges from each pose to all beacons [m], or (F,) with ``ids``. NaN, and values outside
            [0, range_max], are missing.
        xy: (M, 2) positions of the beacons in the world [m].
        ids: None, or (F,) indices of the beacons that the ranges belong to.
        range_max: Longest range that the radio can report, > 0 [m].
        kind: Distribution of correct ranges, as in :class:`BeaconParameters`.
        nu: Degrees of freedom of ``"student_t"``, 1 to 100 [1].
        bias: ``"common"`` fits one offset of all ranges, ``"each"`` an offset per beacon, ``"none"`` keeps it at 0.
        mount: The antenna's position (x, y) on the robot [m].
        blocks: None, or (S,) or (F,) integer labels of poses whose errors are correlated, for standard errors.
        max_iterations: Largest number of iterations of a search.
        tolerance: The search has converged once it expects to gain less than ``tolerance`` [nats].

    Returns:
        The fit. Errors of offsets for each beacon are named ``bias[0]``, ``bias[1]``, ...

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A value breaks a rule above, the shapes differ, or there is no reading.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> rng, xy = np.random.default_rng(0), np.array([(0.0, 0.0), (9.0, 0.0), (0.0, 9.0)])
        >>> poses = rng.uniform((0, 0, -3), (9, 9, 3), (500, 3))
        >>> d = np.hypot(*(poses[:, None, :2] - xy).transpose(2, 0, 1))
        >>> fit = gs.fit_beacon_parameters(poses, d + rng.normal(0.3, 0.1, d.shape), xy)
        >>> fit.converged, round(fit.parameters.bias, 1), round(fit.parameters.sigma_range, 2)
        (True, 0.3, 0.1)
    """
    checks.choice("kind", kind, ("normal", "student_t", "mixture"))
    checks.choice("bias", bias, ("none", "common", "each"))
    degrees = checks.integer("nu", nu, low=1, high=MOST_DEGREES)
    longest = checks.real("range_max", range_max, above=0, high=checks.FARTHEST)
    points = checks.array("xy", xy, ("M", 2), largest=checks.FARTHEST)
    pose, z, index = _readings(poses, ranges, len(points), ids)
    antenna = places_of(pose, mount)
    distances = np.hypot(*(points[index[1]] - antenna[index[0]]).T)
    used = (z >= 0) & (z <= longest)
    if not used.any():
        raise ValueError(f"ranges: must hold one in [0, {longest:g}] m, got {len(z)} without")
    numbers = number_blocks(blocks, (len(pose),), index[0][used])
    residual = z[used] - distances[used]
    spread = 1.4826 * float(np.median(np.abs(residual - np.median(residual)))) or float(np.ptp(residual))
    problem = _Beacons(
        z[used], distances[used], index[1][used], kind, degrees if kind == "student_t" else None, longest,
        {"none": 0, "common": 1, "each": len(points)}[bias], spread or 1e-6 * longest,
    )  # fmt: skip
    end = maximize(problem, max_iterations, tolerance)
    values = {name: value for name, value in problem.values(end.theta).items() if not name.startswith("bias")}
    biases = tuple(end.theta[problem._first :].tolist())
    parameters = BeaconParameters(
        **values,
        bias=biases if len(biases) > 1 else sum(biases, 0.0),
        kind=kind,
        nu=degrees,
        range_max=longest,
        mount=mount,
    )
    return report(problem, end, parameters, numbers, int((~used).sum()))


def _readings(poses: ArrayLike, ranges: ArrayLike, beacons: int, ids: object) -> tuple[Floats, Floats, list[Integers]]:
    """Return the poses, (n,) ranges, and the index of each range's pose and beacon."""
    if ids is None:
        pose = checks.array("poses", poses, ("S", 3), largest=checks.FARTHEST)
        table = checks.array("ranges", ranges, (len(pose), beacons), finite=False)
        rows, columns = (each.ravel().astype(np.int64) for each in np.indices(table.shape))
        return pose, table.ravel(), [rows, columns]
    columns = checks.indices("ids", ids, beacons, ("F",))
    pose = checks.array("poses", poses, (len(columns), 3), largest=checks.FARTHEST)
    z = checks.array("ranges", ranges, (len(columns),), finite=False)
    return pose, z, [np.arange(len(columns)), columns]
