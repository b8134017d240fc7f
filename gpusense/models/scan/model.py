"""What the range models share: arguments, readings, poses, batching and the report of what is left out."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Literal, overload

import numpy as np

from gpusense._util import checks
from gpusense.backends import BackendInfo, Selection, get_backend
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.plan import Omission, Plan, share
from gpusense.interface.terms import log_weight
from gpusense.models.arguments import check_scene, real_dtype
from gpusense.models.chunks import chunk_of, in_chunks
from gpusense.models.cloud import Cloud, finish
from gpusense.models.scan.batch import part_of, prepare_batch, runs
from gpusense.models.scan.binding import bind
from gpusense.models.scan.bound import BoundCall, Scene, Scorer
from gpusense.models.scan.call import TOGETHER, ScanCall, call_of
from gpusense.models.scan.readings import Batch, Beams, PreparedScan, check_beams, prepare_scan
from gpusense.reference.error_free import BLOCK_TERMS
from gpusense.world import compat as compat_module
from gpusense.world.frames import ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner
from gpusense.world.windows import Region


class ScanModel(ABC):
    """A measurement model of whole scans; the base of the beam model and the likelihood field."""

    def __init__(
        self,
        grid: OccupancyGrid,
        scanner: Scanner,
        *,
        backend: Selection,
        precision: str,
        unknown: str | None,
        outside: str | None,
        temperature: float,
        beams: Beams,
        compat: str | None,
        specialize: bool,
        z_max: float,
        end_points: bool,
    ) -> None:
        if not isinstance(scanner, Scanner):
            raise TypeError(f"scanner: must be a Scanner, got {checks.show(scanner)}")
        self.grid = check_scene(grid, scanner.range_max)
        self.scanner = scanner
        self._peer = compat_module.choose(compat)
        # What the sum over beams begins with, and whether readings are end points.
        self._lead, self._end_points = 0.0, end_points
        # Rays of each beam, and whether the probability of a max reading depends on the pose.
        self._rays_each, self._max_depends = 1, False
        # Numbers that GPUs keep for each reading until they are summed.
        self._kept_parts = 1 / BLOCK_TERMS if end_points else 1.0
        self.compat = compat
        self.unknown = checks.choice("unknown", "free" if unknown is None else unknown, ("free", "occupied"))
        self.outside = checks.choice("outside", "free" if outside is None else outside, ("free", "occupied"))
        self.temperature = checks.real("temperature", temperature, above=0, high=1)
        self.beams = check_beams(beams, scanner.count)
        if not isinstance(specialize, bool):
            raise TypeError(f"specialize: must be True or False, got {checks.show(specialize)}")
        self._specialize = specialize
        self._backend = get_backend(backend)
        self._real = real_dtype(precision, self._backend)
        self._workspace = Workspace(self._backend)
        # Threads may share a model: its buffers serve one call at a time.
        self._lock = threading.Lock()
        self._vectors = ray_vectors(scanner.bearings, scanner.mount)
        self._distinct = len(np.unique(self._vectors, axis=0)) == len(self._vectors)
        self._z_max = z_max if self._peer is None else 0.0
        self._last_scan: PreparedScan | None = None
        self._last_code: frozenset[str] = frozenset()
        # Scans that shared launches in the last call.
        self._together = 0

    @property
    def device(self) -> BackendInfo:
        """The device the model is compiled for."""
        return self._backend.info

    @property
    def precision(self) -> str:
        """``"float32"`` or ``"float64"``."""
        return self._real.name

    @overload
    def log_likelihood(
        self, poses: object, ranges: object, *, per_beam: Literal[False] = ..., out: Any = ...
    ) -> np.ndarray: ...

    @overload
    def log_likelihood(
        self, poses: object, ranges: object, *, per_beam: Literal[True], out: Any = ...
    ) -> tuple[np.ndarray, np.ndarray]: ...

    @overload
    def log_likelihood(
        self, poses: object, ranges: object, *, per_beam: bool, out: Any = ...
    ) -> np.ndarray | tuple[np.ndarray, np.ndarray]: ...

    def log_likelihood(
        self, poses: object, ranges: object, *, per_beam: bool = False, out: Any = None
    ) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        """log p(z | x, m) of a scan for each particle, natural logarithm.

        Arrays of other libraries (PyTorch, CuPy, JAX, Warp) are used without a copy where they are: in host memory, or,
        for ``warp:cuda`` backends, on the model's device; those of pyopencl where the model's backend is their queue.
        The result is then an array of the same library there.

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad], or (S, N, 3) for S scans. On a device:
                float32 or float64 and C-contiguous.
            ranges: (K,) readings [m], or (S, K). NaN, -inf and readings below range_min are missing, +inf and readings
                of range_max or more are max readings.
            per_beam: Also return what each reading contributes, before the temperature; NumPy arrays.
            out: Where to write the log-likelihoods: an array of their shape and precision in the memory where the poses
                are, C-contiguous; it is what is returned.

        Returns:
            (N,) log-likelihoods, or (S, N), in the model's precision: a density in 1/m for each hit, a probability for
            each max reading. With ``per_beam`` also (N, K) or (S, N, K) parts; left-out readings have 0. With
            ``compat`` the logarithm of a particle's weight, and the cubes that it sums.

        Raises:
            TypeError: an argument does not hold real numbers, or is on a device that the backend cannot read.
            ValueError: a wrong shape, or a pose that is not finite; the message names it.
            MemoryError: the device cannot hold the map's table, or even a few particles.
        """
        call = self._call(poses, ranges, out, per_beam=per_beam)
        with self._lock, self._workspace:
            self._start(call)
            finish(self._workspace, call.on_device)
        log_p = call.log_p(self._backend)
        return (log_p, call.parts.reshape(*call.shape, call.parts.shape[-1])) if per_beam else log_p

    def _call(
        self,
        poses: object,
        ranges: object,
        out: object,
        *,
        per_beam: bool = False,
        known: dict[object, list[Cloud]] | None = None,
    ) -> ScanCall:
        """A call's arguments, checked."""
        rays = max(self.scanner.count * self._rays_each, 1)
        most = TOGETHER[self._backend.info.kind] // rays
        if self._peer is None and self._impossible():
            most = 0
        return call_of(
            poses, ranges, out, scanner=self.scanner, backend=self._backend, real=self._real, per_beam=per_beam,
            most=min(most, self._chunk(rays)), known=known,
        )  # fmt: skip

    def _start(self, call: ScanCall) -> None:
        """Start all that a call needs; parts are complete on return."""
        self._together = 0
        if call.together:
            try:
                self._score_together(call)
                return
            except MemoryError:
                # Fewer at a time may fit.
                self._workspace.release(keep="verdict")
                call.separate(self._backend)
        for i, cloud in enumerate(call.clouds):
            with call.target(self._workspace, i * call.count, (i + 1) * call.count) as target:
                self._score_scan(cloud, call.ranges[i], target, call.parts[i], call.parts.shape[-1] > 0)
            if not call.single:
                self._workspace.start()

    def bind(self, poses: Any, ranges: Any, *, out: Any = None) -> BoundCall:
        """A call of ``log_likelihood`` with arrays that stay where they are, for filters that repeat it.

        Every call reads what the arrays hold then, and writes ``out``. Where poses and ranges are on the model's GPU, a
        call is one start of a CUDA graph, or three launches of OpenCL whose arguments stay set: it checks nothing,
        allocates nothing, copies nothing and does not wait; ``check`` waits, and says whether a pose was not finite.
        NumPy arrays of few particles go to a GPU and back with one copy each way; everywhere else it is the ordinary
        call, so that the same program runs on every backend.

        Results have the bits of ``log_likelihood`` with the same poses on the device, but for scans in which bearings
        repeat or, with a temperature below 1, no range depends on the pose, and for some of the beams by number with
        ``specialize=False``: these agree to rounding.

        Args:
            poses: (N, 3) robot poses (x, y, theta) in the world [m, m, rad], an array as ``log_likelihood`` takes it.
            ranges: (K,) readings [m]; on the device float32 or float64 and C-contiguous.
            out: (N,) where to write the log-likelihoods, as ``log_likelihood`` takes it.

        Raises:
            TypeError: not an array, one of numbers that cannot change, or on a device that the backend cannot read.
            ValueError: a wrong shape.
            MemoryError: the device cannot hold the map's table, or what a call needs.
        """
        return bind(self, poses, ranges, out)

    @abstractmethod
    def explain(self) -> str:
        """What this scene does not need, why, and what leaving it out saves; readings and map as of the last call."""

    def _score_scan(self, cloud: Cloud, ranges: np.ndarray, log_p: Any, parts: np.ndarray, per_beam: bool) -> None:
        """Start to write log-likelihoods into a host array or a buffer; parts are complete on return."""
        scan = self._prepared(ranges)
        self._last_scan = scan
        if per_beam and len(scan.max_columns):
            parts[:, scan.max_columns] = log_weight(self._z_max)
        if len(scan.readings) == 0:
            self._fill(log_p, cloud.count, self._without_readings(scan.constant))
            self._look_at(cloud, (0, cloud.count))
            return
        hits = scan.columns[np.isfinite(scan.readings)] if self._peer is None and self._impossible() else ()
        if len(hits):
            self._fill(log_p, cloud.count, -np.inf)
            self._look_at(cloud, (0, cloud.count))
            if per_beam:
                parts[:, scan.columns[np.isinf(scan.readings)]] = log_weight(self._z_max)
                parts[:, hits] = -np.inf
            return
        launch = self._prepare_launch(scan)
        space, backend = self._workspace, self._backend

        def run(begin: int, end: int) -> None:
            with space.result("log_p", log_p, begin, end - begin, self._real) as result:
                each = launch(cloud, (begin, end), result, per_beam)
            if per_beam:
                shape = (end - begin, len(scan.readings))
                parts[begin:end, scan.columns] = backend.download(each, np.empty(shape, self._real))

        in_chunks(cloud.count, self._chunk(len(scan.readings) * self._rays_each, per_beam), space, run)

    def _score_together(self, call: ScanCall) -> None:
        """Start to score several scans by common launches, each of as many scans as may be."""
        (cloud,), space, count = call.clouds, self._workspace, call.count
        scans = self._prepared(call.ranges)
        self._last_scan = self._prepared(call.ranges[-1])
        assert scans.batch is not None
        most = max(self._chunk(max(scans.most_readings, 1) * self._rays_each) // count, 1)
        for begin, end in runs(scans, most):
            part = (begin * count, end * count)
            with call.target(space, *part) as target:
                self._score_part(scans, (begin, end), cloud, part, target)
            space.start()

    def _score_part(
        self, scans: PreparedScan, some: tuple[int, int], cloud: Cloud, part: tuple[int, int], target: Any
    ) -> None:
        """Start to score some of several scans by common launches."""
        assert scans.batch is not None
        if scans.batch.counts[some[0]] == 0:
            constant = float(scans.batch.constants[some[0]])
            self._fill(target, part[1] - part[0], self._without_readings(constant))
            self._look_at(cloud, part)
            return
        space = self._workspace
        launch = self._prepare_launch(part_of(scans, *some))
        with space.result("log_p", target, 0, part[1] - part[0], self._real) as result:
            launch(cloud, part, result, False)
        self._together = max(self._together, some[1] - some[0])

    def _prepared(self, ranges: np.ndarray) -> PreparedScan:
        """Readings of one scan (K,), or of several (S, K), classed, chosen and grouped."""
        prepare = prepare_scan if ranges.ndim == 1 else prepare_batch
        if self._peer is not None:
            ranges = self._peer.readings(ranges, self.scanner, self._end_points)
        return prepare(
            ranges, self.scanner, self._vectors, self._z_max, self.beams, self._specialize,
            max_is_range=self._peer is not None, max_depends=self._max_depends, distinct=self._distinct,
        )  # fmt: skip

    def _chunk(self, rays: int, per_beam: bool = False) -> int:
        """Particles of one launch of so many rays each."""
        kept = 1.0 if per_beam else self._kept_parts if self._backend.info.kind == "gpu" else 0.0
        return chunk_of(self._backend, rays, self._real.itemsize * kept)

    def _without_readings(self, constant: float) -> float:
        """The result of a scan none of whose readings depends on the pose."""
        with np.errstate(divide="ignore"):
            return float(self.temperature * (constant if self._peer is None else np.log(self._lead)))

    def _fixed_of(self, batch: Batch) -> np.ndarray:
        """What the sum of each scan begins with."""
        return (batch.constants + self._lead).astype(self._real)

    def _look_at(self, cloud: Cloud, part: tuple[int, int]) -> None:
        """Place poses on the device for nothing but to learn whether they are finite."""
        if cloud.on_device and cloud.count:
            frame = (Region(0, 0, *self.grid.shape), self.grid, self.scanner.mount)
            given = cloud.given(self._backend, self._workspace, part)
            cloud.place(self._backend, self._workspace, given, part, frame, self._real, careful=False)

    def _fill(self, log_p: Any, count: int, value: float) -> None:
        if isinstance(log_p, np.ndarray):
            log_p[:] = value
        else:
            self._backend.upload(np.full(count, value, self._real), log_p)

    @abstractmethod
    def _impossible(self) -> bool:
        """Whether no range reading is possible at all."""

    @abstractmethod
    def _prepare_launch(self, scan: PreparedScan) -> Callable[[Cloud, tuple[int, int], Buffer, bool], Buffer]:
        """What starts to score poses begin to end - 1 of a cloud into a buffer, and returns that of (n, M) parts."""

    @abstractmethod
    def _bound_scene(self) -> Scene:
        """What bound calls are made of."""

    @abstractmethod
    def _bound_parts(self, count: int, places: int) -> tuple[int, int]:
        """PlacedScan.parts and .block of launches for so many particles and readings."""

    @abstractmethod
    def _bound_scorer(self, table: Buffer, region: Region) -> Scorer:
        """What starts to find what readings that are on the device add, with the table of the whole map."""

    def _bound_chunk(self, readings: int) -> int:
        """Particles of one launch of a bound call."""
        kept = self._real.itemsize * self._kept_parts
        return chunk_of(self._backend, max(readings, 1) * self._rays_each, kept)

    def _peer_note(self) -> str:
        return "" if self._peer is None else f" with the weights of {self.compat} (no likelihood)"

    def _scene_flags(self) -> set[str]:
        flags = {"FLOAT64"} if self._real == np.float64 else set()
        if not self._specialize:
            flags |= {"ALL_READINGS"}
        return flags

    def _plan(self, title: str, omissions: list[Omission]) -> Plan:
        """The plan as of the last call."""
        if not self._specialize:
            return Plan(f"{title}, specialize=False", self._last_code, ())
        if self._together > 1:
            saved = f"{self._together - 1} of {self._together} sets of launches"
            omissions.append(Omission("launches of single scans", f"{self._together} scans are scored together", saved))
        scan = self._last_scan
        if scan is not None:
            count, constant = self.scanner.count, len(scan.max_columns)
            for left, what, why in (
                (scan.missing, "missing readings", "say nothing"),
                (scan.ignored_max, "max readings", "say nothing while z_max = 0"),
                (constant, "max readings", "have probability z_max at every pose"),
                (scan.thinned, "thinned beams", "are not among those that beams= chose"),
            ):
                if left:
                    why = f"{left} of {count} readings {why}"
                    omissions.append(Omission(what, why, f"{share(left, count)} of the beams"))
        return Plan(title, self._last_code, tuple(omissions))
