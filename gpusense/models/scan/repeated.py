"""Scans of poses that stay in place on a processor, such as a filter's: only readings change from call to call.

The host classes and uploads the readings of each scan. All other work of a call, from the checks of arguments to the
arguments of its launches, is done once for each place of the poses and each number of readings.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gpusense.backends.base import Buffer
from gpusense.backends.programs import ChangingProgram, RepeatedPrograms
from gpusense.backends.workspace import Workspace
from gpusense.interface.launches import flags_of
from gpusense.models.chunking import chunk_of
from gpusense.models.poses import PlacedPoses, Poses
from gpusense.models.scan.pipeline import ScanPipeline
from gpusense.models.scan.request import FLOATS, Request
from gpusense.models.scan.scoring import LastCall
from gpusense.tables.reachable import MapState

_IN_LANES = frozenset({"IN_LANES"})
# Most places of poses that are kept.
_MOST = 16


class _Place(NamedTuple):
    """Poses and log-likelihoods on the device.

    Attributes:
        number: A unique number.
        owners: The user's arrays, kept alive so that their identities are unique.
        poses: The poses.
        log_p: The buffer for log-likelihoods.
    """

    number: int
    owners: tuple[Any, Any]
    poses: Poses
    log_p: Buffer


class _Placed(NamedTuple):
    """Poses in a map.

    Attributes:
        number: A unique number.
        poses: The poses.
        map: The map with its table.
        flags: Flags of the launch that places them, as ``explain`` reports them.
    """

    number: int
    poses: PlacedPoses
    map: MapState
    flags: frozenset[str]


class ResidentCall:
    """Starts scans of poses that were scored before.

    Args:
        pipeline: The stages of the model.
        space: Holds the buffers.
        last: Receives the facts that ``explain`` reports.
    """

    def __init__(self, pipeline: ScanPipeline, space: Workspace, last: LastCall) -> None:
        self._pipeline, self._space, self._last = pipeline, space, last
        self._places: dict[tuple[int, int], _Place] = {}
        self._count = 0
        self._placing = RepeatedPrograms(pipeline.backend, _MOST)

    def remember(self, poses: Any, out: Any, request: Request) -> None:
        """Keep the place of the poses of a request that was started, if it can be repeated."""
        backend, count = self._pipeline.backend, request.poses.count
        whole = request.scans == 1 and 0 < count <= chunk_of(backend, self._pipeline.scanner.count)
        if backend.info.kind != "cpu" or not request.poses.on_device or not whole:
            return
        if len(self._places) >= _MOST:
            del self._places[next(iter(self._places))]
        self._count += 1
        log_p = backend.part(request.result.flat, 0, count, self._pipeline.real)
        self._places[id(poses), id(out)] = _Place(self._count, (poses, out), request.poses, log_p)

    def start(self, poses: Any, ranges: Any, out: Any, before: Callable[[], None] | None) -> bool:
        """Start a scan, and return whether it could be; the arguments are those of ``ScanModel.start_scoring``."""
        place, pipeline, space = self._places.get((id(poses), id(out))), self._pipeline, self._space
        plain = type(ranges) is np.ndarray and ranges.shape == (pipeline.scanner.count,) and ranges.dtype in FLOATS
        if place is None or not plain or pipeline.trial is not None:
            return False
        scans = pipeline.classed(ranges[None])
        if pipeline.value(scans) is not None:
            return False
        readings = pipeline.upload(scans, space)
        placed = self._placed(place)
        scoring = pipeline.scoring(readings, placed.poses, placed.map.table, place.log_p, space)
        key = place.number, scoring.flags, readings.key
        program = space.kept(key, placed.map.version)
        if program is None:
            made = ChangingProgram(pipeline.backend, pipeline.score_launches(scoring), pipeline.numbers(scoring))
            program = space.keep(key, made, placed.map.version)
        if before is not None:
            before()
        self._placing.run(placed.number, placed.poses.launches)
        program(pipeline.numbers(scoring))
        last = self._last
        last.flags = program.flags | placed.flags
        last.scans, last.together, last.kernels = scans, 0, pipeline.kernel_names[False]
        return True

    def _placed(self, place: _Place) -> _Placed:
        """Return the poses of a place in the present map."""
        pipeline, space = self._pipeline, self._space
        key = place.number, "placed"
        placed: _Placed | None = space.kept(key, pipeline.map.version)
        if placed is None:
            poses, state = pipeline.place(place.poses, (0, place.poses.count), space)
            self._count += 1
            flags = flags_of(poses.launches()) - _IN_LANES
            placed = space.keep(key, _Placed(self._count, poses, state, flags), state.version)
        return placed
