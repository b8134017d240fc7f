"""Run the programs of a request in pieces; readings of a group of scans are uploaded once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from gpusense.backends.arrays import FLOATS
from gpusense.backends.workspace import ChangingProgram, PartialResult, RecordedProgram, Workspace
from gpusense.models.chunking import Piece, chunk_of, run_pieces
from gpusense.models.poses import Part, place
from gpusense.models.scan.classed import ClassedScans
from gpusense.models.scan.pipeline import Request, ScanPipeline
from gpusense.models.scan.readings import Readings
from gpusense.world.range_causes import NoReturn
from gpusense.world.windows import Frame, whole

_IN_LANES = frozenset({"IN_LANES"})


@dataclass
class LastCall:
    """The last call, as ``explain`` reports it."""

    flags: frozenset[str] = frozenset()  # flags of its launches
    scans: ClassedScans | None = None  # the readings of its last scans; None before there is a call
    together: int = 0  # number of scans that shared launches
    kernels: tuple[str, ...] = ()  # the kernels of its last piece, from the poses to log-likelihoods

    @property
    def scan(self) -> ClassedScans | None:
        """The readings of its last scan."""
        return None if self.scans is None else self.scans.part(self.scans.scans - 1, self.scans.scans)


def run(pipeline: ScanPipeline, request: Request, space: Workspace, last: LastCall) -> None:
    """Start all launches of a request; log-likelihoods of readings are complete on return.

    ``last``: receives the facts that ``explain`` reports.
    """
    last.flags, last.kernels, last.together = frozenset(), (), 0
    for particles, scans in pipeline.groups(request):
        last.scans = scans
        if not particles.count:
            continue
        most = pipeline.most_particles(scans.most_readings, request.poses.inside, per_beam=request.per_beam)
        run_pieces(space, particles, most, _Scorer(pipeline, request, particles, scans, space, last))
        if len(request.ranges) > 1:
            space.submit()


def terms_of(pipeline: ScanPipeline, each: np.ndarray, columns: np.ndarray, constant_max: np.ndarray) -> np.ndarray:
    """Return (N, K) terms of the readings of a scan from the (N, R) terms of its rays; readings left out have 0."""
    terms = np.zeros((len(each), pipeline.scanner.count), pipeline.real)
    terms[:, columns] = each[:, : len(columns)]
    terms[:, constant_max] = NoReturn(pipeline.rules.z_max).number
    return terms


class ResidentPoses:
    """Poses in place on a processor, such as a filter's: only the readings of a scan change from call to call.

    ``request`` keeps the arrays alive, so that their identities stay unique.
    """

    def __init__(self, pipeline: ScanPipeline, request: Request, space: Workspace, last: LastCall) -> None:
        self._pipeline, self._space, self._last = pipeline, space, last
        # The workspace keeps programs by this key: nothing in it refers to itself.
        self._key = object()
        # Without the function of its owner, which the model must not keep alive.
        self._request = request._replace(before=None)
        self._log_p = pipeline.backend.part(request.result.flat, 0, request.poses.count, pipeline.real)

    @staticmethod
    def holds(pipeline: ScanPipeline, request: Request) -> bool:
        """Return whether calls of a request's poses can be repeated."""
        backend, poses = pipeline.backend, request.poses
        whole = request.scans == 1 and 0 < poses.count <= chunk_of(backend, pipeline.scanner.count)
        return backend.info.kind == "cpu" and poses.on_device and whole

    def start(self, ranges: Any, before: Callable[[], None] | None) -> bool:
        """Start a scan, and return whether it could be; see ``ScanModel.start_scoring``."""
        pipeline, space, last = self._pipeline, self._space, self._last
        plain = type(ranges) is np.ndarray and ranges.shape == (pipeline.scanner.count,) and ranges.dtype in FLOATS
        if not plain or pipeline.trial is not None:
            return False
        scans = pipeline.classed(ranges[None])
        if pipeline.value(scans) is not None:
            return False
        readings = pipeline.upload(scans, space)
        kept = space.kept(self._key, pipeline.map.version)
        if kept is None:
            # The map's table or a buffer is new.
            placed, state = pipeline.place(self._request.poses, (0, self._request.poses.count), space)
            kept = placed._replace(space=cast(Any, None)), state, RecordedProgram(pipeline.backend, placed.launches())
            space.keep(self._key, kept, state.version)
        placed, state, placing = kept
        scoring = pipeline.scoring(readings, placed._replace(space=space), state.table, self._log_p, space)
        key, numbers = (self._key, scoring.flags, readings.key), pipeline.numbers(scoring)
        program = space.kept(key, state.version)
        if program is None:
            made = ChangingProgram(pipeline.backend, pipeline.score_launches(scoring), numbers)
            program = space.keep(key, made, state.version)
        if before is not None:
            before()
        placing.start()
        program(numbers)
        last.flags = program.flags | (placing.flags - _IN_LANES)
        last.scans, last.together, last.kernels = scans, 0, pipeline.kernel_names[False]
        return True


class _Scorer:
    """Run the programs of one group of scans; their readings are uploaded once."""

    def __init__(
        self, pipeline: ScanPipeline, request: Request, particles: Piece, scans: ClassedScans, space: Workspace,
        last: LastCall,
    ) -> None:  # fmt: skip
        self._pipeline, self._request, self._space, self._last = pipeline, request, space, last
        self._first, self._scans, self._before = particles.scans[0], scans, request.before
        self._uploaded: tuple[Part, Readings] | None = None

    def __call__(self, piece: Piece) -> None:
        first, last = piece.scans
        scans = self._scans
        if last - first < scans.scans:
            scans = scans.part(first - self._first, last - self._first)
        depends = self._pipeline.context.possible and len(scans.readings)
        value = None if depends else self._pipeline.value(scans)
        if value is None and (self._uploaded is None or self._uploaded[0] != piece.scans):
            self._uploaded = piece.scans, self._pipeline.upload(scans, self._space)
        if value is not None:
            self._begin()
            self._fill(piece, scans, value)
        elif self._uploaded is not None:
            self._score(piece, scans, self._uploaded[1])

    def _begin(self) -> None:
        """Start the launches that write the poses, only once, even if a piece is retried."""
        before, self._before = self._before, None
        if before is not None:
            before()

    def _score(self, piece: Piece, scans: ClassedScans, readings: Readings) -> None:
        """Score a piece; log-likelihoods of readings are complete on return."""
        pipeline, request, space = self._pipeline, self._request, self._space
        placed, state = pipeline.place(request.poses, piece.part, space)
        log_p = PartialResult(space, "log_p", request.result.flat, piece.begin, piece.count, pipeline.real)
        scoring = pipeline.scoring(readings, placed, state.table, log_p.buffer, space, per_beam=request.per_beam)
        key = (scoring.flags, placed.key, readings.key)
        changing = dict(pipeline.numbers(scoring), poses=placed.source, log_p=log_p.buffer)
        if placed.inside is not None:
            changing |= placed.changing()
        # As late as possible: a processor's threads are then awake for the launches that follow.
        if self._before is not None:
            self._begin()
        flags = space.run(key, changing, lambda: pipeline.program(scoring), version=state.version)
        log_p.deliver()
        self._last.kernels = pipeline.kernel_names[scoring.tiles is not None]
        # Poses are placed in lanes, whatever kernel scores them.
        self._last.flags = (flags - _IN_LANES) | (scoring.flags & _IN_LANES)
        if readings.scans > 1:
            self._last.together = max(self._last.together, readings.scans)
        if request.per_beam:
            each = np.empty((piece.count, len(scans.readings)), pipeline.real)
            each = pipeline.backend.download(pipeline.parts(scoring).buffer, each)
            self._rows(piece)[...] = terms_of(pipeline, each, scans.columns, scans.left_out.constant_max)

    def _fill(self, piece: Piece, scans: ClassedScans, value: float) -> None:
        """Set log-likelihoods that do not depend on the poses; device poses are still inspected."""
        pipeline, request, space = self._pipeline, self._request, self._space
        if request.poses.on_device:
            frame = Frame(whole(pipeline.grid), pipeline.grid, pipeline.scanner.mount)
            placed = place(request.poses, piece.part, frame, pipeline.backend, space, pipeline.real)
            pipeline.backend.run(placed.launches())
            log_p = PartialResult(space, "log_p", request.result.flat, piece.begin, piece.count, pipeline.real)
            pipeline.backend.upload(np.full(piece.count, value, pipeline.real), log_p.buffer)
            log_p.deliver()
        else:
            # Poses that are not finite are refused whatever the readings.
            request.poses.corners(piece.part, pipeline.backend)
            request.result.flat[piece.begin : piece.end] = value
        if request.per_beam:
            rows, finite = self._rows(piece), np.isfinite(scans.readings)
            rows[:, scans.columns[finite]] = -np.inf
            rows[:, scans.columns[~finite]] = NoReturn(pipeline.rules.z_max).number
            rows[:, scans.left_out.constant_max] = NoReturn(pipeline.rules.z_max).number

    def _rows(self, piece: Piece) -> np.ndarray:
        """Return the rows of a piece of one scan in the parts of the request."""
        scan = piece.scans[0]
        before = scan * piece.per_scan
        return self._request.parts[scan, piece.begin - before : piece.end - before]
