"""Extract features from scans: lines, corners, doors, hallways, poles and reflectors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import AnyArray
from gpusense.backends import Selection, get_backend
from gpusense.backends.base import Backend
from gpusense.features.beams import beams_of
from gpusense.features.corners import find_corners
from gpusense.features.device import ScanDevice
from gpusense.features.doors import find_doors
from gpusense.features.hallways import find_hallways
from gpusense.features.lines import find_lines, straight
from gpusense.features.poles import find_poles
from gpusense.features.reflectors import find_reflectors
from gpusense.features.result import KINDS, Features, Found, check_kinds, features_of, joined
from gpusense.features.segments import find_segments
from gpusense.matching.match import readings
from gpusense.matching.noise import ASSUMED_NOISE, whole_noise
from gpusense.matching.points import scan_points
from gpusense.world.scanner import Scanner

# Least and largest noise with which scans are split [m].
_LEAST_NOISE, _LARGEST_NOISE = 3e-3, 0.1
# Most readings that are processed at once.
_READINGS = 1 << 22


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

    A scan is split into straight pieces where two lines explain its readings better than one, by more than noise does
    (split and merge, Pavlidis and Horowitz 1974), and a line is fitted to the ranges of each by maximum likelihood.
    Pieces that a circle explains as well are round walls rather than lines. Corners are vertices of neighbouring lines.
    Doors are gaps of 0.5 to 2 m in a wall, between two jambs, through which beams pass; hallways are parallel walls 0.6
    to 3.2 m apart on both sides of the scanner, beside each other for twice their distance; poles are circles with
    radii of 1.5 to 50 cm in front of their background. Reflectors are short runs of beams at least three times as
    bright as the median of their scan; they count as cylinders.

    Covariances follow from the standard deviation of ranges, which is estimated from each scan, from the residuals of
    each line, and from the distance between beams at edges. The device computes in float64 where it can, and in float32
    elsewhere.

    Args:
        ranges: (K,) readings of a scan [m], or (S, K) of several. They are classed by :func:`gpusense.classify`. A
            reading of "no return" shows that its beam passes through a gap.
        scanner: The scanner; its mount is the sensor's pose on the robot. The robot is at rest during a scan:
            :func:`gpusense.deskew_scan` corrects a scan taken in motion.
        kinds: Kinds to extract: one, or several of "line", "corner", "door", "hallway", "pole" and "reflector".
        backend: The device, see ``gpusense.devices()``; or a queue of pyopencl.
        noise: Standard deviation of ranges [m]. ``"auto"``: that of each scan, from its deviations from straight
            walls; scans with more than 10 cm of noise have no lines.
        intensities: Intensities of the readings, of their shape, in any unit; NaN where unknown. None: no reflectors.

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
    """Return the features of (S, K) readings by kind, except reflectors."""
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
