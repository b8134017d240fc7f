"""Fit the parameters of heading readings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats
from gpusense.learning.point.densities import von_mises, wrapped_normal
from gpusense.learning.point.problem import Problem, check_labels, mix, number_blocks, of_weight
from gpusense.learning.point.result import PointFit, report
from gpusense.learning.point.search import maximize
from gpusense.world.sensor_parameters import HeadingParameters

# Smallest and largest deviation [rad], and concentration, of a fit.
_SIGMAS, _KAPPAS = (1e-9, 20.0), (1e-9, 1e18)
_OFFSETS = 24


@dataclass(frozen=True, eq=False)
class _Headings(Problem):
    """Likelihood of headings by (log sigma or log kappa, z_rand, offset)."""

    per_reading: ClassVar[tuple[str, ...]] = ("turned",)
    turned: Floats
    kind: str

    def bounds(self) -> tuple[Floats, Floats]:
        low, high = _SIGMAS if self.kind == "wrapped_normal" else _KAPPAS
        return np.array([math.log(low), 0.0, -math.inf]), np.array([math.log(high), 1.0, math.inf])

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
    most = checks.integer("max_iterations", max_iterations, low=1)
    least = checks.real("tolerance", tolerance, above=0)
    pose = checks.array("poses", poses, ("F", 3), largest=checks.FARTHEST)
    z = checks.array("headings", headings, (len(pose),), finite=False, largest=checks.FARTHEST)
    labels = None if blocks is None else check_labels(blocks, len(pose))
    used = np.isfinite(z)
    if not used.any():
        raise ValueError(f"headings: must hold one that is finite, got {len(z)} without")
    numbers = number_blocks(None if labels is None else labels[used])
    turned = wrapped(wrapped(z[used]) - wrapped(pose[used, 2]))
    problem = _Headings(turned, kind)
    end = maximize(problem, most, least)
    values = problem.values(end.theta)
    offset = wrapped(values["offset"])
    end.theta[2] = offset
    parameters = HeadingParameters(**(values | {"offset": offset}), kind=kind)
    return report(problem, end, parameters, numbers, int((~used).sum()))
