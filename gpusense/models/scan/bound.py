"""Bound calls: arrays that stay in place, a single start per call, and no repeated checks.

In a call of few particles the host takes longer than the kernels: for checks, the preparation of the scan, and a start
of each launch. If poses and readings are on the device, all of this is done once. The kernel file ``scan`` classes and
places readings there, and the program is recorded (``Backend.record``), with CUDA as a graph.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from gpusense.backends import Backend, arrays
from gpusense.backends.arrays import Result
from gpusense.backends.base import Adopted, Buffer, Exchange, Recording
from gpusense.backends.workspace import POSE_STATUS, Packed, ProgramCache, RecordedProgram, Workspace
from gpusense.interface.constants import BLOCK_TERMS
from gpusense.interface.launches import Program
from gpusense.models.chunking import chunk_of, finish
from gpusense.models.poses import Poses
from gpusense.models.scan.map_caster import MapCaster
from gpusense.models.scan.pipeline import ScanPipeline
from gpusense.models.scan.readings import Readings, device_readings, device_scans
from gpusense.models.scan.scoring import terms_of
from gpusense.tables.reachable import ReachableMap
from gpusense.tables.world_index import WorldIndex

_INT = np.dtype(np.int32)


class BoundCall(ABC):
    """A call on arrays that stay in place, made by ``bind`` of a model or a ``RayCaster``.

    Attributes:
        out: (N,) log-likelihoods, or (N, K) ranges of a caster, in the memory and of the library of the poses; every
            call writes them.
        waits: True if a call has ended when it returns.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> grid, poses = gs.OccupancyGrid([[0] * 20 + [100]]), np.array([(1.0, 0.05, 0.0), (0.5, 0.05, 0.0)])
        >>> model = gs.BeamModel(grid, gs.Scanner([0.0], range_max=4.0), backend="numpy")
        >>> call = model.bind(poses, np.array([0.5]))
        >>> poses[0] = (0.4, 0.05, 0.0)
        >>> bool((call() == model.log_likelihood(poses, [0.5])).all())
        True
    """

    out: Any
    waits: bool

    @abstractmethod
    def __call__(self, stream: Any = None) -> Any:
        """Score, or cast, the present contents of the arrays.

        Args:
            stream: A stream of the GPU on which to work: of PyTorch, CuPy or Warp, or its address; with OpenCL a queue
                of the model's context. None for Warp's current stream of the device, and the model's queue. Only for
                calls that do not wait.

        Returns:
            ``out``; if ``waits`` is False, the device may not have written it yet.
        """

    @abstractmethod
    def explain(self) -> str:
        """Return in one line how a call is started: ``"one CUDA graph of 3 launches"``, or the reason for none.

        A graph is captured at the second call, so the line is final after two calls.
        """

    @abstractmethod
    def check(self) -> None:
        """Wait until all calls have ended.

        Raises:
            ValueError: A pose was not finite in some call since the last check; a call that waits reports it at once.
        """


class ReplayedCall(BoundCall):
    """A recorded program on arrays of the device, made anew when the map's table changes.

    ``lock``: held while the buffers of its owner are in use; ``owners``: owners of the memory that calls read and
    write; ``chunk``: the most poses of a piece.
    """

    waits = False

    def __init__(
        self, backend: Backend, charted: ReachableMap, lock: threading.Lock, poses: Poses, owners: object, out: Any,
        space: Workspace, chunk: int,
    ) -> None:  # fmt: skip
        self._backend, self._map, self._lock, self._poses = backend, charted, lock, poses
        self._owners, self.out, self._space = owners, out, space
        # Pieces begin where parts of buffers can.
        whole = max(backend.alignment // _INT.itemsize, 1)
        self._chunk = -(-chunk // whole) * whole
        # The program for the current map, by the version of the map's table.
        self._programs = ProgramCache[RecordedProgram](1)
        self._recorded()

    def __call__(self, stream: Any = None) -> Any:
        self._current().recording(stream)
        return self.out

    def explain(self, words: Callable[[Recording], str] = lambda one: one.explain()) -> str:
        for _, program in self._programs.items():
            return words(program.recording)
        return "nothing is recorded: the map has changed, and its new table did not fit the device"

    def check(self) -> None:
        self._backend.check_process()
        for _, program in self._programs.items():
            program.recording.wait(elsewhere=True)
        finish(self._space, on_device=True)

    def _current(self) -> RecordedProgram:
        """Return the program for the current map."""
        self._backend.check_process()
        program = self._programs.get(self._map.version)
        if program is None:
            # The map, or its table, has changed.
            self._wait()
            program = self._recorded()
        return program

    def _wait(self) -> None:
        """Wait for the last program; no variable of the caller keeps its buffers."""
        for _, program in self._programs.items():
            program.recording.wait()

    def _recorded(self) -> RecordedProgram:
        """Make the table if it is missing, and record the program of a call; nothing is started."""
        with self._lock:
            # Keep the table, since another call of the model may replace it; free the last one first.
            self._table = None
            self._programs.clear()
            state = self._poses.ensure_table(self._map, (0, self._poses.count), self._backend)
            self._table, version = state.table, state.version
            program = RecordedProgram(self._backend, self._program())
        # Other streams may use the buffers of this one first.
        self._backend.synchronize()
        return self._programs.keep(version, program)

    def _program(self) -> Program:
        """Return all launches of a call."""
        count = self._poses.count
        parts = [(begin, min(begin + self._chunk, count)) for begin in range(0, count, self._chunk)]
        return tuple(one for part in parts for one in self._piece(*part))

    @abstractmethod
    def _piece(self, begin: int, end: int) -> Program:
        """Return the launches for some poses."""


class RecordedCast(ReplayedCall):
    """A call of ``RayCaster.cast``; see ``ReplayedCall``."""

    def __init__(
        self, caster: MapCaster, poses: Any, vectors: np.ndarray, out: Any, index: Callable[[int], WorldIndex | None]
    ) -> None:
        backend, self._caster, self._rays = caster.backend, caster, len(vectors)
        placed = Poses(poses, backend, in_place=True)
        placed.inside = index(placed.count)
        result = Result(poses, out, (placed.count, self._rays), caster.real, backend, on_device=True)
        self._ranges, array = result.flat, result.user_array()
        space = Workspace(backend)
        self._ray = caster.rays(vectors, space)
        chunk = chunk_of(backend, self._rays, caster.real.itemsize)
        super().__init__(backend, caster.map, caster.lock, placed, (poses, array), array, space, chunk)

    def _piece(self, begin: int, end: int) -> Program:
        caster, rays = self._caster, self._rays
        if not rays:
            return ()
        ranges = self._backend.part(self._ranges, begin * rays, (end - begin) * rays, caster.real)
        return caster.program(self._poses, (begin, end), self._ray, rays, ranges, self._space)


class RecordedCall(ReplayedCall):
    """A call of ``log_likelihood``; see ``ReplayedCall``.

    ``status``: a buffer for the non-finite flag, which its owner inspects; ``limits``: type to which the scanner's
    limits are rounded, by default the type of the ranges; ``inside``: the worlds of the poses, in which ranges may be
    (N, K); ``per_beam``: whether to keep the term of each reading.
    """

    def __init__(
        self,
        pipeline: ScanPipeline,
        lock: threading.Lock,
        poses: Any,
        ranges: Any,
        out: Any,
        status: Buffer | None = None,
        limits: np.dtype | None = None,
        inside: WorldIndex | None = None,
        *,
        per_beam: bool = False,
    ) -> None:
        backend, real = pipeline.backend, pipeline.real
        self._pipeline, self._per_beam = pipeline, per_beam
        placed = Poses(poses, backend, in_place=True)
        placed.inside = inside
        own_scans = inside is not None and len(ranges.shape) == 2
        beams = pipeline.scanner.count
        shape = (placed.count, beams) if own_scans else (beams,)
        adopted = arrays.adopt_readings(ranges, backend, shape, in_place=True)
        result = Result(poses, out, (placed.count,), real, backend, on_device=True)
        self._log_p, array = result.flat, result.user_array()
        # Private buffers: other calls of the model may come between.
        self._space = Workspace(backend)
        if status is not None:
            self._space.share(POSE_STATUS[0], status, 2, _INT)
        self._first: Program = ()
        self._exchange: tuple[Buffer, Exchange] | None = None
        if own_scans:
            self._readings = self._placed_scans(adopted, placed.count)
        else:
            self._readings = self._placed_readings(adopted, adopted.dtype if limits is None else limits)
        chunk = pipeline.most_particles(self._readings.readings, inside, per_beam=per_beam)
        owners = (poses, ranges, adopted, array)
        super().__init__(backend, pipeline.map, lock, placed, owners, array, self._space, chunk)

    @property
    def recording(self) -> Recording:
        """The recording for the present map."""
        return self._current().recording

    @property
    def program(self) -> Program:
        """All launches of a call, for a program of its owner."""
        self._current()
        return self._program()

    def exchange(self, inputs: Packed) -> tuple[Recording, Exchange]:
        """Return the recording for the present map, and its exchange of the inputs and of results for ``terms``."""
        recording, backend = self._current().recording, self._pipeline.backend
        if self._exchange is None or self._exchange[0] is not self._parts:
            count = self._poses.count * self._readings.readings
            exchange = backend.exchange(inputs.buffer, inputs.size, self._parts, count, self._pipeline.real)
            self._exchange = self._parts, exchange
        return recording, self._exchange[1]

    def columns(self, ranges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices of evaluated readings, and of max readings with a constant term, for ``terms``."""
        scans = self._pipeline.classed(ranges[None])
        return scans.columns, scans.left_out.constant_max

    def terms(self, results: np.ndarray, columns: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Return the (N, K) terms of the readings of a scan from the results of an exchange."""
        return terms_of(self._pipeline, results.reshape(self._poses.count, -1), *columns)

    def _placed_readings(self, adopted: Adopted, limits: np.dtype) -> Readings:
        """Return the readings as the kernel ``place_inputs`` places them."""
        pipeline, space = self._pipeline, self._space
        sensing = pipeline.sensing()
        placing, filled = device_readings(sensing, adopted.buffer, adopted.dtype, limits, space)
        places, constant_term = sensing.places, filled.pop("constant_term")
        counts = space.upload("counts", np.array([sensing.numbers(places)], _INT))
        return Readings(
            1, places, places, frozenset({"ALL_READINGS"}), pipeline.place_arguments(filled),
            dict(counts=counts, constant_terms=constant_term), 0.0, constants_there=sensing.constants_there,
            placing=placing,
        )  # fmt: skip

    def _placed_scans(self, adopted: Adopted, count: int) -> Readings:
        """Return a scan of each pose as the kernel ``place_scans`` places them."""
        pipeline, space = self._pipeline, self._space
        sensing, resolution = pipeline.sensing(), pipeline.map.grid.resolution
        placing, filled = device_scans(sensing, adopted.buffer, adopted.dtype, count, resolution, space)
        self._first, places = (placing,), len(sensing.columns)
        starts = space.upload("start", np.arange(count + 1, dtype=_INT) * _INT.type(places))
        counts = space.upload("counts", np.full(count, sensing.numbers(places), _INT))
        constants = space.upload("constants", np.full(count, pipeline.context.constant_term, pipeline.real))
        return Readings(
            count, places, places, frozenset({"ALL_READINGS", "SCANS"}),
            pipeline.place_arguments(filled) | {"start": starts}, dict(counts=counts, constant_terms=constants), 0.0,
        )  # fmt: skip

    def _piece_of(self, begin: int, end: int) -> Readings:
        """Return the readings of some poses."""
        readings, part = self._readings, self._pipeline.backend.part
        if readings.scans == 1 or (begin, end) == (0, readings.scans):
            return readings
        arguments = readings.arguments | {"start": part(readings.arguments["start"], begin, end - begin + 1, _INT)}
        if self._pipeline.end_points:
            blocks = -(-readings.readings // BLOCK_TERMS)
            guard = part(arguments["guard"], begin * blocks, (end - begin) * blocks, self._pipeline.real)
            arguments["guard"] = guard
        return readings._replace(scans=end - begin, arguments=arguments)

    def _program(self) -> Program:
        return self._first + super()._program()

    def _piece(self, begin: int, end: int) -> Program:
        pipeline, readings = self._pipeline, self._piece_of(begin, end)
        # Readings stay where the first piece has placed them.
        readings = readings if begin == 0 else readings._replace(placing=None)
        placed, state = pipeline.place(self._poses, (begin, end), self._space)
        log_p = pipeline.backend.part(self._log_p, begin, end - begin, pipeline.real)
        scoring = pipeline.scoring(
            readings, placed, state.table, log_p, self._space, per_beam=self._per_beam, ordered=False
        )
        self._parts = pipeline.parts(scoring).buffer
        return pipeline.program(scoring)
