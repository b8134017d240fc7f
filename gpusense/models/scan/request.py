"""A request: the arguments of one call of a scan model, checked once."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from typing import Any, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense.backends import arrays
from gpusense.backends.results import Result
from gpusense.models.poses import Poses
from gpusense.models.scan.classed import check_ranges
from gpusense.models.scan.rules import ModelContext
from gpusense.tables.world_index import WorldIndex
from gpusense.tables.worlds import Worlds
from gpusense.world.plausible import look_at_poses

FLOATS = (np.dtype(np.float32), np.dtype(np.float64))
# Poses that several models share, checked once, by the number of scans.
Known = MutableMapping[int | None, Poses]


class Request(NamedTuple):
    """S scans of N poses each."""

    ranges: np.ndarray  # (S, K) readings [m]
    poses: Poses  # the S N poses, one scan after the other
    shape: tuple[int, ...]  # shape of the result, (N,) or (S, N)
    result: Result  # memory of the result
    parts: np.ndarray  # (S, N, K) log-likelihoods of the readings; (S, N, 0) where they are not requested
    per_beam: bool  # true if they are requested, of a scanner with beams
    # Called once readings are on the device; it starts the launches that write the poses.
    before: Callable[[], None] | None = None
    own_scans: bool = False  # true if each of (N, 3) poses has a separate scan

    @property
    def scans(self) -> int:
        """S."""
        return len(self.ranges)

    @property
    def per_scan(self) -> int:
        """N."""
        return 1 if self.own_scans else self.shape[-1]

    def result_parts(self) -> np.ndarray:
        """Return the log-likelihoods of the readings, (N, K) or (S, N, K)."""
        return self.parts.reshape(*self.shape, self.parts.shape[-1])


def make_request(
    context: ModelContext,
    poses: Any,
    ranges: Any,
    out: Any = None,
    *,
    per_beam: bool = False,
    known: Known | None = None,
    before: Callable[[], None] | None = None,
    worlds: Worlds | None = None,
    world: Any = None,
    ignore: Any = None,
) -> Request:
    """Check the arguments of a call.

    Args:
        context: The model's device, precision and scanner.
        poses: (N, 3), or (S, N, 3).
        ranges: (K,), or (S, K).
        out: None, or the array for the result.
        per_beam: True if the log-likelihoods of the readings are requested.
        known: Poses that were checked before.
        before: See Request.
        worlds: The worlds of a model of worlds.
        world: (N,) indices of the poses' worlds.
        ignore: (N,) indices of the shapes that poses do not see.
    """
    backend, real, scanner = context.backend, context.real, context.rules.scanner
    if scanner._first_scans.left and isinstance(poses, (np.ndarray, list, tuple)):
        look_at_poses("poses", poses)
    beams = scanner.count
    if type(ranges) is np.ndarray and ranges.shape == (beams,) and ranges.dtype in FLOATS:
        readings: np.ndarray = ranges
    else:
        readings = check_ranges(arrays.copied_to_host(ranges, backend, "ranges"), scanner)
    known = {} if known is None else known
    shape: tuple[int, ...]
    if worlds is not None:
        checked = Poses(poses, backend, late=True)
        if readings.ndim == 2 and len(readings) != checked.count:
            got = checks.shape_text(readings.shape)
            raise ValueError(f"ranges: shape must be ({beams},) or ({checked.count}, {beams}), got {got}")
        checked.inside = WorldIndex(worlds, world, ignore, checked.count, backend)
        own_scans, shape = readings.ndim == 2, (checked.count,)
        readings = readings if own_scans else readings[None]
        result = Result(poses, out, shape, real, backend, on_device=checked.on_device)
        parts = np.zeros((len(readings), 1 if own_scans else shape[0], beams if per_beam else 0), real)
        return Request(readings, checked, shape, result, parts, per_beam and beams > 0, before, own_scans)
    for name, value in (("world", world), ("ignore", ignore)):
        if value is not None:
            raise ValueError(f"{name}: must be None for a model of a single map, got {checks.show(value)}")
    if readings.ndim == 1:
        checked = known[None] = known.get(None) or Poses(poses, backend, late=True)
        readings, shape = readings[None], (checked.count,)
    else:
        scans = len(readings)
        checked = known[scans] = known.get(scans) or Poses(poses, backend, scans=scans, late=True)
        shape = (scans, checked.count // scans if scans else np.shape(poses)[1])
    result = Result(poses, out, shape, real, backend, on_device=checked.on_device)
    parts = np.zeros((len(readings), shape[-1], beams if per_beam else 0), real)
    return Request(readings, checked, shape, result, parts, per_beam and beams > 0, before)
