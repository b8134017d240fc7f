"""Find reflectors: bright cylinders that appear as short runs of beams far brighter than the rest of the scan."""

from __future__ import annotations

import math

import numpy as np

from gpusense._util.angles import wrapped
from gpusense.features.result import Found, nothing
from gpusense.world.scanner import Scanner, classify_ranges

# Least intensities of a bright beam and of a reflector's brightest beam [medians of the scan].
_BRIGHT, _BRIGHTEST = 2.0, 3.0
# Least beams, largest width [m], and largest step of ranges between neighbours [m].
_LEAST_BEAMS, _WIDEST, _STEP = 2, 0.4, 0.2
# Largest step between the bearings of neighbouring beams [usual steps].
_NEIGHBOURS = 1.5
# Standard deviation of the common error of a reflector's ranges [m]: bright echoes arrive early or late.
_TOGETHER = 0.01


def find_reflectors(ranges: np.ndarray, intensities: np.ndarray, scanner: Scanner, noise: np.ndarray) -> Found:
    """Return the reflectors of (S, K) readings: centre and radius, half the width of the bright front."""
    angle = np.mod(scanner.bearings + scanner.mount[2], 2 * math.pi)
    order = np.argsort(angle, kind="stable")
    bearing = angle[order]
    steps = np.mod(np.roll(bearing, -1) - bearing, 2 * math.pi)
    step = float(np.median(steps)) if len(steps) else 0.0
    hit = classify_ranges(ranges, scanner.range_min, scanner.range_max)[0][:, order] & (ranges[:, order] > 0)
    bright = np.where(hit & np.isfinite(intensities[:, order]), intensities[:, order], 0.0)
    rows: list[list[float]] = []
    for scan, (light, r) in enumerate(zip(bright, ranges[:, order], strict=True)):
        usual = float(np.median(light[light > 0])) if (light > 0).any() else 0.0
        for run in _runs(light > _BRIGHT * usual, r, steps, step) if usual > 0 else ():
            found = _reflector(light[run], r[run], bearing[run], usual, step)
            if found is not None:
                rows.append([scan, *found, noise[scan]])
    return _found(np.array(rows), scanner.mount) if rows else nothing()


def _runs(bright: np.ndarray, r: np.ndarray, steps: np.ndarray, step: float) -> list[np.ndarray]:
    """Return runs of bright beams by bearing, continued across the last beam if beams cover a full turn."""
    count = len(bright)
    # Only bright beams have finite ranges.
    r = np.where(bright, r, 0.0)
    linked = bright & np.roll(bright, -1) & (steps <= _NEIGHBOURS * step) & (np.abs(np.roll(r, -1) - r) < _STEP)
    first = np.flatnonzero(bright & ~np.roll(linked, 1))
    last = np.flatnonzero(bright & ~linked)
    if not len(first):
        return []
    # The last run may continue at the first beams.
    ends = last if last[0] >= first[0] else np.append(last[1:], last[0] + count)
    return [np.arange(a, b + 1) % count for a, b in zip(first, ends, strict=True)]


def _reflector(
    light: np.ndarray, r: np.ndarray, bearing: np.ndarray, usual: float, step: float
) -> tuple[float, float, float, float, float] | None:
    """Return distance, bearing, width, bearing variance and beams of a reflector's run, else None."""
    peak = float(light.max())
    inner = light >= 0.5 * (peak + usual)
    count = int(np.count_nonzero(inner))
    if peak < _BRIGHTEST * usual or count < _LEAST_BEAMS:
        return None
    weight = light[inner] - usual
    weight = weight / weight.sum()
    turn = wrapped(bearing[inner] - bearing[0])
    distance = float(np.median(r[inner]))
    width = distance * (float(turn.max() - turn.min()) + step)
    if width > _WIDEST:
        return None
    variance = step**2 / 12 * max(float((weight**2).sum()) * 2, 0.25)
    return distance, float(bearing[0] + weight @ turn), width, variance, float(count)


def _found(rows: np.ndarray, mount: tuple[float, float, float]) -> Found:
    """Return reflectors from rows: scan, distance, bearing, width, variance of the bearing, number of beams, noise."""
    scan, distance, bearing, width, variance, count, noise = rows.T
    c, s = np.cos(bearing), np.sin(bearing)
    radius = 0.5 * width
    pose = np.column_stack(
        [(distance + radius) * c + mount[0], (distance + radius) * s + mount[1], np.zeros(len(rows))]
    )  # fmt: skip
    observed = np.zeros((len(rows), 2, 3))
    observed[:, 0, 0], observed[:, 0, 1], observed[:, 1, 0], observed[:, 1, 1] = c, s, -s, c
    covariance = np.zeros((len(rows), 2, 2))
    covariance[:, 0, 0] = noise**2 / count + _TOGETHER**2
    covariance[:, 1, 1] = distance**2 * variance
    score = np.clip(1 - np.sqrt(covariance[:, 1, 1]) / np.maximum(radius, 1e-3), 0, 1)
    return Found(scan.astype(np.int64), pose, observed, covariance, radius, score)
