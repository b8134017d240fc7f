"""Log densities of residuals with their derivatives: truncated normals and Student's t, wrapped normals, von Mises."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from gpusense._util.typing import Floats
from gpusense.world.hit_shapes import HitShape

Limits: TypeAlias = tuple[tuple[float, float], ...]

# Relative step of numerical derivatives by a coordinate of the shape.
_SHAPE_STEP = 1e-4

_LOG_ROOT_TWO_PI = 0.5 * math.log(2 * math.pi)
# Up to this deviation a wrapped normal is a sum of normals, above it a Fourier series, as in ``HeadingModel``.
_WIDEST_SUM, _WRAPS, _WAVES = 1.5, 3, 6


def truncated(
    residual: Floats, mean: Floats, range_max: float, scale: float | Floats, shape: HitShape
) -> tuple[Floats, Floats, Floats]:
    """Return (n,) log densities of hits truncated to [0, range_max], and their derivatives by log scale and mean [1/m].

    ``residual`` is range minus mean [m], and ``mean`` not yet clamped to [0, range_max].
    """
    near = np.clip(mean, 0, range_max)
    u, x_0, x_1 = residual / scale, near / scale, (range_max - near) / scale
    pull, mass = shape.slope(u), shape.half_mass(x_0) + shape.half_mass(x_1)
    edges = [np.exp(shape.log_pdf(x)) for x in (x_0, x_1)]
    log_p = shape.log_pdf(u) - np.log(scale) - np.log(mass)
    by_scale = u * pull - 1 + (x_0 * edges[0] + x_1 * edges[1]) / mass
    by_mean = (pull + np.where(near == mean, (edges[1] - edges[0]) / mass, 0)) / scale
    return log_p, by_scale, by_mean


def by_shape(
    u: Floats, near: Floats, far: Floats, at: Floats, make: Callable[[Floats], HitShape], limits: Limits
) -> list[Floats]:
    """Return the derivatives of the log density of truncated hits by the coordinates of their shape, by differences.

    Distances in scales: ``u`` from the mean, ``near`` from 0 to the mean, ``far`` from the mean to range_max.
    """
    columns: list[Floats] = []
    for place, (low, high) in enumerate(limits):
        step = _SHAPE_STEP * min(at[place], 1.0)
        ends = [np.where(np.arange(len(at)) == place, np.clip(at + each, low, high), at) for each in (-step, step)]
        before, after = (
            shape.log_pdf(u) - np.log(shape.half_mass(near) + shape.half_mass(far)) for shape in map(make, ends)
        )
        columns.append((after - before) / (ends[1][place] - ends[0][place]))
    return columns


def wrapped_normal(residual: Floats, sigma: float) -> tuple[Floats, Floats, Floats]:
    """Return the log density of a wrapped normal at (n,) residuals, its derivatives by log sigma and mean [1/rad]."""
    if sigma > _WIDEST_SUM:
        n = np.arange(1, _WAVES + 1)
        wave = 2 * np.exp(-0.5 * np.minimum(n * sigma, 1e3) ** 2)
        angle = residual[:, None] * n
        density = 1 + np.cos(angle) @ wave
        by_sigma = -(np.cos(angle) @ (wave * (n * sigma) ** 2)) / density
        return np.log(density) - math.log(2 * math.pi), by_sigma, (np.sin(angle) @ (wave * n)) / density
    u = (residual[:, None] + 2 * math.pi * np.arange(-_WRAPS, _WRAPS + 1)) / sigma
    logs = -0.5 * u * u
    top = np.logaddexp.reduce(logs, axis=1)
    share = np.exp(logs - top[:, None])
    log_p = top - _LOG_ROOT_TWO_PI - math.log(sigma)
    return log_p, (share * u * u).sum(axis=1) - 1, (share * u).sum(axis=1) / sigma


def von_mises(residual: Floats, kappa: float) -> tuple[Floats, Floats, Floats]:
    """Return the log density of a von Mises distribution, its derivatives by log kappa, and by the mean [1/rad]."""
    from scipy.special import i0e, i1e

    drop = 2 * np.sin(residual / 2) ** 2
    log_p = -kappa * drop - math.log(2 * math.pi * float(i0e(kappa)))
    # cos r - I1 / I0 = (1 - I1 / I0) - drop; 1 - I1 / I0 is about 1 / (2 kappa) for a large kappa.
    ratio = float(i1e(kappa) / i0e(kappa))
    rest = 1 - ratio if kappa < 1e4 else 1 / (2 * kappa) + 1 / (8 * kappa**2) + 1 / (8 * kappa**3)
    return log_p, kappa * (rest - drop), kappa * np.sin(residual)


def half_sample_mode(values: Floats) -> float:
    """Return the centre of the densest part by repeated halving; robust even to more than half outliers.

    Source: Bickel and Fruehwirth (2006), "On a fast, robust estimator of the mode".
    """
    ordered = np.sort(values)
    while len(ordered) > 2:
        half = (len(ordered) + 1) // 2
        at = int(np.argmin(ordered[half - 1 :] - ordered[: len(ordered) - half + 1]))
        ordered = ordered[at : at + half]
    return float(ordered.mean())
