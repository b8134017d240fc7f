"""Readings that point and landmark models draw.

They are drawn on the host in float64, so that all backends give readings of the same bits. Random numbers come from
Philox (reference/philox.py) with the counter (pose, step, stream, call). A distribution is drawn by inverting its
distribution function, so that readings move smoothly with poses; a von Mises is drawn by rejection.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats
from gpusense.backends import arrays
from gpusense.backends.base import Backend
from gpusense.reference.heading import cos_sin
from gpusense.reference.philox import random_words
from gpusense.reference.relative import wrapped_difference
from gpusense.reference.sampling import fine_uniform

Distribution = Callable[[Floats], Floats]
# Seeds are keys of Philox: two words of 32 bits.
MOST_SEED, MOST_STEP = (1 << 64) - 1, (1 << 31) - 1
# First stream of each model, followed by the streams of its readings; scan models use stream 1 << 30.
POSITION, HEADING, BEACONS, BUMPER, LANDMARKS, LINES = (n << 26 for n in range(1, 7))
# Half widths [deviations] below which a density is uniform to rounding.
_FLAT = 1e-7


@dataclass(frozen=True)
class Draws:
    """Random numbers of N poses, or of S N poses of S scans."""

    poses: Floats  # (N, 3) or (S N, 3) poses
    shape: tuple[int, ...]  # (N,) or (S, N)
    particle: NDArray[np.int64]  # index of each pose in its scan
    step: NDArray[np.int64]  # step of each pose
    key: tuple[int, int]  # the seed's two words

    def uniform(self, stream: int, call: int = 0) -> tuple[Floats, Floats]:
        """Return two independent numbers in (0, 1) for each pose."""
        zero = np.zeros_like(self.particle)
        words = random_words((self.particle, self.step, zero + stream, zero + call), *self.key)
        return fine_uniform(words[0], words[1]), fine_uniform(words[2], words[3])

    def reshaped(self, readings: np.ndarray) -> np.ndarray:
        """Return (N, ...) or (S, N, ...) readings."""
        return readings.reshape(*self.shape, *readings.shape[1:])


def draws_at(poses: Any, backend: Backend, seed: object, step: object) -> Draws:
    """Return the random numbers of (N, 3) or (S, N, 3) poses."""
    key = checks.integer("seed", seed, low=0, high=MOST_SEED)
    first = checks.integer("step", step, low=0, high=MOST_STEP)
    read = arrays.copied_to_host(poses, backend, "poses")
    several = checks.as_array("poses", read).ndim == 3
    host = checks.array("poses", read, ("S", "N", 3) if several else ("N", 3))
    shape = host.shape[:-1]
    scan, particle = np.indices(shape) if several else (np.zeros(shape, np.int64), np.arange(shape[0]))
    return Draws(host.reshape(-1, 3), shape, particle.ravel(), scan.ravel() + first, (key & 0xFFFFFFFF, key >> 32))


def wrapped(angle: Floats) -> Floats:
    """Return angles of any number of turns in [-pi, pi]."""
    none = np.zeros(1)
    return np.asarray(wrapped_difference(angle, (none, none))[0])


def standard_normal(u: Floats) -> Floats:
    """Return standard normal deviates."""
    from scipy.special import ndtri

    return np.asarray(ndtri(u))


def mounted(poses: Floats, mount: Sequence[float]) -> Floats:
    """Return the (N, 2) positions of a mount (x, y) on the robot at poses."""
    c, s = cos_sin(poses[:, 2])
    return poses[:, :2] + np.stack([c * mount[0] - s * mount[1], s * mount[0] + c * mount[1]], axis=1)


def within(
    u: Floats, mean: Floats, scale: float | Floats, low: float, high: float, cdf: Distribution, quantile: Distribution
) -> Floats:
    """Return draws of a symmetric distribution with (N,) means on an interval, for (N,) numbers ``u`` in (0, 1).

    For a mean outside the interval, the normaliser is taken at the nearest end, as in the models' densities; the rest
    of the mass is not observed and gives NaN.
    """
    # The mean on the side of the upper end, so that the distribution function is not near 1 where mass is small.
    flip = mean < 0.5 * (low + high)
    centre = np.where(flip, low + high - mean, mean)
    near = np.clip(centre, low, high)
    bottom, top = cdf((low - centre) / scale), cdf((high - centre) / scale)
    mass = np.where(near == centre, top - bottom, cdf((high - near) / scale) - cdf((low - near) / scale))
    mark = u * mass
    drawn = np.clip(centre + scale * quantile(np.minimum(bottom + mark, top)), low, high)
    drawn = np.where((near == centre) & (high - low < _FLAT * scale), low + u * (high - low), drawn)
    drawn = np.where((near != centre) & (mark > top - bottom), np.nan, drawn)
    return np.where(flip, low + high - drawn, drawn)


def normal_within(u: Floats, mean: Floats, sigma: float | Floats, low: float, high: float) -> Floats:
    """Return draws of a normal on an interval; see :func:`within`."""
    from scipy.special import ndtr, ndtri

    return within(u, mean, sigma, low, high, ndtr, ndtri)


def wrapped_normal_within(u: Floats, mean: Floats, sigma: float, half: float) -> Floats:
    """Return angles in [-half, half] whose wrapped differences from ``mean`` are normal; see ``within``."""
    from scipy.special import ndtri

    parts = _arcs(mean, half)
    masses = [_mass(low, high, sigma) for low, high in parts]
    ends = _arcs(np.clip(mean, -half, half), half)
    mark = u * sum(_mass(low, high, sigma) for low, high in ends)
    difference = np.full_like(mean, np.nan)
    begun = np.zeros_like(mean)
    for (low, high), mass in zip(parts, masses, strict=True):
        inside = (mark >= begun) & (mark < begun + mass)
        share = np.where(inside, mark - begun, 0.0) / np.where(inside, mass, 1.0)
        # From the end nearer to the peak's other side, where the distribution function is small.
        flip = low + high > 0
        a, b = np.where(flip, -high, low), np.where(flip, -low, high)
        portion = np.where(flip, 1.0 - share, share)
        value = sigma * ndtri(_cdf(a / sigma) + portion * mass)
        value = np.where(b - a < _FLAT * sigma, a + portion * (b - a), np.clip(value, a, b))
        difference = np.where(inside, np.where(flip, -value, value), difference)
        begun = begun + mass
    angle = mean + difference
    turned = np.where(angle > np.pi, angle - 2 * np.pi, np.where(angle < -np.pi, angle + 2 * np.pi, angle))
    return np.clip(turned, -half, half)


def _arcs(mean: Floats, half: float) -> list[tuple[Floats, Floats]]:
    """Return the differences in [-pi, pi] from means that lead to angles in [-half, half]: up to three intervals."""
    low, high = -half - mean, half - mean
    return [
        (np.maximum(low, -np.pi), np.minimum(high, np.pi)),
        (np.full_like(low, -np.pi), np.maximum(high - 2 * np.pi, -np.pi)),
        (np.minimum(low + 2 * np.pi, np.pi), np.full_like(low, np.pi)),
    ]


def _cdf(x: Floats) -> Floats:
    from scipy.special import ndtr

    return np.asarray(ndtr(x))


def _mass(low: Floats, high: Floats, sigma: float) -> Floats:
    """Return the mass of a normal around 0 between two ends; 0 where they are in the other order."""
    flip = low + high > 0
    a, b = np.where(flip, -high, low), np.where(flip, -low, high)
    return np.where(high > low, _cdf(b / sigma) - _cdf(a / sigma), 0.0)


def von_mises(draws: Draws, stream: int, kappa: float) -> Floats:
    """Return angles in [-pi, pi] drawn from a von Mises around 0.

    The density exp(-2 kappa sin^2(r / 2)) is below exp(-2 kappa r^2 / pi^2), a normal on [-pi, pi], from which angles
    are drawn until one is accepted; at least a share of 2 / pi is accepted.
    """
    angles = np.full(len(draws.poses), np.nan)
    sigma = np.pi / 2 / np.sqrt(kappa) if kappa > 0 else np.inf
    left, call = np.arange(len(angles)), 1
    while len(left):
        some = Draws(draws.poses[left], (len(left),), draws.particle[left], draws.step[left], draws.key)
        u, v = some.uniform(stream, call)
        drawn = np.pi * (2 * u - 1) if sigma > 1e8 else normal_within(u, np.zeros(len(left)), sigma, -np.pi, np.pi)
        half_sine = cos_sin(0.5 * drawn)[1]
        accepted = v < np.exp(-2 * kappa * (half_sine * half_sine - (drawn / np.pi) ** 2))
        angles[left[accepted]] = drawn[accepted]
        left, call = left[~accepted], call + 1
    return angles
