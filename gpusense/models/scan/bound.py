"""Calls whose arrays stay where they are: bound once, repeated with one start and nothing looked at again.

What a call of few particles takes beside its kernels is what the host does: checks, the scan's preparation, a start for
each launch. Where poses and readings are on the device, all of that is done once: readings are classed and placed there
by the kernel file ``scan``, and the launches are kept with their arguments (``Recording.record``), with CUDA as a
graph.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from gpusense.backends import arrays
from gpusense.backends.base import Buffer, Gathering, Recording, Replay, Sharing
from gpusense.backends.workspace import Workspace
from gpusense.models.cloud import Cloud, Placed, Readings, finish
from gpusense.reference.error_free import BLOCK_TERMS
from gpusense.reference.scan import MAX_FIXED, MAX_LEFT_OUT, MAX_PLACED
from gpusense.world.windows import Region

if TYPE_CHECKING:
    from gpusense.models.scan.model import ScanModel
    from gpusense.tables.reachable import ReachableMap

_INT = np.dtype(np.int32)
# Readings are placed by whole groups of so many work-items, so that those of poses begin with a group.
_GROUP = 64


class BoundCall(ABC):
    """A call of ``log_likelihood`` with arrays that stay in their place; ``bind`` of a model makes it.

    Attributes:
        out: (N,) log-likelihoods, in the memory and of the library of the poses; every call writes them.
        waits: Whether a call has ended when it returns.
    """

    out: Any
    waits: bool

    @abstractmethod
    def __call__(self, stream: Any = None) -> Any:
        """Score what the arrays hold now.

        Args:
            stream: A stream of the GPU on which to work: of PyTorch, CuPy or Warp, or its address; with OpenCL a queue
                of the model's context. None for Warp's current stream of the device, and the model's queue. Only for
                calls that do not wait.

        Returns:
            ``out``; where ``waits`` is False, the device may yet be about to write it.

        Raises:
            TypeError: a stream that is none, or for a call that waits.
            TypeError, ValueError: of a call that waits, what ``log_likelihood`` says of the arrays.
        """

    @abstractmethod
    def check(self) -> None:
        """Wait until all calls have ended.

        Raises:
            ValueError: a pose was not finite in some call since the last check; a call that waits says so itself.
        """


@dataclass(frozen=True)
class Scene:
    """What bound calls of a model are made of.

    Attributes:
        map: The map's table.
        vectors: (K, rays, 2) float64 cosines and sines of the rays of each beam.
        top: Largest range below a max reading.
        guard_scale: Bound of end points' rounding errors per cell of range.
        careful: Whether poses are needed in two parts.
    """

    map: ReachableMap
    vectors: np.ndarray
    top: float = math.inf
    guard_scale: float = 0.0
    careful: bool = False


@dataclass(frozen=True)
class PlacedScan:
    """Readings on the device, as the kernel ``place_inputs`` leaves them.

    Attributes:
        places: Places of readings; those at the end may be missing (nan).
        parts: How many numbers a particle's sum adds.
        block: 1 where these are sums of readings, BLOCK_TERMS where they are single readings'.
        point: End points in cells, or the vectors of beams.
        low: What rounding took from end points.
        reading: Ranges, where points are vectors.
        guard: Bounds for each block of end points.
        fixed: What max readings without a place add.
    """

    places: int
    parts: int
    block: int
    point: Buffer
    low: Buffer
    reading: Buffer
    guard: Buffer
    fixed: Buffer


# What starts to find what readings add: placed poses, the flags of their headings, their number, the scan, and parts.
Scorer = Callable[[Placed, frozenset[str], int, PlacedScan, Buffer], None]


class DeviceCall(BoundCall):
    """One start of launches that were recorded."""

    waits = False
    # Launches that were gathered once.
    _kept: object | None = None
    _replay: Replay | None = None
    # What they score by, and the map's window.
    _scored: tuple[Scorer, Region] | None = None

    def __init__(
        self,
        model: ScanModel,
        poses: Any,
        ranges: Any,
        out: Any,
        verdict: Buffer | None = None,
        limits: np.dtype | None = None,
    ) -> None:
        backend, real = model._backend, model._real
        self._model, self._backend, self._real = model, backend, real
        self._cloud = Cloud(poses, backend, in_place=True)
        count = self._cloud.count
        found = arrays.adopt_readings(ranges, backend, model.scanner.count, in_place=True)
        result = arrays.check_out(out, (count,), real, poses, backend)
        self._result = arrays.blank(backend, count, real) if result is None else result
        self.out = arrays.lent(poses, backend, self._result, (count,), real) if out is None else out
        # What owns the memory of what is read and written.
        self._given = (poses, ranges, found, self.out)
        # Buffers of its own: other calls of the model may come between.
        self._space = Workspace(backend)
        if verdict is not None:
            # Whoever has it looks at it.
            self._space.share("verdict", verdict, 2, _INT)
        self._none = backend.upload(np.zeros(1, _INT))
        self._scene = model._bound_scene()
        self._scan, self._readings, self._fixed = self._placing_of(
            found.buffer, found.dtype, found.dtype if limits is None else limits
        )
        # Pieces begin where the device can.
        whole = max(cast(Sharing, backend).alignment // _INT.itemsize, 1)
        self._chunk = -(-model._bound_chunk(self._scan.places) // whole) * whole
        self._counts = backend.upload(np.array([self._scan.parts], _INT))
        self._record()

    def __call__(self, stream: Any = None) -> Any:
        """See BoundCall.__call__."""
        self._known()(stream)
        return self.out

    def begin(self) -> None:
        """Start a call's launches, or gather them where this thread gathers what it starts."""
        replay = self._known()
        if not hasattr(self._backend, "gather"):
            replay()
            return
        gathering = cast(Gathering, self._backend)
        if self._kept is not None:
            gathering.repeat(self._kept)
            return
        mark = gathering.mark()
        assert self._scored is not None
        self._start(*self._scored)
        self._kept = gathering.kept(mark)

    def _known(self) -> Replay:
        """The launches for the map as it is."""
        cast(Any, self._backend).check_process()
        if self._replay is not None and self._scene.map.version == self._version:
            return self._replay
        # The map has changed, or its table is another one.
        if self._replay is not None:
            self._replay.wait()
        return self._record()

    def check(self) -> None:
        """See BoundCall.check."""
        cast(Any, self._backend).check_process()
        if self._replay is not None:
            self._replay.wait()
        finish(self._space, on_device=True)

    def _placing_of(self, ranges: Buffer, dtype: np.dtype, limits: np.dtype) -> tuple[PlacedScan, Readings, bool]:
        """Where readings are placed, what does that, and whether those without a place add something."""
        model, backend, real, space = self._model, self._backend, self._real, self._space
        z_max, scanner, end_points = model._z_max, model.scanner, model._end_points
        beams = np.arange(scanner.count)
        if model.beams is not None and not isinstance(model.beams, (int, np.integer)):
            beams = beams[np.asarray(model.beams, np.intp)]
        chosen = len(beams)
        if isinstance(model.beams, (int, np.integer)):
            chosen = min(int(model.beams), chosen)
        places = chosen if model._specialize else len(beams)
        with np.errstate(over="ignore"):
            nearest, farthest = limits.type(scanner.range_min), limits.type(scanner.range_max)
        if scanner.range_min > 0:
            # A reading of 0 is none, even where the limit is rounded to 0.
            nearest = max(nearest, np.finfo(limits).smallest_subnormal)
        kind = MAX_PLACED if model._max_depends or not model._specialize else MAX_FIXED
        kind = kind if z_max > 0 else MAX_LEFT_OUT
        possible = not model._impossible()
        vectors = self._scene.vectors[beams]
        each, blocks = vectors.shape[1], -(-places // BLOCK_TERMS)
        scan = PlacedScan(
            places,
            *model._bound_parts(min(self._cloud.count, model._bound_chunk(places)), places),
            point=space.empty("point", 2 * places * each, real),
            low=space.empty("point_low", 2 * places if end_points else 2, real),
            reading=space.empty("reading", 1 if end_points else places, real),
            guard=space.empty("guard", blocks if end_points else 1, real),
            fixed=space.empty("fixed", 1, real),
        )
        flags = model._scene_flags() & {"FLOAT64", "ALL_READINGS"}
        flags |= {"END_POINTS"} if end_points else set()
        flags |= {"RANGES_FLOAT32"} if dtype == np.float32 else set()
        flags |= set() if np.array_equal(beams, np.arange(scanner.count)) else {"SOME_BEAMS"}
        buffers = (
            ranges, backend.upload(beams.astype(_INT)), backend.upload(vectors), scan.point, scan.low, scan.reading,
            scan.guard, scan.fixed,
        )  # fmt: skip
        numbers = (
            len(beams), each, places, chosen, kind, int(possible), float(nearest), float(farthest),
            float(np.log(z_max)) if kind == MAX_FIXED else 0.0, self._scene.top, self._scene.guard_scale,
        )  # fmt: skip
        head = -(-max(len(beams), 1) // _GROUP) * _GROUP
        return scan, Readings(head, frozenset(flags), buffers, numbers), kind == MAX_FIXED or not possible

    def _record(self) -> Replay:
        """Make the table where there is none, and keep the launches of a call; nothing is started."""
        model, scene, cloud = self._model, self._scene, self._cloud
        with model._lock:
            # Kept, since another call of the model may need another table; the last one first makes room.
            self._table, self._scored, self._replay, self._kept = None, None, None, None
            self._table, region, _ = cloud.ensure(scene.map, 0, cloud.count)
            score = model._bound_scorer(self._table, region)
            self._version = scene.map.version
            self._scored = (score, region)
            replay = cast(Recording, self._backend).record(lambda: self._start(score, region))
        # Other streams may come first to what was made just now.
        self._backend.synchronize()
        self._replay = replay
        return replay

    def _start(self, score: Scorer, region: Region) -> None:
        """All launches of a call."""
        model, scan, backend, space, cloud = self._model, self._scan, self._backend, self._space, self._cloud
        flags = frozenset({"FLOAT64"} if self._real == np.float64 else ())
        # One of several scans has a fixed term on the device.
        flags |= {"SCANS"} if self._fixed else set()
        counts, chunk = self._counts, self._chunk
        frame = (region, model.grid, model.scanner.mount)
        readings: Readings | None = self._readings
        for begin in range(0, cloud.count, chunk):
            part = (begin, min(begin + chunk, cloud.count))
            count = part[1] - begin
            given = cloud.given(backend, space, part)
            placed = cloud.place(
                backend, space, given, part, frame, self._real, careful=self._scene.careful,
                readings=readings,
            )  # fmt: skip
            readings = None
            parts = space.empty("parts", count * scan.parts, self._real)
            if scan.places:
                score(placed, cloud.headings(), count, scan, parts)
            backend.compile("sum_parts", flags)(
                (count,), parts, self._none, counts, scan.fixed, backend.part(self._result, begin, count, self._real),
                count, scan.parts, scan.block, 1, count, 0.0, model.temperature, count,
            )  # fmt: skip
