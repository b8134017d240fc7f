"""Find poles: round objects in front of their background, such as columns, posts, legs and cylindrical reflectors."""

from __future__ import annotations

import math

import numpy as np

from gpusense.features.device import ScanDevice
from gpusense.features.result import Found
from gpusense.features.segments import Beams, Segments

# Least and largest radius [m], and least points of a pole.
_THINNEST, _THICKEST, _LEAST_POINTS = 0.015, 0.5, 4
# Least distance between a pole and its background: this [m] plus this many deviations.
_BEHIND, _DEVIATIONS = 0.08, 6.0
# Larger poles must clearly fit a circle better than lines: radius that counts as one deviation [m].
_USUAL = 0.1
# Largest squared deviations per reading and edge of a pole, and its largest cost beyond its segments' lines.
_POOR, _ROUND = 2.5, 6.0
# Least evidence for a pole; beams on each side for estimating chance, per beam of the pole and at least; and the
# distance between near ranges [deviations].
_LEAST_EVIDENCE, _AROUND, _FEWEST_AROUND, _NEAR = 7.0, 2, 20, 3.0
# Expected noise gain of each further line.
_EACH = 8.0


def find_poles(
    device: ScanDevice, segments: Segments, beams: Beams, noise: np.ndarray, mount: tuple[float, float, float]
) -> Found:
    """Return the poles of scans: centre and radius."""
    first, count, scan, edges = _objects(segments, beams, noise)
    # Sort by bearing from the first segment on, independent of the scan's heading.
    begin = segments.first[np.searchsorted(segments.scan, scan)]
    order = np.lexsort((np.mod(first - begin, segments.points.counts[scan]), scan))
    first, count, scan, edges = first[order], count[order], scan[order], edges[order]
    part = np.stack([first, count], axis=1)
    step = segments.step
    edge = np.column_stack([edges, np.full((len(first), 2), step / math.sqrt(12))])
    circle = device.circles(part, scan, edge)
    radius, cost = circle[:, 2], circle[:, 3]
    good = (cost >= 0) & (radius >= _THINNEST) & (radius <= _THICKEST) & np.isfinite(circle).all(axis=1)
    good &= cost <= _POOR * (count - 1) + 4
    good &= cost + np.square(radius / _USUAL) <= _cost_of_lines(segments, first, count, scan) + _ROUND
    rows = np.flatnonzero(good)
    rows = rows[_evidence(segments, first[rows], count[rows], scan[rows], cost[rows], noise) > _LEAST_EVIDENCE]
    circle, scan, count, cost = circle[rows], scan[rows], count[rows], cost[rows]
    inverse, radius = _covariance(circle), circle[:, 2]
    distance = np.hypot(circle[:, 0], circle[:, 1])
    sure = (np.sqrt(np.einsum("pii->p", inverse)) < 0.5 * np.maximum(radius, 0.05)) & (distance > radius)
    observed = np.zeros((len(scan), 2, 3))
    observed[:, 0, 0] = observed[:, 1, 1] = 1
    pose = np.column_stack([circle[:, :2] + np.array(mount[:2]), np.zeros(len(scan))])
    fit = np.minimum(1, (count - 1) / np.maximum(cost, 1e-9))
    score = np.clip(fit * (1 - np.sqrt(np.einsum("pii->p", inverse)) / np.maximum(radius, 0.05)), 0, 1)
    return Found(scan, pose, observed, inverse, radius, score).only(sure)


def _evidence(
    segments: Segments, first: np.ndarray, count: np.ndarray, scan: np.ndarray, cost: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """Return the log-likelihood ratios (P,) of circles to chance, less the logarithm of the candidates per scan.

    By chance, the ranges of an object are independent, with the density of the ranges around it. The density at a range
    is the share of near ranges among the beams on both sides, plus one beam.
    """
    points, result = segments.points, np.zeros(len(first))
    for k, (one, number, of) in enumerate(zip(first.tolist(), count.tolist(), scan.tolist(), strict=True)):
        begin, total, sigma = int(points.start[of]), int(points.counts[of]), float(noise[of])
        place = begin + np.mod(one - begin + np.arange(total), total)
        bearing, r = points.point[place, 2].astype(np.float64), points.point[place, 3].astype(np.float64)
        beams = max(_AROUND * number, _FEWEST_AROUND)
        off = np.mod(np.stack([bearing - bearing[number - 1], bearing[0] - bearing]), 2 * math.pi).min(axis=0)
        around = r[number:][off[number:] <= beams * segments.step]
        near = np.abs(around - r[:number, None]) <= _NEAR * sigma
        density = (near.sum(axis=1) + 1) / (2 * beams * 2 * _NEAR * sigma)
        likelihood = -0.5 * cost[k] - number * math.log(sigma * math.sqrt(2 * math.pi))
        result[k] = likelihood - np.log(density).sum() - math.log(total)
    return result


def _covariance(circle: np.ndarray) -> np.ndarray:
    """Return the covariances (P, 2, 2) of centres for an unknown radius."""
    information = np.zeros((len(circle), 3, 3))
    rows, cols = np.triu_indices(3)
    information[:, rows, cols] = information[:, cols, rows] = circle[:, 4:10]
    inverse: np.ndarray = np.linalg.pinv(information, hermitian=True)[:, :2, :2]
    return inverse


def _objects(
    segments: Segments, beams: Beams, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return first points, numbers of points, scans and bearings of both edges of objects in the foreground."""
    points = segments.points
    total = len(points.point)
    scan = np.repeat(np.arange(len(noise)), points.counts)
    begin, counts = points.start[scan], points.counts[scan]
    following = begin + (np.arange(total) - begin + 1) % np.maximum(counts, 1)
    point = points.point.astype(np.float64)
    r, bearing = point[:, 3], point[:, 2]
    step = np.mod(bearing[following] - bearing, 2 * math.pi)
    jump = _BEHIND + _DEVIATIONS * noise[scan]
    rises, falls = r[following] - r > jump, r - r[following] > jump
    gap = (step > points.gap) | (following == np.arange(total))
    # An object begins where ranges fall, and ends where they rise or beams have no return.
    begins = np.zeros(total, bool)
    begins[following[falls & ~gap]] = True
    begins |= beams.opens_before
    ends, broken = (rises & ~gap) | beams.opens_after, falls | gap
    starts = np.flatnonzero(begins)
    if not len(starts):
        empty = np.zeros(0, np.int64)
        return empty, empty, empty, np.zeros((0, 2))
    stops = np.flatnonzero(ends | broken)
    return _runs(points.start, scan, starts, stops, ends, bearing, segments.step, points.counts)


def _runs(
    start: np.ndarray, scan: np.ndarray, starts: np.ndarray, stops: np.ndarray, ends: np.ndarray, bearing: np.ndarray,
    step: float, counts: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return the narrow objects from starting points to the next stops, if these are ends."""
    place = np.searchsorted(stops, starts)
    last = np.where(place < len(stops), stops[np.minimum(place, len(stops) - 1)], -1)
    # Continue across the end of a scan.
    same = (last >= 0) & (scan[np.maximum(last, 0)] == scan[starts])
    head = np.searchsorted(stops, start[scan[starts]])
    wrapped = stops[np.minimum(head, len(stops) - 1)]
    usable = (head < len(stops)) & (scan[wrapped] == scan[starts]) & (wrapped < starts)
    last = np.where(same, last, np.where(usable, wrapped, -1))
    kept = (last >= 0) & ends[np.maximum(last, 0)]
    starts, last = starts[kept], last[kept]
    of = scan[starts]
    count = np.mod(last - starts, np.maximum(counts[of], 1)) + 1
    width = np.mod(bearing[last] - bearing[starts], 2 * math.pi)
    kept = (count >= _LEAST_POINTS) & (width < 2.0)
    starts, last, of, count, width = starts[kept], last[kept], of[kept], count[kept], width[kept]
    edges = np.stack([bearing[starts] - 0.5 * step, bearing[starts] + width + 0.5 * step], axis=1)
    return starts, count, of, edges


def _cost_of_lines(segments: Segments, first: np.ndarray, count: np.ndarray, scan: np.ndarray) -> np.ndarray:
    """Return the cost of each object's lines: residuals, a penalty per further line, and 1 per point off lines."""
    total = segments.points.counts[scan]
    cost = np.zeros(len(first))
    head, tail = np.searchsorted(segments.scan, scan), np.searchsorted(segments.scan, scan, side="right")
    for k in range(len(first)):
        rows = np.arange(head[k], tail[k])
        off = (segments.first[rows] - first[k]) % total[k]
        inner = rows[(off + segments.count[rows] <= count[k])]
        cost[k] = np.maximum(segments.cost[inner], 0).sum() + _EACH * max(len(inner) - 1, 0)
        cost[k] += count[k] - segments.count[inner].sum()
    return cost
