"""Match a scan to an earlier scan or to a map: the pose of the second in the frame of the first, or in the world."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, CasterName, Precision
from gpusense.backends import Selection, arrays, get_backend
from gpusense.backends.base import Backend
from gpusense.matching.icp_with_search import match_pairs
from gpusense.matching.options import MatchOptions, check_guess, check_options
from gpusense.matching.points import ASSUMED_NOISE, map_noise, match_noise, scan_noise, scan_points
from gpusense.matching.result import ScanMatch
from gpusense.matching.scan_pair import match_pair, supports_single_pair
from gpusense.matching.to_map import MapMatcher, match_to_map
from gpusense.matching.verdicts import judged
from gpusense.models.arguments import real_dtype
from gpusense.world.deskew import check_motion, still_readings
from gpusense.world.frames import ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner, classify_ranges

# Side of a map's cell in capture radii, and most cells along a side; larger scans have larger cells.
_CELL, _MOST_CELLS = 0.05, 1500
# Half widths of a search [m, rad].
WINDOW = (1.2, 1.05)
METHODS = ("auto", "icp", "gauss_newton", "correlative")

Method = Literal["auto", "icp", "gauss_newton", "correlative"]


def match_scan(
    reference: AnyArray | OccupancyGrid,
    ranges: AnyArray,
    scanner: Scanner,
    guess: ArrayLike = (0.0, 0.0, 0.0),
    method: Method = "auto",
    backend: Selection = "auto",
    *,
    precision: Precision = "float32",
    noise: float | Literal["auto"] = "auto",
    capture: float = 1.0,
    window: ArrayLike = WINDOW,
    temperature: float = 1.0,
    motion: ArrayLike | None = None,
    reference_motion: ArrayLike | None = None,
) -> ScanMatch:
    """Return the pose of a scan in the frame of an earlier scan, or in a map.

    Points of the second scan are paired with the nearest points of the reference, and moved onto the lines through
    these and their neighbours (point-to-line ICP, Censi 2008) with weights that suppress outliers. Space that the
    reference did not see neither attracts nor repels. If the scans do not agree at the end, ``"auto"`` searches around
    the guess from many starts, and takes the pose with the best score. In a map, the reference is the scan that is
    expected at the guess, and then at the pose found; where that fails, the whole window is searched.

    Args:
        reference: (K,) readings of the earlier scan [m], or (S, K) for S matches; or a map.
        ranges: (K,) readings of the second scan, or (S, K) for S matches in one call.
        scanner: The scanner of both; its mount is the sensor's pose on the robot.
        guess: (3,) or (S, 3) pose of the second robot frame in the first one, or in the world [m, m, rad].
        method: ``"auto"``, the chain: from the guess, with a search where that fails. ``"icp"``: point-to-line ICP
            from the guess alone, between scans. ``"gauss_newton"``: damped steps on likelihood fields of the map, or of
            a map of the reference scan, from coarse to fine. ``"correlative"``: the best of all poses on a grid in the
            window, without refinement, by branch and bound.
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``.
        noise: Standard deviation of ranges [m]; errors beyond about three of them lose their weight. ``"auto"``:
            estimated for each match from the scans' deviations from straight walls; at least 1 cm, and at least the
            rounding error of ranges that come in steps. See the field ``noise`` of the result.
        capture: Farthest distance between paired points at the start [m]: the error of a good guess.
        window: Half widths of the search: distance from the guess [m], and turn [rad].
        temperature: In (0, 1]: multiplies the information, for errors that the scans do not show, such as motion during
            a scan. Correlation of neighbouring beams is measured and already part of a covariance between scans. 1 is
            right for noise of ranges alone; recorded pairs have 0.06 to 0.16.
        motion: (3,) or (S, 3) motion of the robot during the second scan, from odometry: its pose at the last beam in
            its frame at the first one [m, m, rad]. Beams are measured in their order, evenly in time; guess and result
            are poses at the first beam. None: the robot is at rest.
        reference_motion: The same during the reference scan; must be None for a map.

    Returns:
        The match, or S matches.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule, or the device is absent; the message names both.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.0175, count=356, range_max=9.0)
        >>> c, s = np.cos(scanner.bearings), np.sin(scanner.bearings)
        >>> room = lambda x, y: np.minimum((3 * np.sign(c) - x) / c, (2 * np.sign(s) - y) / s)
        >>> match = gs.match_scan(room(0.0, 0.0), room(0.2, 0.1), scanner, backend="numpy")
        >>> match.pose[:2].round(3).tolist()
        [0.2, 0.1]
    """
    checks.instance("scanner", scanner, Scanner)
    checks.choice("method", method, METHODS)
    given = not (isinstance(noise, str) and noise == "auto")
    options = check_options(noise if given else ASSUMED_NOISE, capture, window)
    if type(temperature) is not float or temperature != 1.0:
        checks.real("temperature", temperature, above=0, high=1)
    device = get_backend(backend)
    real_dtype(precision, device)
    moved = motion, reference_motion
    matches, single = _matches(reference, ranges, scanner, guess, method, device, precision, options, moved, given)
    if temperature != 1:
        covariance, information = matches.covariance / temperature, matches.information * temperature
        matches = matches.changed(covariance=covariance, information=information)
    return matches[0] if single else matches


def _matches(
    reference: AnyArray | OccupancyGrid, ranges: AnyArray, scanner: Scanner, guess: ArrayLike, method: Method,
    device: Backend, precision: Precision, options: MatchOptions, motions: tuple[object, object], given: bool,
) -> tuple[ScanMatch, bool]:  # fmt: skip
    """Return checked scans' S matches, and whether one is requested; ``given``: the caller chose the noise."""
    second = readings("ranges", ranges, scanner, device)
    motion = check_motion("motion", motions[0], 1 if second.ndim == 1 else len(second))
    if isinstance(reference, OccupancyGrid):
        if method == "icp":
            raise ValueError("method: 'icp' needs a scan as reference, got a map: use 'gauss_newton'")
        if motions[1] is not None:
            raise ValueError("reference_motion: must be None with a map, got a motion")
        poses = check_guess(guess, None if second.ndim == 1 else len(second), np.inf)
        still = _still(np.atleast_2d(second), scanner, motion)

        def to_map(rows: np.ndarray, chosen: MatchOptions) -> ScanMatch:
            return match_to_map(reference, still[rows], scanner, poses[rows], method, device, precision, chosen)

        noise = np.full(len(still), options.noise) if given else map_noise(scan_noise(still, scanner), reference)
        return _by_noise(noise, options, to_map), second.ndim == 1
    first = readings("reference", reference, scanner, device)
    single = first.ndim == 1 and second.ndim == 1
    if (
        single
        and method in ("auto", "icp")
        and motions[0] is None
        and motions[1] is None
        and supports_single_pair(device, scanner)
    ):
        poses, real = check_guess(guess, None), np.dtype(precision)
        match = match_pair(device, real, first, second, scanner, poses, method, options, given=given)
        return judged(match, poses, options), True
    first, second = (scans[None] if scans.ndim == 1 else scans for scans in (first, second))
    if len(first) not in (1, len(second)):
        rule = f"must be one scan, or as many as ranges has, {len(second)}"
        raise ValueError(f"reference: {rule}, got {len(first)}")
    poses = check_guess(guess, None if single else len(second))
    if motion is not None and len(motion) != len(second):
        motion = np.repeat(motion, len(second), axis=0)
    before = check_motion("reference_motion", motions[1], len(first))

    if given:
        noise = np.full(len(second), options.noise)
    else:
        own = scan_noise(np.concatenate([first, second]), scanner)
        noise = match_noise(own[: len(first)], own[len(first) :])
    if method not in ("gauss_newton", "correlative") or not len(second):
        moved = None
        if before is not None or motion is not None:
            both = (first, before), (second, motion)
            moved = np.concatenate([np.zeros((len(scans), 3)) if m is None else m for scans, m in both])
        pairs = np.empty((len(second), 2), np.intp)
        pairs[:, 0] = np.arange(len(second)) if len(first) == len(second) else 0
        pairs[:, 1] = np.arange(len(first), len(first) + len(second))
        scans = np.concatenate([first, second])
        return _pairs_of(scans, scanner, pairs, poses, method, device, precision, options, noise, moved), single
    first, second = _still(first, scanner, before), _still(second, scanner, motion)

    def by_maps(rows: np.ndarray, chosen: MatchOptions) -> ScanMatch:
        one = first if len(first) == 1 else first[rows]
        return match_by_maps(one, second[rows], scanner, poses[rows], method, device, precision, chosen)

    return _by_noise(noise, options, by_maps), single


def _by_noise(
    noise: np.ndarray, options: MatchOptions, matched: Callable[[np.ndarray, MatchOptions], ScanMatch]
) -> ScanMatch:
    """Return the matches of all rows; rows with equal noise (S,) share one call."""
    levels = noise if len(noise) == 1 else np.unique(noise)
    if len(levels) < 2:
        return matched(np.arange(len(noise)), options.at_noise(float(levels[0])) if len(levels) else options)
    rows = [np.flatnonzero(noise == level) for level in levels]
    parts = [matched(row, options.at_noise(float(level))) for row, level in zip(rows, levels, strict=True)]
    return ScanMatch.joined(parts).ordered(np.argsort(np.concatenate(rows)))


def match_log(
    scans: np.ndarray, scanner: Scanner, first: np.ndarray, second: np.ndarray, guess: np.ndarray, own: np.ndarray,
    backend: Backend, precision: Precision, window: ArrayLike, motion: np.ndarray | None = None,
) -> ScanMatch:  # fmt: skip
    """Match L pairs of checked scans of a log as ``match_scan`` does; points and lines of each scan are made once.

    ``scans`` are (S, K) [m], ``first`` and ``second`` (L,) indices of scans, ``guess`` (L, 3) poses of the second
    robot frames in the first ones, ``own`` (S,) the noise from ``scan_noise`` [m], ``window`` half widths of the search
    [m, rad] and ``motion`` (S, 3) motions during the scans, or None.
    """
    options, poses = check_options(ASSUMED_NOISE, 1.0, window), check_guess(guess, len(second))
    noise, pairs = match_noise(own[first], own[second]), np.stack([first, second], axis=1)
    return _pairs_of(scans, scanner, pairs, poses, "auto", backend, precision, options, noise, motion)


def _pairs_of(
    scans: np.ndarray, scanner: Scanner, pairs: np.ndarray, poses: np.ndarray, method: str, device: Backend,
    precision: Precision, options: MatchOptions, noise: np.ndarray, motion: np.ndarray | None,
) -> ScanMatch:  # fmt: skip
    """Match pairs (L, 2) of scans (S, K) from guesses (L, 3), with noise (L,) of ranges and motions (S, 3) or None."""
    if len(noise) and (len(scans) > pairs.size or noise.min() < noise.max()):
        # Lines depend on the noise, so a scan has points for each level; scans without a pair have none.
        level = np.unique(noise, return_inverse=True)[1] * len(scans)
        used, numbers = np.unique(level[:, None] + pairs, return_inverse=True)
        chosen, pairs = used % len(scans), numbers.reshape(pairs.shape)
        scans, motion = scans[chosen], None if motion is None else motion[chosen]
    real = np.dtype(precision)
    points = scan_points(scans, scanner, real, motion)
    match = match_pairs(device, real, points, pairs, poses, method, options, scanner.mount[:2], noise)
    return judged(match, poses, options)


def _still(ranges: np.ndarray, scanner: Scanner, motion: np.ndarray | None) -> np.ndarray:
    """Return (S, K) readings as if the robot were at rest."""
    return ranges if motion is None else still_readings(ranges, scanner, motion)


def readings(name: str, ranges: object, scanner: Scanner, backend: Backend) -> np.ndarray:
    """Return readings of one scan (K,) or of several (S, K), checked."""
    if type(ranges) is np.ndarray and ranges.dtype == np.float64 and ranges.shape == (scanner.count,):
        # Other checks take longer than the estimate of a match.
        scanner._first_scans.look_at(name, ranges)
        return ranges
    values = checks.as_array(name, arrays.copied_to_host(ranges, backend, name), masked=True)
    shape = ("S", scanner.count) if values.ndim == 2 else (scanner.count,)
    read = checks.array(name, values, shape, finite=False, dtype=None)
    scanner._first_scans.look_at(name, read)
    return read


def scan_map(ranges: np.ndarray, scanner: Scanner, margin: float, cell: float) -> OccupancyGrid:
    """Return a scan's map in the robot's frame: hits are occupied; ``margin`` and least side ``cell`` [m]."""
    hits = classify_ranges(ranges, scanner.range_min, scanner.range_max)[0]
    vectors, middle = ray_vectors(scanner.bearings, scanner.mount)[hits], np.array(scanner.mount[:2])
    # Axes along the fourfold moment of the points, and space around the sensor on both sides: the cells turn and mirror
    # with the scan.
    weight = ranges[hits].astype(np.float64) ** 2
    moment = np.sum(weight * (vectors[:, 0] + 1j * vectors[:, 1]) ** 4)
    yaw = float(np.angle(moment)) / 4
    c, s = math.cos(yaw), math.sin(yaw)
    place = ranges[hits, None] * vectors @ np.array([[c, -s], [s, c]])
    half = np.abs(place).max(axis=0, initial=0.0) + margin
    cell = max(cell, float(2 * half.max()) / _MOST_CELLS)
    cols, rows = np.ceil(half / cell).astype(int).tolist()
    cells = np.full((2 * rows, 2 * cols), -1, np.int8)
    if hits.any():
        col, row = np.floor(place / cell).astype(int).T
        cells[row + rows, col + cols] = 100
    corner = middle - cell * np.array([c * cols - s * rows, s * cols + c * rows])
    return OccupancyGrid(cells, resolution=cell, origin=(float(corner[0]), float(corner[1]), yaw))


def match_by_maps(
    references: np.ndarray, ranges: np.ndarray, scanner: Scanner, guess: np.ndarray, method: str, backend: Backend,
    precision: str, options: MatchOptions,
) -> ScanMatch:  # fmt: skip
    """Match (S, K) readings singly to maps of (S, K) or (1, K) references, from (S, 3) guesses."""
    matches = []
    matcher = None
    for i, scan in enumerate(ranges):
        if matcher is None or len(references) > 1:
            grid = scan_map(references[i], scanner, options.capture, _CELL * options.capture)
            # Rectangles of a map do not pay for a single scan; both casters find the same ranges.
            caster: CasterName = "dda" if len(references) > 1 or len(ranges) == 1 else "exact"
            matcher = MapMatcher(grid, scanner, backend, precision, options, caster)
        matches.append(matcher.match(scan[None], guess[i : i + 1], method))
    return ScanMatch.joined(matches)
