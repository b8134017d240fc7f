"""A request: the arguments of one call of a scan model, checked once."""

from __future__ import annotations

import math
from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend, arrays
from gpusense.models.poses import Poses
from gpusense.models.scan.classed import check_ranges
from gpusense.world.scanner import Scanner

# Poses that several models share, checked once, by the number of scans.
Known = MutableMapping[int | None, Poses]


@dataclass(frozen=True)
class Request:
    """S scans of N poses each.

    Attributes:
        array: The poses as the user passed them, which determine the library of the result.
        out: The array for the result as the user passed it, or None.
        ranges: (S, K) readings [m].
        poses: The S N poses, one scan after the other.
        shape: Shape of the result, (N,) or (S, N).
        log_p: Flat memory of the result: a NumPy array, or a buffer on the device.
        parts: (S, N, K) log-likelihoods of the readings; (S, N, 0) where they are not requested.
    """

    array: Any
    out: Any
    ranges: np.ndarray
    poses: Poses
    shape: tuple[int, ...]
    log_p: Any
    parts: np.ndarray

    @property
    def scans(self) -> int:
        """S."""
        return len(self.ranges)

    @property
    def per_scan(self) -> int:
        """N."""
        return self.shape[-1]

    @property
    def per_beam(self) -> bool:
        """Whether the log-likelihoods of the readings are requested."""
        return self.parts.shape[-1] > 0

    def result(self, backend: Backend) -> Any:
        """Return the log-likelihoods in the library of the poses."""
        if self.out is not None:
            return self.out
        if self.poses.on_device:
            return arrays.lent(self.array, backend, self.log_p, self.shape, self.parts.dtype)
        return arrays.like(self.array, self.log_p.reshape(self.shape))

    def result_parts(self) -> np.ndarray:
        """Return the log-likelihoods of the readings, (N, K) or (S, N, K)."""
        return self.parts.reshape(*self.shape, self.parts.shape[-1])


def make_request(
    poses: Any,
    ranges: Any,
    out: Any,
    *,
    scanner: Scanner,
    backend: Backend,
    real: np.dtype,
    per_beam: bool = False,
    known: Known | None = None,
) -> Request:
    """Check the arguments of a call.

    Args:
        poses: (N, 3), or (S, N, 3).
        ranges: (K,), or (S, K).
        out: None, or the array for the result.
        scanner: The scanner of the readings.
        backend: The device.
        real: Precision of the result.
        per_beam: Whether the log-likelihoods of the readings are requested.
        known: Poses that were checked before.

    Raises:
        TypeError, ValueError: an argument breaks its rule.
    """
    readings = check_ranges(arrays.copied_to_host(ranges, backend, "ranges"), scanner)
    scans = None if readings.ndim == 1 else len(readings)
    checked = None if known is None else known.get(scans)
    if checked is None:
        checked = Poses(poses, backend) if scans is None else _poses_of_scans(poses, scans, backend)
        if known is not None:
            known[scans] = checked
    shape: tuple[int, ...] = (checked.count,)
    if scans is None:
        readings = readings[None]
    else:
        shape = (scans, checked.count // scans if scans else np.shape(poses)[1])
    log_p = arrays.check_out(out, shape, real, poses, backend)
    if checked.on_device:
        log_p = arrays.blank(backend, math.prod(shape), real) if log_p is None else log_p
    else:
        log_p = (np.empty(shape, real) if log_p is None else log_p).reshape(-1)
    parts = np.zeros((len(readings), shape[-1], scanner.count if per_beam else 0), real)
    return Request(poses, out, readings, checked, shape, log_p, parts)


def _poses_of_scans(poses: Any, scans: int, backend: Backend) -> Poses:
    """Return the poses of S scans, one scan after the other, from (S, N, 3) poses.

    Raises:
        TypeError, ValueError: not numbers, another shape, or a pose that is not finite.
    """
    if arrays.on_device(poses):
        shape = tuple(poses.shape)
        if len(shape) != 3 or shape[0] != scans or shape[2] != 3:
            raise ValueError(f"poses: shape must be ({scans}, N, 3), got {checks.shape_text(shape)}")
        return Poses(poses, backend, several=True)
    read = checks.array("poses", arrays.to_host(poses), (scans, "N", 3), finite=False)
    try:
        return Poses(read.reshape(-1, 3), backend)
    except ValueError:
        # This check names the scan in its message; the first one names the index among all poses.
        checks.array("poses", read, (scans, "N", 3))
        raise
