"""Exact log p of absolute, radio and contact sensors by mpmath, from their definitions and without the library."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mpmath as mp

mp.mp.dps = 60


def number(value: Any) -> Any:
    """Return the exact value of a float."""
    return mp.mpf(float(value))


def log_mixture(z_hit: float, hit: Any, z_rand: float, rand: Any) -> float:
    """Return the log of two weighted densities' sum."""
    p = number(z_hit) * hit + number(z_rand) * rand
    return float(mp.log(p)) if p > 0 else -mp.inf


def antenna(pose: Sequence[float], mount: Sequence[float]) -> tuple[Any, Any]:
    """Return the position of the antenna in the world."""
    x, y, theta = (number(v) for v in pose)
    c, s = mp.cos(theta), mp.sin(theta)
    mx, my = number(mount[0]), number(mount[1])
    return x + c * mx - s * my, y + s * mx + c * my


def position(pose: Any, fix: Any, p: Any, covariance: Any = None) -> float:
    """Return log p of a position fix."""
    if covariance is None:
        covariance = p.covariance
    if covariance is None:
        square = number(p.sigma) ** 2
        xx, xy, yy = square, mp.mpf(0), square
    else:
        xx, xy, yy = number(covariance[0][0]), number(covariance[0][1]), number(covariance[1][1])
    at = antenna(pose, p.mount)
    dx, dy = number(fix[0]) - at[0], number(fix[1]) - at[1]
    det = xx * yy - xy * xy
    hit = mp.exp(-(yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (2 * det)) / (2 * mp.pi * mp.sqrt(det))
    rand = mp.mpf(0)
    if p.region is not None and p.region[0] <= fix[0] <= p.region[2] and p.region[1] <= fix[1] <= p.region[3]:
        rand = 1 / ((number(p.region[2]) - number(p.region[0])) * (number(p.region[3]) - number(p.region[1])))
    return log_mixture(p.z_hit, hit, p.z_rand, rand)


def heading(theta: float, reading: float, p: Any) -> float:
    """Return log p of a heading."""
    r = number(reading) - number(p.offset) - number(theta)
    r -= 2 * mp.pi * mp.nint(r / (2 * mp.pi))
    if p.kind == "von_mises":
        kappa = number(p.kappa)
        hit = mp.exp(kappa * mp.cos(r)) / (2 * mp.pi * mp.besseli(0, kappa))
    elif p.sigma < 3:
        sigma = number(p.sigma)
        terms = [mp.exp(-(((r + 2 * mp.pi * k) / sigma) ** 2) / 2) for k in range(-14, 15)]
        hit = mp.fsum(terms) / (sigma * mp.sqrt(2 * mp.pi))
    else:
        q = mp.exp(-(number(p.sigma) ** 2) / 2)
        hit = (1 + 2 * mp.fsum(q ** (n * n) * mp.cos(n * r) for n in range(1, 12))) / (2 * mp.pi)
    return log_mixture(p.z_hit, hit, p.z_rand, 1 / (2 * mp.pi))


def normal_density(r: Any, near: Any, far: Any, sigma: Any) -> Any:
    """Return the density at r from the mean of a normal truncated to an interval."""
    mass = (mp.erf(near / sigma / mp.sqrt(2)) + mp.erf(far / sigma / mp.sqrt(2))) / 2
    return mp.exp(-((r / sigma) ** 2) / 2) / (sigma * mp.sqrt(2 * mp.pi)) / mass


def t_density(r: Any, near: Any, far: Any, sigma: Any, nu: int) -> Any:
    """Return the density of a truncated Student's t, by the incomplete beta function."""
    half = mp.mpf(nu) / 2
    peak = mp.gamma(half + 0.5) / mp.gamma(half) / mp.sqrt(nu * mp.pi) / sigma

    def mass(x: Any) -> Any:
        u = (x / sigma) ** 2
        return mp.betainc(0.5, half, 0, u / (nu + u), regularized=True) / 2

    return peak * (1 + (r / sigma) ** 2 / nu) ** (-(half + 0.5)) / (mass(near) + mass(far))


def beacon(pose: Any, xy: Any, reading: float, p: Any) -> float:
    """Return log p of one range."""
    at = antenna(pose, p.mount)
    d = mp.hypot(number(xy[0]) - at[0], number(xy[1]) - at[1]) + number(p.bias)
    longest = number(p.range_max)
    near = min(max(d, mp.mpf(0)), longest)
    r, ends = number(reading) - d, (near, longest - near)
    if p.kind == "student_t":
        hit = t_density(r, *ends, number(p.sigma_range), p.nu)
    else:
        hit = normal_density(r, *ends, number(p.sigma_range))
    if p.kind == "mixture":
        share = number(p.heavy_weight)
        hit = (1 - share) * hit + share * normal_density(r, *ends, number(p.sigma_heavy))
    return log_mixture(p.z_hit, hit, p.z_rand, 1 / longest)


def bump(squared_cells: int, side: float, radius: float, pressed: bool, p: Any) -> float:
    """Return log P of a bumper, from the squared distance between the outline's cell and the nearest obstacle."""
    gap = mp.sqrt(int(squared_cells)) * number(side) - number(side) / 2 - number(radius)
    x = gap / number(p.sigma) / mp.sqrt(2)
    # Beyond a few thousand nats mpmath's erfc is slow and negligible.
    touching, clear = mp.erfc(x) / 2, mp.erfc(-x) / 2
    contact, false = number(p.p_contact), number(p.p_false)
    if not pressed:
        contact, false = 1 - contact, 1 - false
    total = contact * touching + false * clear
    return float(mp.log(total)) if total > 0 else -mp.inf


def placed_point(pose: Any, point: Any, origin: Sequence[float], side: float) -> tuple[Any, Any, Any, Any]:
    """Return the position of a point of a robot in a grid, in cells."""
    x, y = antenna(pose, point)
    dx, dy, yaw = x - number(origin[0]), y - number(origin[1]), number(origin[2])
    c, s, cell = mp.cos(yaw), mp.sin(yaw), number(side)
    return (c * dx + s * dy) / cell, (c * dy - s * dx) / cell, c, s
