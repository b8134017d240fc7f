"""Extract features from scans: lines, corners, doors, hallways, poles and reflectors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense._util.typing import AnyArray
from gpusense.backends import Selection, get_backend
from gpusense.backends.base import Backend
from gpusense.features.lines import find_hallways, find_lines, scores_of, straight
from gpusense.features.objects import find_doors, find_poles
from gpusense.features.result import KINDS, Features, Found, check_kinds, features_of, joined, turned_axes
from gpusense.features.segments import NEIGHBOURS, ScanDevice, Segments, beams_of, by_bearing, find_segments
from gpusense.matching.match import readings
from gpusense.matching.points import ASSUMED_NOISE, scan_points, whole_noise
from gpusense.world.scanner import Scanner, classify_ranges

# Least and largest noise for splitting scans [m].
_LEAST_NOISE, _LARGEST_NOISE = 3e-3, 0.1
# Most readings per pass.
_READINGS = 1 << 22
# Standard deviation of the common error of a reflector's ranges [m]: bright echoes arrive early or late.
_TOGETHER = 0.01


def extract_features(
    ranges: AnyArray,
    scanner: Scanner,
    kinds: str | Sequence[str] = KINDS,
    backend: Selection = "auto",
    *,
    noise: float | Literal["auto"] = "auto",
    intensities: ArrayLike | None = None,
) -> Features:
    """Extract lines, corners, doors, hallways and poles from scans, and reflectors where intensities are known.

    A scan is split where two lines explain its readings better than one, by more than noise does (split and merge,
    Pavlidis and Horowitz 1974). A line is fitted to the ranges of each piece by maximum likelihood; pieces that a
    circle explains equally well are round walls. Corners are vertices of neighbouring lines. Doors are gaps of 0.5 to 2
    m in a wall, between two jambs, that beams pass through. Hallways are parallel walls 0.6 to 3.2 m apart on both
    sides of the scanner, facing each other over twice their distance. Poles are circles with radii of 1.5 to 50 cm in
    front of their background. Reflectors are cylinders: short runs of beams at least three times as bright as the
    median of their scan.

    Covariances follow from the standard deviation of ranges, estimated for each scan, the residuals of each line, and
    the distance between beams at edges. The device computes in float64 if it can, else in float32.

    Args:
        ranges: (K,) readings of a scan [m], or (S, K) of several. A beam without a return passes through a gap, see
            :func:`gpusense.classify`.
        scanner: The scanner; its mount is the sensor's pose on the robot. The robot is at rest during a scan:
            :func:`gpusense.deskew_scan` corrects a scan taken in motion.
        kinds: Kinds to extract: one, or several of "line", "corner", "door", "hallway", "pole" and "reflector".
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        noise: Standard deviation of ranges [m]. ``"auto"`` estimates it from the deviations of each scan from straight
            walls; scans with more than 10 cm of noise have no lines.
        intensities: Intensities of the readings, of the same shape, in any unit; NaN where unknown. None: no
            reflectors.

    Returns:
        The features of all scans, by scan and kind; see :class:`gpusense.Features`.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule, or the device is absent; the message names both.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.0175, count=356, range_max=9.0)
        >>> b = scanner.bearings
        >>> room = np.minimum(3 / np.abs(np.cos(b)), 2 / np.abs(np.sin(b)))
        >>> gs.extract_features(room, scanner, backend="numpy")
        Features(5 lines, 4 corners)
    """
    checks.instance("scanner", scanner, Scanner)
    wanted = check_kinds("kinds", kinds)
    given = None if isinstance(noise, str) and noise == "auto" else checks.real("noise", noise, above=0, high=10)
    device = get_backend(backend)
    scans = np.atleast_2d(readings("ranges", ranges, scanner, device))
    real = np.dtype(np.float64 if device.info.float64 else np.float32)
    if given is None:
        deviation = whole_noise(scans, scanner)
        deviation = np.where(np.isnan(deviation), ASSUMED_NOISE, deviation)
        deviation = np.clip(deviation, _LEAST_NOISE, _LARGEST_NOISE)
    else:
        deviation = np.full(len(scans), max(given, _LEAST_NOISE))
    step = max(_READINGS // max(scanner.count, 1), 1)
    light = None if intensities is None else np.atleast_2d(checks.array("intensities", intensities, finite=False))
    if light is not None and light.shape != scans.shape:
        raise ValueError(f"intensities: shape must be that of the readings, {scans.shape}, got {light.shape}")
    parts = [slice(first, first + step) for first in range(0, max(len(scans), 1), step)]
    found = []
    for part in parts:
        shapes = _shapes(device, real, scans[part], scanner, deviation[part], wanted)
        if light is not None and "reflector" in wanted:
            shapes["reflector"] = find_reflectors(scans[part], light[part], scanner, deviation[part])
        found.append(features_of(shapes))
    return joined(found, step)


def _shapes(
    backend: Backend, real: np.dtype, scans: np.ndarray, scanner: Scanner, noise: np.ndarray, kinds: tuple[str, ...]
) -> dict[str, Found]:
    """Return the features of (S, K) readings by kind, without reflectors."""
    points = scan_points(scans, scanner, np.dtype(np.float64))
    if not len(points.point) or set(kinds) <= {"reflector"}:
        return {}
    device = ScanDevice(backend, real, points, noise)
    segments = find_segments(device, points, noise)
    is_line, is_side = straight(device, segments)
    beams = beams_of(scans, scanner, points)
    finders: dict[str, Callable[[], Found]] = {
        "line": lambda: find_lines(segments, np.flatnonzero(is_line), scanner.mount),
        "corner": lambda: find_corners(segments, is_side, scanner.mount),
        "door": lambda: find_doors(segments, is_line, beams, scanner.mount),
        "hallway": lambda: find_hallways(segments, is_line, scanner.mount),
        "pole": lambda: find_poles(device, segments, beams, noise, scanner.mount),
    }
    return {kind: finder() for kind, finder in finders.items() if kind in kinds}


# Least angle between two walls [rad], and most points between them.
_LEAST_TURN, _BETWEEN = math.radians(25), 2
# Lines meet if the vertex is within this many beams and deviations of both ends.
_BEAMS, _DEVIATIONS = 1.5, 3.0


def find_corners(segments: Segments, straight: np.ndarray, mount: tuple[float, float, float]) -> Found:
    """Return the corners of scans: inner ones open by less than pi, outer ones by more."""
    one, two, between = _neighbours(segments, straight)
    alpha, beta = segments.angle[one], segments.angle[two]
    turn = wrapped(beta - alpha)
    clear = np.abs(np.sin(turn)) > math.sin(_LEAST_TURN)
    one, two, between, turn, alpha, beta = (v[clear] for v in (one, two, between, turn, alpha, beta))
    normals = np.stack([np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)], axis=1).reshape(-1, 2, 2)
    inverse = np.linalg.inv(normals)
    vertex = (inverse @ np.stack([segments.distance[one], segments.distance[two]], axis=1)[..., None])[..., 0]
    along = np.stack([_along(vertex, alpha), _along(vertex, beta)], axis=1)
    # Derivatives of the vertex's distance from each line by the line's angle and distance.
    row = np.zeros((len(one), 2, 4))
    row[:, 0, 0], row[:, 0, 1], row[:, 1, 2], row[:, 1, 3] = -along[:, 0], 1, -along[:, 1], 1
    jacobian = np.zeros((len(one), 3, 4))
    jacobian[:, :2] = inverse @ row
    jacobian[:, 2, 0] = jacobian[:, 2, 2] = 0.5
    both = np.zeros((len(one), 4, 4))
    both[:, :2, :2], both[:, 2:, 2:] = segments.covariance[one], segments.covariance[two]
    covariance = jacobian @ both @ jacobian.transpose(0, 2, 1)
    spread = np.sqrt(np.einsum("cii->c", covariance[:, :2, :2]))
    space = (_BEAMS + between)[:, None] * np.stack([segments.spacing[one, 1], segments.spacing[two, 0]], axis=1)
    gap = np.stack([along[:, 0] - segments.ends[one, 1], segments.ends[two, 0] - along[:, 1]], axis=1)
    # Within this distance of the vertex noise hides which line a point belongs to.
    noise = np.sqrt(np.maximum(segments.variance[one], segments.variance[two]))
    reach = _DEVIATIONS * (spread + noise / np.abs(np.sin(turn)))
    meets = (np.abs(gap) <= space + reach[:, None]).all(axis=1)
    pose = np.column_stack([vertex + np.array(mount[:2]), alpha + 0.5 * turn + math.pi])
    observed = np.broadcast_to(np.eye(3), (len(one), 3, 3))
    score = scores_of(segments, one) * scores_of(segments, two)
    return Found(segments.scan[one], pose, observed, covariance, math.pi - turn, score).only(meets)


def _along(vertex: np.ndarray, angle: np.ndarray) -> np.ndarray:
    place: np.ndarray = -np.sin(angle) * vertex[:, 0] + np.cos(angle) * vertex[:, 1]
    return place


def _neighbours(segments: Segments, straight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs of successive lines with few points between them, and these numbers of points."""
    one = np.flatnonzero(straight)
    two, between, linked = one, np.zeros(len(one), np.int64), np.ones(len(one), bool)
    found = []
    for _ in range(_BETWEEN + 1):
        linked = linked & (two >= 0) & ~segments.apart[two]
        two = np.where(linked, segments.successor[two], -1)
        meets = linked & straight[two] & (two != one)
        found.append((one[meets], two[meets], between[meets]))
        between = between + np.where(two >= 0, segments.count[two], 0)
        linked = linked & ~meets & (between <= _BETWEEN)
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))  # type: ignore[return-value]


# Least intensities of a bright beam and of a reflector's brightest beam [medians of the scan].
_BRIGHT, _BRIGHTEST = 2.0, 3.0
# Least beams, largest width [m], and largest step of ranges between neighbours [m].
_LEAST_BEAMS, _WIDEST, _STEP = 2, 0.4, 0.2


def find_reflectors(ranges: np.ndarray, intensities: np.ndarray, scanner: Scanner, noise: np.ndarray) -> Found:
    """Return the reflectors of (S, K) readings: centre and radius, half the width of the bright front."""
    order, bearing, steps, step = by_bearing(scanner)
    hit = classify_ranges(ranges, scanner.range_min, scanner.range_max)[0][:, order] & (ranges[:, order] > 0)
    bright = np.where(hit & np.isfinite(intensities[:, order]), intensities[:, order], 0.0)
    rows: list[list[float]] = []
    for scan, (light, r) in enumerate(zip(bright, ranges[:, order], strict=True)):
        usual = float(np.median(light[light > 0])) if (light > 0).any() else 0.0
        for run in _runs(light > _BRIGHT * usual, r, steps, step) if usual > 0 else ():
            found = _reflector(light[run], r[run], bearing[run], usual, step)
            if found is not None:
                rows.append([scan, *found, noise[scan]])
    return _found(np.array(rows).reshape(-1, 7), scanner.mount)


def _runs(bright: np.ndarray, r: np.ndarray, steps: np.ndarray, step: float) -> list[np.ndarray]:
    """Return runs of bright beams by bearing, continued across the last beam if beams cover a full turn."""
    count = len(bright)
    # Only bright beams have finite ranges.
    r = np.where(bright, r, 0.0)
    linked = bright & np.roll(bright, -1) & (steps <= NEIGHBOURS * step) & (np.abs(np.roll(r, -1) - r) < _STEP)
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
    covariance = np.zeros((len(rows), 2, 2))
    covariance[:, 0, 0] = noise**2 / count + _TOGETHER**2
    covariance[:, 1, 1] = distance**2 * variance
    score = np.clip(1 - np.sqrt(covariance[:, 1, 1]) / np.maximum(radius, 1e-3), 0, 1)
    return Found(scan.astype(np.int64), pose, turned_axes(bearing)[:, :2], covariance, radius, score)
