"""Do the backends of this machine agree? Each against the float64 truth on its own rounded inputs, and pairwise.

:class:`Recorder` is a backend that keeps what every scoring launch was given and what it returned;
:func:`replay` evaluates the float64 reference kernels on just that. A likelihood is thus judged apart from the rounding
of its inputs, and apart from ray casting, which is judged by bits.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense.backends import Backend, devices, get_backend
from gpusense.backends.base import Launcher
from gpusense.grid import OccupancyGrid
from gpusense.models.beam import BeamModel
from gpusense.models.caster import RayCaster
from gpusense.models.field import LikelihoodFieldModel
from gpusense.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.prepare import distance_transform, empty_rectangles
from gpusense.reference import field as field_kernels
from gpusense.reference.beam import sum_terms
from gpusense.reference.mixture import log_density
from gpusense.reference.sensor_table import tabulated_density
from gpusense.scanner import Scanner
from gpusense.signatures import KERNELS
from gpusense.tolerances import TOLERANCES, Check, Tolerance, beam_tolerance, scan_tolerance
from gpusense.worlds import building, cloud_around, cloud_uniform, free_pose, simulate_scan

_MODELS: dict[str, tuple[Callable[..., BeamModel | LikelihoodFieldModel], object]] = {
    "beam model": (BeamModel, BeamParameters()),
    "field, nearest": (LikelihoodFieldModel, LikelihoodFieldParameters(z_hit=0.85, z_max=0.05)),
    "field, bilinear": (LikelihoodFieldModel, LikelihoodFieldParameters(interpolation="bilinear")),
}


@dataclass(frozen=True)
class Launch:
    """A scoring launch: its arguments by name, what it returned included.

    Attributes:
        kernel: ``"score_beams"`` or ``"score_field"``.
        flags: Flags of its code.
        values: Arrays cut to their shapes, without the map's rectangles, and scalars rounded as the device got them.
        expected: (particles, rays) expected ranges of the same device for a beam launch, else None.
    """

    kernel: str
    flags: frozenset[str]
    values: dict[str, Any]
    expected: np.ndarray | None

    @property
    def parts(self) -> np.ndarray:
        """(particles, readings) log-likelihoods of the beams, where the launch was asked for them."""
        return self.values["parts"].reshape(self.values["particles"], self.values["readings"])


class Recorder:
    """A backend that passes everything on to another one and records scoring launches.

    Give it to a model as ``backend=``. Ask for ``per_beam=True``, and for few particles: everything is copied.
    """

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self.launches: list[Launch] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def compile(self, kernel: str, flags: frozenset[str]) -> Launcher:
        """See Backend.compile."""
        launcher = self._backend.compile(kernel, flags)
        if kernel not in ("score_beams", "score_field"):
            return launcher

        def launch(size: tuple[int, ...], *arguments: Any) -> None:
            launcher(size, *arguments)
            self.launches.append(self._record(kernel, flags, arguments))

        return launch

    def _record(self, kernel: str, flags: frozenset[str], arguments: Sequence[Any]) -> Launch:
        real = np.dtype(np.float64 if "FLOAT64" in flags else np.float32)
        given = dict(zip(KERNELS[kernel].arguments, arguments, strict=True))
        values: dict[str, Any] = {}
        for argument, value in given.items():
            if argument.shape is None:
                dtype = argument.dtype(real)
                values[argument.name] = int(value) if dtype.kind == "i" else dtype.type(value)
        # Only where these flags are set does a kernel see the argument; rays are cast on the device.
        needed = {
            "parts": {"PER_BEAM"} & flags,
            "pose_low": {"CAREFUL"} & flags,
            "sensor": {"SENSOR_TABLE"} & flags,
            "normals": {"INCIDENCE"} & flags,
            "map_table": {},
            "start": {"SCANS"} & flags,
            "fixed_of": {"SCANS"} & flags,
        }
        for argument, value in given.items():
            if argument.shape is None or not needed.get(argument.name, True):
                continue
            count = argument.elements(values)
            array = self._backend.download(value, np.empty(count * argument.width, argument.dtype(real)))
            values[argument.name] = array.reshape(-1, argument.width) if argument.width > 1 else array
        expected = self._cast(flags, given, values, real) if kernel == "score_beams" else None
        return Launch(kernel, flags, values, expected)

    def _cast(self, flags: frozenset[str], given: dict[Any, Any], values: dict[str, Any], real: np.dtype) -> np.ndarray:
        """What the launch's rays hit, by the same device from the same buffers."""
        by_name = {argument.name: value for argument, value in given.items()}
        shape = values["particles"], values["rays"]
        buffer = self._backend.empty(shape[0] * shape[1], real)
        names = [argument.name for argument in KERNELS["cast_ranges"].arguments]
        arguments = [buffer if name == "ranges" else by_name[name] for name in names]
        self._backend.compile("cast_ranges", flags)(shape[::-1], *arguments)
        return self._backend.download(buffer, np.empty(shape, real))


def replay(launch: Launch, like: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The truth of a launch: the float64 reference on the launch's own rounded inputs and expected ranges.

    An end point that is nearer to a cell's edge than float32 can tell with twice its digits belongs to either cell: the
    one is taken whose log-likelihood is nearer to what was found.

    Args:
        launch: What was recorded.
        like: (particles, readings) what was found; the launch's own parts by default, if it has some.

    Returns:
        log p (particles,) and the beams' parts (particles, readings), both float64, in the order of the launch.
    """
    values = {
        name: value.astype(np.float64) if getattr(value, "dtype", np.dtype(int)).kind == "f" else value
        for name, value in launch.values.items()
    }
    with np.errstate(all="ignore"):
        parts = (_replay_beams if launch.kernel == "score_beams" else _replay_field)(launch, values)
        if like is None and "PER_BEAM" in launch.flags:
            like = launch.parts
        if launch.kernel == "score_field" and "BILINEAR" not in launch.flags and like is not None:
            # The bound of the plain arithmetic's error, 8 eps a cell, and once more eps with twice the digits.
            size = np.max(np.abs(values["point"]), initial=0.0, where=np.isfinite(values["point"]))
            guard = 8 * float(np.finfo(np.float32).eps) ** 2 * (size + 2)
            for shift in itertools.product((-guard, guard), repeat=2):
                moved = _replay_field(launch, values, shift)
                parts = np.where(np.abs(moved - like) < np.abs(parts - like), moved, parts)
        return sum_terms(launch.flags, parts, values["fixed"], values["temperature"]), parts


def _replay_beams(launch: Launch, values: dict[str, Any]) -> np.ndarray:
    assert launch.expected is not None
    ray_of = np.repeat(np.arange(values["rays"]), np.diff(values["first"]))
    expected = launch.expected.astype(np.float64)[:, ray_of]
    z = np.broadcast_to(values["reading"], expected.shape)
    if "SENSOR_TABLE" in launch.flags:
        # In the launch's own precision, or a range next to a bin's border would fall into another bin.
        bins = (launch.values[name] for name in ("sensor", "cells", "per_metre", "range_max"))
        own = np.broadcast_to(launch.values["reading"], expected.shape), launch.expected[:, ray_of]
        parts = tabulated_density(*own, *bins).astype(np.float64)
    else:
        parts = log_density(launch.flags, z, expected, values["terms"])
    if "ALL_READINGS" in launch.flags:
        atom = parts if "SENSOR_TABLE" in launch.flags else np.where(np.isinf(z), values["terms"][7], parts)
        parts = np.where(np.isnan(z), 0.0, atom)
    return parts


def _replay_field(launch: Launch, values: dict[str, Any], shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    count, readings = values["particles"], values["readings"]
    parts = np.empty(count * readings)
    low = values.get("pose_low", np.zeros((count, 4))) + np.array([*shift, 0.0, 0.0])
    alone = {"start": None, "fixed_of": None}
    given = {**values, **alone, "pose_low": low, "log_p": np.empty(count), "parts": parts}
    flags = launch.flags | {"FLOAT64", "PER_BEAM", "CAREFUL"}
    field_kernels.score_field(flags, *(given[argument.name] for argument in KERNELS["score_field"].arguments))
    return parts.reshape(count, readings)


@dataclass(frozen=True)
class Scene:
    """What is computed: a map, a scanner, a scan of it and poses."""

    grid: OccupancyGrid
    scanner: Scanner
    poses: np.ndarray
    ranges: np.ndarray


def scene_in(grid: OccupancyGrid, scanner: Scanner, seed: int = 0) -> Scene:
    """A simulated scan with missing and max readings; poses near by, all over, in walls, off the map and on corners."""
    random = np.random.default_rng(seed)
    pose = free_pose(grid, random, 0.2)
    ranges = simulate_scan(grid, scanner, pose, BeamParameters(), random)
    ranges[3::29], ranges[4::31], ranges[5::37] = np.nan, np.inf, -1.0
    low_x, low_y, high_x, high_y = grid.bounds()
    off = random.uniform((low_x - 3, low_y - 3, -4), (high_x + 3, high_y + 3, 4), (60, 3))
    corners = cloud_uniform(grid, 40, random)
    col, row = np.floor(grid.world_to_cells(corners[:, :2])).astype(np.int64).T
    corners[:, :2] = (grid.cell_centers(row, col) + grid.cell_centers(row - 1, col - 1)) / 2
    corners[:, 2] = np.arange(40) // 10 * (math.pi / 4)
    poses = [pose[None], cloud_around(pose, 100, 0.3, 0.2, random), cloud_uniform(grid, 100, random), off, corners]
    return Scene(grid, scanner, np.concatenate(poses), ranges)


def built_in_scene(seed: int = 0) -> Scene:
    """A building far from the origin whose corners, the scanner's mount and a resolution of 1/16 m are exact."""
    plain = building(seed, (24.0, 14.0), resolution=0.0625)
    grid = OccupancyGrid(plain.cells, plain.resolution, (3000.0, -5000.0, 0.0))
    scanner = Scanner.uniform(
        angle_min=-0.75 * math.pi, angle_increment=math.pi / 72, count=109, range_max=12.0, mount=(0.25, -0.125, 0.0)
    )
    return scene_in(grid, scanner, seed)


Results = dict[str, tuple[np.ndarray, Tolerance]]
# So often a GPU scores the scene's poses at once, which is often enough for them to be put in an order.
_REPEATS = 192


def chosen_backends(selections: Sequence[str] = ()) -> list[Backend]:
    """The backends of selection strings, each device once; a single one is joined by ``"numpy"``.

    Args:
        selections: None means every backend present, simulators left out.

    Raises:
        ValueError: a selection names nothing, or a device that is absent.
    """
    names = list(selections) or [d.selection for d in devices() if d.available and d.kind != "simulator"]
    if len(names) == 1:
        names.insert(0, "numpy")
    return list({backend.info.selection: backend for backend in map(get_backend, names)}.values())


def run(
    backends: Sequence[Backend], scene: Scene | None = None, step: Callable[[str], None] = lambda text: None
) -> list[Check]:
    """Compare backends, each with the truth and each two; ``step`` gets a backend's name before its turn."""
    scene, checks = scene or built_in_scene(), []
    found: dict[str, Results] = {}
    for backend in backends:
        step(backend.info.selection)
        found[backend.info.selection], own = own_results(backend, scene)
        checks += own
    for left, right in itertools.combinations(found, 2):
        for quantity, (value, tolerance) in found[left].items():
            if quantity in found[right]:
                checks.append(Check.of(left, right, quantity, value, found[right][quantity][0], tolerance.twice()))
    return checks


def own_results(backend: Backend, scene: Scene) -> tuple[Results, list[Check]]:
    """What a backend makes of a scene, and how far that is from the truth by its own inputs."""
    name, obstacles = backend.info.selection, scene.grid.obstacles()
    rows, cols = obstacles.shape
    squared, exact = distance_transform(obstacles, backend=backend), TOLERANCES["distance transform"]
    planes = backend.download(empty_rectangles(backend, obstacles, 1), np.empty(4 * (rows + 2) * (cols + 2), np.uint16))
    sides = np.minimum(planes & 255, planes >> 8)
    results: Results = {exact.name: (squared, exact), "empty squares": (sides, TOLERANCES["empty squares"])}
    checks = [Check.of(name, "SciPy", "distance transform", squared, scipy_squares(obstacles), exact)]
    launches: dict[str, Launch] = {}
    same_bits = TOLERANCES["batching, order, repetition"]
    for precision in ("float32", "float64")[: 1 + backend.info.float64]:
        caster = RayCaster(scene.grid, scene.scanner.range_max, backend=backend, precision=precision)
        ranges = TOLERANCES[f"{precision} ranges"]
        results[ranges.name] = caster.cast(scene.poses, scene.scanner.bearings), ranges
        beam, scan = beam_tolerance(precision), scan_tolerance(precision, scene.scanner.count)
        for model in _MODELS:
            recorder = Recorder(backend)
            log_p, parts = _score(model, scene, recorder, precision)
            key = f"{precision} {model}"
            results |= {f"{key}, scans": (log_p, scan), f"{key}, beams": (parts, beam)}
            (launch,) = recorder.launches
            launches[key] = launch
            true_log_p, true_parts = replay(launch)
            _, unspecialized = _score(model, scene, backend, precision, specialize=False)
            repeats = _REPEATS if backend.info.kind == "gpu" else 1
            alone = _model(model, scene, backend, precision).log_likelihood(
                np.tile(scene.poses, (repeats, 1)), scene.ranges
            )
            loose = TOLERANCES[f"specialize=False, {precision}"]
            checks += [
                Check.of(name, "truth", f"{key}, scans", launch.values["log_p"], true_log_p, scan),
                Check.of(name, "truth", f"{key}, beams", launch.parts, true_parts, beam),
                Check.of(name, "specialize=False", f"{key}, beams", unspecialized, parts, loose),
                Check.of(name, "per_beam=True", f"{key}, scans alone", alone, np.tile(log_p, repeats), same_bits),
            ]
    if backend.info.float64:
        single = launches["float32 field, nearest"].parts
        double = replay(launches["float64 field, nearest"], single)[1].astype(np.float32)
        checks.append(
            Check.of(name, "float64", "field, nearest, look-ups", single, double, TOLERANCES["field look-ups"])
        )
    return results, checks


def _model(model: str, scene: Scene, backend: Any, precision: str, **options: Any) -> BeamModel | LikelihoodFieldModel:
    make, parameters = _MODELS[model]
    return make(scene.grid, scene.scanner, parameters, backend=backend, precision=precision, **options)


def _score(model: str, scene: Scene, backend: Any, precision: str, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    made = _model(model, scene, backend, precision, **options)
    return made.log_likelihood(scene.poses, scene.ranges, per_beam=True)


def scipy_squares(obstacles: np.ndarray) -> np.ndarray:
    """The squared distance transform as SciPy has it, for maps with an obstacle: int32."""
    from scipy.ndimage import distance_transform_edt

    return np.rint(np.square(distance_transform_edt(~obstacles))).astype(np.int32)
