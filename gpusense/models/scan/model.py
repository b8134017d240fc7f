"""The public interface that all scan models share."""

from __future__ import annotations

import dataclasses
import functools
import math
import threading
from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast, overload

import numpy as np

from gpusense._util import checks
from gpusense._util.html import card, split_options
from gpusense._util.typing import AnyArray, Compat, Precision
from gpusense.backends import Selection, get_backend
from gpusense.backends.workspace import ProgramCache, Workspace
from gpusense.interface.plan import Plan, SceneNotes
from gpusense.models.arguments import Pickled, check_scene, map_words, real_dtype
from gpusense.models.chunking import finish
from gpusense.models.poses import Poses
from gpusense.models.scan.classed import Beams, BeamSelection, ModelContext, check_beams
from gpusense.models.scan.field_gradient import Differentiable, is_recorded, log_likelihood_of
from gpusense.models.scan.pipeline import Request, ScanPipeline, make_request
from gpusense.models.scan.savings import plan_of_call
from gpusense.models.scan.scoring import LastCall, ResidentPoses, run
from gpusense.peers.weights import Peer, choose
from gpusense.tables.worlds import Worlds
from gpusense.world.frames import ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

if TYPE_CHECKING:
    from gpusense.models.scan.bound import BoundCall, RecordedCall
    from gpusense.models.scan.packed_call import PackedCallCache

# Most arrays of poses in place that are kept.
_MOST_RESIDENT = 16


class ScanModel(Pickled):
    """Base of the models of whole scans: the beam model and the likelihood field."""

    _takes_worlds: ClassVar[bool] = False  # whether kernels obey the flags WORLDS and SHAPES
    _stages: ScanPipeline  # of a single map

    def __init__(
        self,
        grid: OccupancyGrid | Worlds,
        scanner: Scanner,
        *,
        backend: Selection,
        precision: Precision,
        unknown: str | None,
        outside: str | None,
        temperature: float,
        beams: Beams,
        compat: Compat | Peer | None,
        cubes: bool,
        specialize: bool,
        z_max: float,
        max_depends: bool,
        constant_term: float,
        possible: bool,
    ) -> None:
        checks.instance("scanner", scanner, Scanner)
        if not self._takes_worlds:
            checks.instance("grid", grid, OccupancyGrid)
        check_scene(grid, scanner.range_max)
        # The worlds; None in a single map.
        self._worlds = grid if isinstance(grid, Worlds) else None
        self.scanner = scanner
        weights = choose(compat)
        self.compat = compat
        self.unknown = checks.choice("unknown", "free" if unknown is None else unknown, ("free", "occupied"))
        self.outside = checks.choice("outside", "free" if outside is None else outside, ("free", "occupied"))
        self.temperature = checks.real("temperature", temperature, above=0, high=1)
        self.beams = check_beams(beams, scanner.count)
        checks.boolean("specialize", specialize)
        self._selection = backend
        self._backend = device = get_backend(backend)
        self._real = real_dtype(precision, device)
        rules = BeamSelection(
            scanner, ray_vectors(scanner.bearings, scanner.mount), 0.0 if weights.is_peer else z_max, self.beams,
            specialize, max_is_range=weights.is_peer, max_depends=max_depends,
            map_size=math.hypot(grid.width, grid.height),
        )  # fmt: skip
        self._context = ModelContext(
            device, self._real, rules, weights, cubes, self.temperature, constant_term,
            possible or cubes,
        )  # fmt: skip
        self._workspace = Workspace(device)
        # Threads may share a model: its buffers serve one call at a time.
        self._lock = threading.Lock()
        self._last_call = LastCall()
        self._resident = ProgramCache[ResidentPoses](_MOST_RESIDENT)

    @functools.cached_property
    def _short(self) -> PackedCallCache | None:
        """Calls of few particles that repeat a size; None if the model has none."""
        if not self.backend.replays or self._worlds is not None:
            return None
        from gpusense.models.scan.packed_call import PackedCallCache

        return PackedCallCache.of(self._pipeline)

    @property
    def _last(self) -> LastCall:
        """The last call; a short one is repeated as one of any size, since only those report what they leave out."""
        operands = None if self._short is None else self._short.last
        if operands is not None:
            request = make_request(self._context, *operands())
            with self._lock, self._workspace:
                self._run(request)
                finish(self._workspace, request.poses.on_device)
        return self._last_call

    def _run(self, request: Request) -> None:
        """Start the launches of a request that is not short, while the model is locked."""
        if self._short is not None:
            self._short.last = None
        run(self._pipeline, request, self._workspace, self._last_call)

    def _repr_html_(self) -> str:
        words, *options = self._options()
        device = f"{self.device.selection} ({self.device.name}), {self.precision}"
        rows = [("map", words), *split_options(options), ("device", device)]
        return card(type(self).__name__, rows, detail=self.explain())

    def _arguments(self) -> dict[str, Any]:
        """See Pickled; subclasses add their own."""
        names = ("grid", "scanner", "precision", "unknown", "outside", "temperature", "beams", "compat")
        return {name: getattr(self, name) for name in names} | {"specialize": self._context.rules.specialize}

    def _options(self) -> tuple[str, ...]:
        count, used = self.scanner.count, self._context.rules.choice.most
        beams = f"beams={count}" if used == count else f"beams={used} of {count}"
        compat = () if self.compat is None else (f"compat={self.compat!r}",)
        return map_words(self.grid), beams, *self._kind_options(), *compat

    def _kind_options(self) -> tuple[str, ...]:
        """Return the options that only this kind of model has, as ``repr`` shows them."""
        return ()

    @property
    def _pipeline(self) -> ScanPipeline:
        """The stages of the model, which may change in worlds."""
        return self._stages

    @property
    def grid(self) -> OccupancyGrid:
        """The current map."""
        return self._pipeline.grid

    @property
    def used_beams(self) -> int:
        """Largest number of beams of a scan that the model evaluates."""
        return self._context.rules.choice.most

    @property
    def table_version(self) -> int:
        """Number of the map's table on the device, which changes with the map."""
        return self._pipeline.map.version

    @overload
    def log_likelihood(
        self,
        poses: AnyArray,
        ranges: AnyArray,
        *,
        world: Any = ...,
        ignore: Any = ...,
        per_beam: Literal[False] = ...,
        out: Any = ...,
    ) -> np.ndarray: ...

    @overload
    def log_likelihood(
        self,
        poses: AnyArray,
        ranges: AnyArray,
        *,
        world: Any = ...,
        ignore: Any = ...,
        per_beam: Literal[True],
        out: Any = ...,
    ) -> tuple[np.ndarray, np.ndarray]: ...

    @overload
    def log_likelihood(
        self, poses: AnyArray, ranges: AnyArray, *, world: Any = ..., ignore: Any = ..., per_beam: bool, out: Any = ...
    ) -> np.ndarray | tuple[np.ndarray, np.ndarray]: ...

    def log_likelihood(
        self,
        poses: AnyArray,
        ranges: AnyArray,
        *,
        world: Any = None,
        ignore: Any = None,
        per_beam: bool = False,
        out: Any = None,
    ) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        """Return log p(z | x, m) of a scan for each particle, natural logarithm.

        Arrays of other libraries (PyTorch, CuPy, JAX, Warp) are used without a copy, in host memory or, for
        ``warp:cuda`` backends, on the model's device; arrays of pyopencl, if the model's backend is their queue. The
        result is then an array of the same library in the same memory. For an interpolated likelihood field, poses may
        be a tensor of PyTorch that requires gradients, or be traced by ``jax.grad``, ``jax.jit`` or ``jax.vmap``: the
        result is then differentiable with respect to them, once, by the analytic gradient.

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad], or (S, N, 3) for S scans. On a device:
                float32 or float64 and C-contiguous.
            ranges: (K,) readings [m], or (S, K). NaN, -inf and readings below range_min are missing, +inf and readings
                of range_max or more are max readings. Of a model of :class:`Worlds` also (N, K), a scan of each robot.
            world: (N,) indices of the poses' worlds, or one for all, of a model of worlds; see ``RayCaster.cast``.
            ignore: (N,) indices of the shapes that poses do not see, or one for all; -1 for none.
            per_beam: Also return the term of each reading, before the temperature; NumPy arrays.
            out: The array for the log-likelihoods, also returned: of their shape and precision, C-contiguous, in the
                memory of the poses. After an error its contents are undefined.

        Returns:
            (N,) log-likelihoods, or (S, N), in the model's precision: a density in 1/m for each hit, a probability for
            each max reading. ``per_beam`` adds (N, K) or (S, N, K) parts; left-out readings have 0. With ``compat`` the
            logarithm of a particle's weight, and the cubes or logarithms that it sums.

        Warns:
            PlausibilityWarning: In the first calls of a scanner, negative readings, or readings in millimetres.
        """
        if per_beam is not False:
            checks.boolean("per_beam", per_beam)
        if out is None and not per_beam and type(poses) is not np.ndarray and is_recorded(poses):
            calls = self._differentiable(ranges)
            if calls is not None:
                return cast(np.ndarray, log_likelihood_of(poses, ranges, calls))
        short = self._short
        if short is not None:
            with self._lock:
                result = None if per_beam else short.score(poses, ranges, out)
                if result is not None:
                    return result
                short.last = None
        request = make_request(
            self._context, poses, ranges, out, per_beam=per_beam, worlds=self._worlds, world=world, ignore=ignore
        )
        with self._lock, self._workspace:
            run(self._stages if self._worlds is None else self._pipeline, request, self._workspace, self._last_call)
            finish(self._workspace, request.poses.on_device)
        log_p = request.result.user_array()
        return (log_p, request.result_parts()) if per_beam else log_p

    def start_scoring(
        self, poses: Any, ranges: AnyArray, *, out: Any, before: Callable[[], None] | None = None
    ) -> None:
        """Start scoring (N, 3) device poses by (K,) readings; ``finish_scoring``, or another wait, ends it.

        ``before``: called before poses are read, to start the launches that write them.
        """
        key = id(poses), id(out)
        with self._lock, self._workspace:
            resident = self._resident.get(key)
            if resident is not None and resident.start(ranges, before):
                return
        request = make_request(self._context, poses, ranges, out, before=before)
        with self._lock, self._workspace:
            self._run(request)
            if ResidentPoses.holds(self._pipeline, request):
                made = ResidentPoses(self._pipeline, request, self._workspace, self._last_call)
                self._resident.keep(key, made)

    def finish_scoring(self) -> None:
        """Wait for calls that ``start_scoring`` has begun."""
        with self._lock:
            finish(self._workspace, on_device=True)

    def bind_terms(self, poses: Any, ranges: Any, out: Any) -> RecordedCall | None:
        """Bind (N, 3) poses and (K,) float64 readings on the device to a call for ``RecordedCall.terms``.

        A model whose readings the host must prepare returns None.
        """
        from gpusense.models.scan.binding import bind_terms

        return bind_terms(self._pipeline, self._lock, poses, ranges, out)

    def _differentiable(self, ranges: AnyArray) -> Differentiable | None:
        """Return the calls that differentiate log-likelihoods; None for a model without a gradient."""
        return None

    def bind(self, poses: Any, ranges: Any, *, world: Any = None, ignore: Any = None, out: Any = None) -> BoundCall:
        """Bind arrays that stay in place to a call of ``log_likelihood``, for filters that repeat it.

        Each call reads the present contents of the arrays, and writes ``out``. Where poses and ranges are on the
        model's GPU, a call starts a CUDA graph, or three launches of OpenCL whose arguments stay set: it checks
        nothing, allocates nothing, copies nothing and does not wait. ``check`` waits, and reports poses that were not
        finite. NumPy arrays of few particles go to a GPU and back with one copy each way; elsewhere the bound call is
        the ordinary one, so that the same program runs on every backend.

        Results have the bits of ``log_likelihood`` with the same poses on the device. Four cases agree only to
        rounding: scans in which bearings repeat, scans of a temperature below 1 in which no range depends on the pose,
        ``beams=`` as a number with ``specialize=False``, and (N, K) scans of worlds with missing or max readings.

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad], an array as ``log_likelihood`` takes it.
            ranges: (K,) readings [m]; on the device float32 or float64 and C-contiguous. Of a model of worlds also
                (N, K), a scan of each robot.
            world: As in ``log_likelihood``; an array on the device is read anew by every call.
            ignore: The same.
            out: (N,) array for the log-likelihoods, as ``log_likelihood`` takes it.
        """
        # Imported on use, since few programs bind calls.
        from gpusense.models.scan.binding import bind, bind_worlds

        score = self.log_likelihood
        if self._worlds is not None:
            indices = dict(world=world, ignore=ignore)
            return bind_worlds(self._pipeline, self._lock, score, self._worlds, poses, ranges, out, **indices)
        for name, value in (("world", world), ("ignore", ignore)):
            if value is not None:
                raise ValueError(f"{name}: must be None for a model of a single map, got {checks.show(value)}")
        return bind(self._pipeline, self._lock, score, poses, ranges, out)

    def explain(self, *, measure: bool = False) -> str:
        """Report the parts that this scene leaves out, keeps, and could leave out, each with the reason.

        Readings and map come from the last call.

        Args:
            measure: Whether to time the scene with and without each part that flags of the kernel bring back. The line
                of an omitted part then ends with its saving in a call with the last scan and 2000 particles spread over
                the map, ``measured +0.012 ms``, or with ``not timed``. A difference below a few percent of the call is
                noise.

        Returns:
            A title, the flags of the code, a line ``- part  reason; saves ...`` for each part that is left out, and
            lines of the sections ``kept:`` (``+ part  reason``) and ``could go:`` (``? part  reason``).
        """
        return str(self.plan(measure=measure))

    def plan(self, *, measure: bool = False) -> Plan:
        """Return the report of :meth:`explain` as data.

        Returns:
            The title, the flags of the code, and the parts that are left out, kept, and could go.
        """
        notes, last = self._notes(), self._last
        plan = plan_of_call(notes, self._context, last)
        if not checks.boolean("measure", measure):
            return plan
        from gpusense.models.scan.savings import measured_savings

        with self._lock:
            requests = functools.partial(make_request, self._context)
            savings = measured_savings(requests, self._pipeline, last, plan, self.scanner.count)
        return dataclasses.replace(plan, measured=savings)

    def sources(self) -> dict[str, str]:
        """Return the text of the kernels that score a scan, as compiled for the last call.

        Returns:
            OpenCL C, Warp's Python or NumPy's by the names of the kernels; empty before the first call.
        """
        from gpusense.models.scan.savings import sources_of

        return sources_of(self._context.backend, self._last)

    @abstractmethod
    def _notes(self) -> SceneNotes:
        """Return the report's title, and the parts that are left out, kept, and removable."""

    def prepare(self, poses: AnyArray) -> None:
        """Make the map's table for a cloud of (N, 3) poses now, instead of in the first ``log_likelihood``."""
        checked = Poses(poses, self._context.backend)
        if checked.count:
            with self._lock:
                checked.ensure_table(self._pipeline.map, (0, checked.count), self._context.backend)

    def _weights_note(self) -> str:
        return "" if self.compat is None else f" with the weights of {self._context.weights.name} (no likelihood)"
