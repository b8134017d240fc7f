"""Match a scan to an earlier scan or to a map: the pose of the second in the frame of the first, or in the world."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray, Precision
from gpusense.backends import Selection, arrays, get_backend
from gpusense.backends.base import Backend
from gpusense.matching.chain import match_pairs
from gpusense.matching.options import MatchOptions, check_guess, check_options
from gpusense.matching.points import scan_points
from gpusense.matching.result import ScanMatch
from gpusense.matching.scan_map import match_by_maps
from gpusense.matching.to_map import match_to_map
from gpusense.models.arguments import real_dtype
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

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
    noise: float = 0.01,
    capture: float = 1.0,
    window: ArrayLike = (1.2, 1.05),
    temperature: float = 1.0,
) -> ScanMatch:
    """Return the pose of a scan in the frame of an earlier scan, or in a map.

    Points of the second scan are paired with the nearest points of the reference, and moved onto the lines through
    these and their neighbours (point-to-line ICP, Censi 2008) with weights that leave out what disagrees. Space
    that the reference did not see neither attracts nor repels. Where the scans do not agree at the end, ``"auto"``
    searches around the guess from many starts, and takes the pose with the best score. In a map, the
    reference is the scan that is expected at the guess, and then at the pose found; where that fails, the whole window
    is searched.

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
        noise: Standard deviation of ranges [m]; errors beyond some three of them lose their weight.
        capture: Farthest distance between paired points at the start [m]: the error of a good guess.
        window: Half widths of the search: distance from the guess [m], and turn [rad].
        temperature: In (0, 1]: multiplies the information, for errors that are not independent from beam to beam. 1 is
            right for noise of ranges alone; recorded pairs have 0.02 to 0.1.

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
    if not isinstance(scanner, Scanner):
        raise TypeError(f"scanner: must be a Scanner, got {checks.show(scanner)}")
    checks.choice("method", method, METHODS)
    options = check_options(noise, capture, window)
    checks.real("temperature", temperature, above=0, high=1)
    device = get_backend(backend)
    real_dtype(precision, device)
    matches, single = _matches(reference, ranges, scanner, guess, method, device, precision, options)
    matches = replace(matches, covariance=matches.covariance / temperature)
    return matches[0] if single else matches


def _matches(
    reference: AnyArray | OccupancyGrid, ranges: AnyArray, scanner: Scanner, guess: ArrayLike, method: Method,
    device: Backend, precision: Precision, options: MatchOptions,
) -> tuple[ScanMatch, bool]:  # fmt: skip
    """Check the scans and the guess; return S matches, and whether a single one is wanted."""
    second = readings("ranges", ranges, scanner, device)
    if isinstance(reference, OccupancyGrid):
        if method == "icp":
            raise ValueError("method: 'icp' needs a scan as reference, got a map: use 'gauss_newton'")
        poses = check_guess(guess, None if second.ndim == 1 else len(second), np.inf)
        matches = match_to_map(reference, np.atleast_2d(second), scanner, poses, method, device, precision, options)
        return matches, second.ndim == 1
    first = readings("reference", reference, scanner, device)
    single = first.ndim == 1 and second.ndim == 1
    first, second = np.atleast_2d(first), np.atleast_2d(second)
    if len(first) not in (1, len(second)):
        rule = f"must be one scan, or as many as ranges has, {len(second)}"
        raise ValueError(f"reference: {rule}, got {len(first)}")
    poses = check_guess(guess, None if single else len(second))
    if method in ("gauss_newton", "correlative") and len(second):
        matches = match_by_maps(first, second, scanner, poses, method, device, precision, options)
        return matches, single
    real = np.dtype(precision)
    points = scan_points(np.concatenate([first, second]), scanner, real)
    pairs = np.stack([np.arange(len(second)) % max(len(first), 1), len(first) + np.arange(len(second))], axis=1)
    matches = match_pairs(device, real, points, pairs, poses, method, options, scanner.mount[:2])
    return matches, single


def readings(name: str, ranges: object, scanner: Scanner, backend: Backend) -> np.ndarray:
    """Return readings of one scan (K,) or of several (S, K), checked."""
    values = checks.as_array(name, arrays.copied_to_host(ranges, backend, name))
    shape = ("S", scanner.count) if values.ndim == 2 else (scanner.count,)
    return checks.array(name, values, shape, finite=False, dtype=None)
