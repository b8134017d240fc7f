"""Fit the parameters of heading readings and of position fixes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats
from gpusense.learning.fitted import PointFit, number_blocks
from gpusense.learning.point.densities import von_mises, wrapped_normal
from gpusense.learning.point.problem import Problem, maximize, mix, of_weight, places_of, report
from gpusense.world.sensor_parameters import HeadingParameters, PositionParameters

_LOG_TWO_PI = math.log(2 * math.pi)
# Largest difference between fixes that are exact up to rounding [m].
_EXACT = 1e-12


@dataclass(frozen=True, eq=False)
class _Fixes(Problem):
    """Likelihood of fixes by z_rand, a whitening matrix ((a, 0), (b, c)), and the antenna's mount (x, y).

    Coordinates are log a, b and log c, or only log a for one deviation, where c = a and b = 0. b is in units of the
    spread's inverse. z_rand stays 0 without a region, and the mount stays fixed unless it is fitted.
    """

    per_reading: ClassVar[tuple[str, ...]] = ("errors", "cosines", "sines", "inside")
    errors: Floats
    cosines: Floats
    sines: Floats
    inside: NDArray[np.bool_]
    correlated: bool
    area: float | None
    mount: tuple[float, float]
    fit_mount: bool
    spread: float

    def bounds(self) -> list[tuple[float, float]]:
        scale, free = (-math.log(self.spread) - 14, -math.log(self.spread) + 7), (-math.inf, math.inf)
        rand = 0.0, 0.0 if self.area is None else 1.0
        return [rand, scale, *[free, scale] * self.correlated, *[free] * 2 * self.fit_mount]

    def scales(self, theta: Floats) -> Floats:
        sigma = math.exp(-theta[1])
        return np.array(
            [of_weight(theta[0]), 1.0, *[1 / self.spread, 1.0] * self.correlated, *[sigma] * 2 * self.fit_mount]
        )

    def starts(self) -> list[Floats]:
        starts = []
        for narrow, weight in ((1.0, 0.05), (0.3, 0.3), (0.1, 0.5), (3.0, 0.01)):
            log_a = -math.log(narrow * self.spread)
            shape = [log_a, 0.0, log_a] if self.correlated else [log_a]
            mount = list(self.mount) if self.fit_mount else []
            starts.append(np.array([weight if self.area is not None else 0.0, *shape, *mount]))
        return starts

    def log_p(self, theta: Floats) -> tuple[Floats, Floats]:
        x, y = self.errors.T
        c, s = self.cosines, self.sines
        if self.fit_mount:
            mx, my = theta[-2:]
            x, y = x - (c * mx - s * my), y - (s * mx + c * my)
        a, b, d = self._whitening(theta)
        u, v = a * x, b * x + d * y
        hit = math.log(a) + math.log(d) - _LOG_TWO_PI - 0.5 * (u * u + v * v)
        parts = [(1 - theta[0], hit)]
        if self.area is not None:
            parts.append((float(theta[0]), np.where(self.inside, -math.log(self.area), -math.inf)))
        log_p, shares, ratios = mix(parts)
        columns = [ratios[1] - ratios[0] if self.area is not None else np.zeros(len(x))]
        columns += [1 - u * u, -v * x, 1 - v * d * y] if self.correlated else [2 - u * u - v * v]
        if self.fit_mount:
            # -d hit / d error, along the rotated axes of the robot.
            g, h = a * u + b * v, d * v
            columns += [g * c + h * s, h * c - g * s]
        return log_p, np.stack([columns[0], *(shares[0] * column for column in columns[1:])], axis=1)

    def _whitening(self, theta: Floats) -> tuple[float, float, float]:
        a = math.exp(theta[1])
        return (a, float(theta[2]), math.exp(theta[3])) if self.correlated else (a, 0.0, a)

    def covariance(self, theta: Floats) -> Floats:
        """Return the (2, 2) covariance matrix, symmetric to the last bit."""
        a, b, d = self._whitening(theta)
        xx, xy = 1 / a**2, -b / (a * a * d)
        return np.array([[xx, xy], [xy, (b / (a * d)) ** 2 + 1 / d**2]])

    def values(self, theta: Floats) -> dict[str, float]:
        values = {"z_hit": 1 - float(theta[0]), "z_rand": float(theta[0])}
        if self.correlated:
            c = self.covariance(theta)
            values |= {
                "covariance_xx": float(c[0, 0]),
                "covariance_xy": float(c[0, 1]),
                "covariance_yy": float(c[1, 1]),
            }
        else:
            values["sigma"] = math.exp(-theta[1])
        return values | ({"mount_x": float(theta[-2]), "mount_y": float(theta[-1])} if self.fit_mount else {})


def fit_position_parameters(
    poses: ArrayLike,
    fixes: ArrayLike,
    *,
    correlated: bool = False,
    region: tuple[float, float, float, float] | None = None,
    mount: tuple[float, float] = (0.0, 0.0),
    fit_mount: bool = False,
    blocks: ArrayLike | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-8,
) -> PointFit[PositionParameters]:
    """Fit the parameters of position fixes at known poses, by maximum likelihood.

    The likelihood is :class:`PositionModel`'s.

    Args:
        poses: (F, 3) robot poses (x, y, theta) in the world [m, m, rad].
        fixes: (F, 2) measured x and y of the antenna [m]. A non-finite fix is missing.
        correlated: Whether to fit a covariance matrix instead of one deviation along x and y.
        region: Rectangle of outliers (x_min, y_min, x_max, y_max) in the world [m]; if set, their weight is fitted.
        mount: Position (x, y) of the antenna on the robot [m], or the start of its fit.
        fit_mount: Whether to fit the mount, which requires varying headings.
        blocks: None, or (F,) integer labels of fixes whose errors are correlated, for standard errors.
        max_iterations: Largest number of iterations of a search.
        tolerance: The search has converged once it expects to gain less than ``tolerance`` [nats].

    Returns:
        The fit. Entries of a covariance matrix are named ``covariance_xx``, ``covariance_xy`` and ``covariance_yy``.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A value breaks a rule above, the shapes differ, or there is no reading.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> rng = np.random.default_rng(0)
        >>> poses = rng.uniform((0, 0, -3), (50, 50, 3), (900, 3))
        >>> fit = gs.fit_position_parameters(poses, poses[:, :2] + rng.normal(0, 2, (900, 2)))
        >>> fit.converged, round(fit.parameters.sigma, 1)
        (True, 2.0)
    """
    correlated, fit_mount = checks.boolean("correlated", correlated), checks.boolean("fit_mount", fit_mount)
    base = PositionParameters(region=region, mount=mount)
    pose = checks.array("poses", poses, ("F", 3), largest=checks.FARTHEST)
    z = checks.array("fixes", fixes, (len(pose), 2), finite=False, largest=checks.FARTHEST)
    used = np.isfinite(z).all(axis=1)
    if not used.any():
        raise ValueError(f"fixes: must hold one that is finite, got {len(z)} without")
    area, inside = None, np.zeros(int(used.sum()), bool)
    if base.region is not None:
        x, y, far_x, far_y = base.region
        area, inside = (far_x - x) * (far_y - y), ((z[used] >= (x, y)) & (z[used] <= (far_x, far_y))).all(axis=1)
    numbers = number_blocks(blocks, (len(pose),), used)
    start = base.mount
    errors = z[used] - places_of(pose[used], (0.0, 0.0) if fit_mount else start)
    shown = errors if not fit_mount else z[used] - places_of(pose[used], start)
    if np.abs(shown).max() <= _EXACT:
        raise ValueError(
            f"fixes: must differ from the places at the poses, got {len(shown)} equal ones: no noise is left"
        )
    spread = 1.4826 * float(np.median(np.abs(shown))) or float(np.abs(shown).max()) or 1e-6
    heading = pose[used, 2]
    problem = _Fixes(errors, np.cos(heading), np.sin(heading), inside, correlated, area, start, fit_mount, spread)
    end = maximize(problem, max_iterations, tolerance)
    c = problem.covariance(end.theta)
    noise = dict(covariance=c) if correlated else dict(sigma=float(math.exp(-end.theta[1])))
    rand = float(end.theta[0])
    at = (float(end.theta[-2]), float(end.theta[-1])) if fit_mount else start
    parameters = PositionParameters(**noise, z_hit=1 - rand, z_rand=rand, region=base.region, mount=at)
    return report(problem, end, parameters, numbers, int((~used).sum()))


# Smallest and largest deviation [rad], and concentration, of a fit.
_SIGMAS, _KAPPAS = (1e-9, 20.0), (1e-9, 1e18)
_OFFSETS = 24


@dataclass(frozen=True, eq=False)
class _Headings(Problem):
    """Likelihood of headings by (log sigma or log kappa, z_rand, offset)."""

    per_reading: ClassVar[tuple[str, ...]] = ("turned",)
    turned: Floats
    kind: str

    def bounds(self) -> list[tuple[float, float]]:
        low, high = _SIGMAS if self.kind == "wrapped_normal" else _KAPPAS
        return [(math.log(low), math.log(high)), (0.0, 1.0), (-math.inf, math.inf)]

    def scales(self, theta: Floats) -> Floats:
        sigma = math.exp(theta[0]) if self.kind == "wrapped_normal" else math.exp(-0.5 * theta[0])
        return np.array([1.0, of_weight(theta[1]), min(sigma, 0.5)])

    def starts(self) -> list[Floats]:
        starts = []
        mean = math.atan2(float(np.sin(self.turned).mean()), float(np.cos(self.turned).mean()))
        for around in (mean, *np.linspace(-math.pi, math.pi, _OFFSETS, endpoint=False)):
            residual = wrapped(self.turned - around)
            near = residual[np.abs(residual) < math.pi / 6] if around != mean else residual
            offset = around + float(np.median(near)) if len(near) else around
            spread = 1.4826 * float(np.median(np.abs(wrapped(self.turned - offset))))
            for sigma, weight in ((spread, 0.05), (0.3 * spread, 0.3), (0.1 * spread, 0.5)):
                sigma = min(max(sigma, 1e-6), 3.0)
                shape = math.log(sigma) * (1 if self.kind == "wrapped_normal" else -2)
                starts.append(np.array([shape, weight, offset]))
        return starts

    def log_p(self, theta: Floats) -> tuple[Floats, Floats]:
        density = wrapped_normal if self.kind == "wrapped_normal" else von_mises
        hit, by_shape, by_offset = density(wrapped(self.turned - theta[2]), math.exp(theta[0]))
        rand = np.full(len(hit), -math.log(2 * math.pi))
        log_p, shares, ratios = mix([(1 - theta[1], hit), (theta[1], rand)])
        return log_p, np.stack([shares[0] * by_shape, ratios[1] - ratios[0], shares[0] * by_offset], axis=1)

    def values(self, theta: Floats) -> dict[str, float]:
        shape = "sigma" if self.kind == "wrapped_normal" else "kappa"
        rand = float(theta[1])
        return {shape: math.exp(theta[0]), "z_hit": 1 - rand, "z_rand": rand, "offset": float(theta[2])}


def fit_heading_parameters(
    poses: ArrayLike,
    headings: ArrayLike,
    *,
    kind: Literal["wrapped_normal", "von_mises"] = "wrapped_normal",
    blocks: ArrayLike | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-8,
) -> PointFit[HeadingParameters]:
    """Fit the parameters of heading readings at known poses, by maximum likelihood.

    The likelihood is :class:`HeadingModel`'s; deviation or concentration, weights and offset are fitted. Starts are
    spread over the full circle.

    Args:
        poses: (F, 3) robot poses (x, y, theta) [m, m, rad].
        headings: (F,) readings [rad], any number of turns. NaN and infinities are missing.
        kind: Distribution of correct readings, as in :class:`HeadingParameters`.
        blocks: None, or (F,) integer labels of readings whose errors are correlated, for standard errors.
        max_iterations: Largest number of iterations of a search.
        tolerance: The search has converged once it expects to gain less than ``tolerance`` [nats].

    Returns:
        The fit; its offset is in (-pi, pi].

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A value breaks a rule above, the shapes differ, or there is no reading.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> rng = np.random.default_rng(0)
        >>> poses = rng.uniform(-3, 3, (800, 3))
        >>> fit = gs.fit_heading_parameters(poses, poses[:, 2] + 0.5 + rng.vonmises(0, 25, 800), kind="von_mises")
        >>> fit.converged, round(fit.parameters.offset, 1), abs(fit.parameters.kappa / 25 - 1) < 0.1
        (True, 0.5, True)
    """
    checks.choice("kind", kind, ("wrapped_normal", "von_mises"))
    pose = checks.array("poses", poses, ("F", 3), largest=checks.FARTHEST)
    z = checks.array("headings", headings, (len(pose),), finite=False, largest=checks.FARTHEST)
    used = np.isfinite(z)
    if not used.any():
        raise ValueError(f"headings: must hold one that is finite, got {len(z)} without")
    numbers = number_blocks(blocks, (len(pose),), used)
    turned = wrapped(wrapped(z[used]) - wrapped(pose[used, 2]))
    problem = _Headings(turned, kind)
    end = maximize(problem, max_iterations, tolerance)
    values = problem.values(end.theta)
    offset = wrapped(values["offset"])
    end.theta[2] = offset
    parameters = HeadingParameters(**(values | {"offset": offset}), kind=kind)
    return report(problem, end, parameters, numbers, int((~used).sum()))
