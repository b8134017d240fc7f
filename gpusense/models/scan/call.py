"""One call of a scan model: its arguments, checked, its particles, and where its results go."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend, arrays
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.models.cloud import Cloud
from gpusense.models.scan.readings import check_ranges
from gpusense.world.scanner import Scanner

# Rays times particles of one scan up to which several scans share their launches, by kind of device. Above, a scan's
# launches fill the device for longer than it takes to start them.
TOGETHER = {"gpu": 1 << 22, "cpu": 1 << 20}


@dataclass
class ScanCall:
    """What one call of ``log_likelihood`` works on.

    Attributes:
        poses: As they were given.
        out: As it was given.
        ranges: (S, K) readings.
        single: One scan was given, without an axis for scans.
        clouds: The particles of each scan, or, together, one cloud of all of them.
        together: The scans share launches.
        count: Particles of each scan.
        shape: Of the log-likelihoods.
        flat: Where they go: a NumPy array or a buffer on the device.
        parts: (S, N, K) what each reading adds, or (S, N, 0).
    """

    poses: Any
    out: Any
    ranges: np.ndarray
    single: bool
    clouds: list[Cloud]
    together: bool
    count: int
    shape: tuple[int, ...]
    flat: Any
    parts: np.ndarray

    @property
    def on_device(self) -> bool:
        """Whether the poses are in the device's memory."""
        return any(cloud.on_device for cloud in self.clouds)

    @contextmanager
    def target(self, space: Workspace, begin: int, end: int) -> Iterator[np.ndarray | Buffer]:
        """Where the log-likelihoods of some particles of all scans are written by what is started within."""
        if self.on_device:
            with space.result("scan", self.flat, begin, end - begin, self.parts.dtype) as target:
                yield target
        else:
            yield self.flat[begin:end]

    def separate(self, backend: Backend) -> None:
        """Give each scan a cloud of its own."""
        self.clouds, self.together = clouds_of(self.poses, len(self.ranges), backend), False

    def log_p(self, backend: Backend) -> Any:
        """The log-likelihoods, in the library that the poses came from."""
        if self.out is not None:
            return self.out
        if arrays.on_device(self.poses):
            return arrays.lent(self.poses, backend, self.flat, self.shape, self.parts.dtype)
        return arrays.like(self.poses, self.flat.reshape(self.shape))


def call_of(
    poses: Any,
    ranges: Any,
    out: Any,
    *,
    scanner: Scanner,
    backend: Backend,
    real: np.dtype,
    per_beam: bool,
    most: float,
    known: dict[object, list[Cloud]] | None = None,
) -> ScanCall:
    """The call of some arguments.

    Args:
        poses: (N, 3), or (S, N, 3).
        ranges: (K,), or (S, K).
        out: None, or where the result is to be written.
        scanner: Whose readings they are.
        backend: The device.
        real: Precision of the result.
        per_beam: Whether parts are wanted.
        most: Particles of a scan up to which several share launches; 0 keeps all apart.
        known: Clouds that were made of the same poses before.

    Raises:
        TypeError, ValueError: an argument breaks its rule.
    """
    scans = check_ranges(arrays.copied_to_host(ranges, backend, "ranges"), scanner)
    single = scans.ndim == 1
    count = 0 if single else _particles(poses)
    together = len(scans) > 1 and not single and not per_beam and 0 < count <= most
    key = (single, together, 0 if single else len(scans))
    clouds = None if known is None else known.get(key)
    if clouds is None:
        if single:
            clouds = [Cloud(poses, backend)]
        else:
            clouds = [joint_cloud(poses, len(scans), backend)] if together else clouds_of(poses, len(scans), backend)
        if known is not None:
            known[key] = clouds
    if not together:
        count = clouds[0].count if clouds else np.shape(cast(Any, poses))[1]
    shape = (count,) if single else (len(scans), count)
    flat = arrays.check_out(out, shape, real, poses, backend)
    if arrays.on_device(poses):
        flat = arrays.blank(backend, math.prod(shape), real) if flat is None else flat
    else:
        flat = (np.empty(shape, real) if flat is None else flat).reshape(-1)
    parts = np.zeros((*shape, scanner.count if per_beam else 0), real)
    scans = scans[None] if single else scans
    parts = parts.reshape(len(scans), count, parts.shape[-1])
    return ScanCall(poses, out, scans, single, clouds, together, count, shape, flat, parts)


def _particles(poses: Any) -> int:
    """N of (S, N, 3) poses; 0 where they are something else, which other checks say."""
    shape = getattr(poses, "shape", None)
    if shape is None:
        try:
            shape = np.shape(poses)
        except ValueError:
            return 0
    return int(shape[1]) if len(shape) == 3 else 0


def joint_cloud(poses: Any, scans: int, backend: Backend) -> Cloud:
    """One cloud of the particles of S scans, one scan after the other, from (S, N, 3) poses.

    Raises:
        TypeError, ValueError: not numbers, another shape, or a pose that is not finite.
    """
    if arrays.on_device(poses):
        _check_shape(poses, scans)
        return Cloud(poses, backend, several=True)
    given = checks.array("poses", arrays.to_host(poses), (scans, "N", 3), finite=False)
    try:
        return Cloud(given.reshape(-1, 3), backend)
    except ValueError:
        # It tells the place among all particles: here it is told by scan.
        checks.array("poses", given, (scans, "N", 3))
        raise


def clouds_of(poses: Any, scans: int, backend: Backend) -> list[Cloud]:
    """The clouds of S scans from (S, N, 3) poses.

    Raises:
        TypeError, ValueError: not numbers, another shape, or a pose that is not finite.
    """
    if not arrays.on_device(poses):
        return [Cloud(one, backend) for one in checks.array("poses", arrays.to_host(poses), (scans, "N", 3))]
    _check_shape(poses, scans)
    return [Cloud(poses[i], backend) for i in range(scans)]


def _check_shape(poses: Any, scans: int) -> None:
    shape = tuple(getattr(poses, "shape", ()))
    if len(shape) != 3 or shape[0] != scans or shape[2] != 3:
        raise ValueError(f"poses: shape must be ({scans}, N, 3), got {checks.shape_text(shape)}")
