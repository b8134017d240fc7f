"""Extract features from scans: lines, corners, doors, hallways and poles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

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
from gpusense.features.result import KINDS, Features, Found, check_kinds, features_of
from gpusense.features.segments import find_segments
from gpusense.matching.match import readings
from gpusense.matching.noise import ASSUMED_NOISE, scan_noise
from gpusense.matching.points import scan_points
from gpusense.world.scanner import Scanner

# Noise with which scans are split: at least this [m], at most this.
_LEAST_NOISE, _LARGEST_NOISE = 3e-3, 0.1


def extract_features(
    ranges: AnyArray,
    scanner: Scanner,
    kinds: str | Sequence[str] = KINDS,
    backend: Selection = "auto",
    *,
    noise: float | Literal["auto"] = "auto",
) -> Features:
    """Extract lines, corners, doors, hallways and poles from scans."""
    if not isinstance(scanner, Scanner):
        raise TypeError(f"scanner: must be a Scanner, got {checks.show(scanner)}")
    wanted = check_kinds("kinds", kinds)
    given = None if isinstance(noise, str) and noise == "auto" else checks.real("noise", noise, above=0)
    device = get_backend(backend)
    scans = np.atleast_2d(readings("ranges", ranges, scanner, device))
    real = np.dtype(np.float64 if device.info.float64 else np.float32)
    deviation = np.full(len(scans), given) if given else scan_noise(scans, scanner)
    deviation = np.where(np.isnan(deviation), ASSUMED_NOISE, deviation)
    deviation = np.clip(deviation, _LEAST_NOISE, _LARGEST_NOISE)
    return features_of(_found(device, real, scans, scanner, deviation, wanted))


def _found(
    backend: Backend, real: np.dtype, scans: np.ndarray, scanner: Scanner, noise: np.ndarray, kinds: tuple[str, ...]
) -> dict[str, Found]:
    """Return the features of (S, K) readings by kind."""
    points = scan_points(scans, scanner, np.dtype(np.float64))
    if not len(points.point):
        return {}
    device = ScanDevice(backend, real, points, noise)
    segments = find_segments(device, points, noise)
    is_line = straight(device, segments)
    beams = beams_of(scans, scanner, points)
    finders = {
        "line": lambda: find_lines(segments, np.flatnonzero(is_line), scanner.mount),
        "corner": lambda: find_corners(segments, is_line, scanner.mount),
        "door": lambda: find_doors(segments, is_line, beams, scanner.mount),
        "hallway": lambda: find_hallways(segments, is_line, scanner.mount),
        "pole": lambda: find_poles(device, segments, beams, noise, scanner.mount),
    }
    return {kind: finders[kind]() for kind in KINDS if kind in kinds}
