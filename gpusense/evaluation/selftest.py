"""Compare each backend of this machine with the float64 truth on its rounded inputs, and the backends in pairs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense._util.typing import PRECISIONS, Precision
from gpusense.backends import Backend, devices, get_backend
from gpusense.evaluation.replay import Launch, Recorder, replay
from gpusense.evaluation.tolerances import TOLERANCES, Check, Tolerance, beam_tolerance, scan_tolerance
from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose, simulate_scan
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.tables.distances import distance_transform
from gpusense.tables.rectangles import Planes, empty_rectangles
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters, IncidenceParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Scanner

_SONAR = "sonar by incidence"
_MODELS: dict[str, tuple[Callable[..., BeamModel | LikelihoodFieldModel], dict[str, Any]]] = {
    "beam model": (BeamModel, {"parameters": BeamParameters()}),
    "field, nearest": (LikelihoodFieldModel, {"parameters": LikelihoodFieldParameters(z_hit=0.85, z_max=0.05)}),
    "field, bilinear": (LikelihoodFieldModel, {"parameters": LikelihoodFieldParameters(interpolation="bilinear")}),
    _SONAR: (
        BeamModel,
        {
            "incidence": IncidenceParameters(
                (0, 0.5, math.pi / 2),
                (BeamParameters(), BeamParameters(z_hit=0.3, z_short=0.1, z_max=0.4, z_rand=0.2, sigma_hit=0.1)),
                BeamParameters(z_hit=0.1, z_short=0.1, z_max=0.7, z_rand=0.1),
            )
        },
    ),
}
# Width of a sonar's cone, and the angle of incidence beyond which a wall reflects sound away [rad].
_CONE, _CRITICAL = 0.2, 1.1


@dataclass(frozen=True)
class Scene:
    """A map, a scanner, poses (N, 3) [m, m, rad] and a scan (K,) [m]."""

    grid: OccupancyGrid
    scanner: Scanner
    poses: np.ndarray
    ranges: np.ndarray


def scene_in(grid: OccupancyGrid, scanner: Scanner, seed: int = 0) -> Scene:
    """Simulate a scan with missing and max readings, and draw poses near it, everywhere, off the map and on corners."""
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
    """Make a scene in a building far from the origin; its corners, mount and resolution are exact in float32."""
    plain = building(seed, (24.0, 14.0), resolution=0.0625)
    grid = OccupancyGrid(plain.cells, plain.resolution, (3000.0, -5000.0, 0.0))
    scanner = Scanner.uniform(
        angle_min=-0.75 * math.pi, angle_increment=math.pi / 72, count=109, range_max=12.0, mount=(0.25, -0.125, 0.0)
    )
    return scene_in(grid, scanner, seed)


Results = dict[str, tuple[np.ndarray, Tolerance]]
# Copies of the scene's poses in one call on a GPU, enough for the models to order them.
_REPEATS = 192


def chosen_backends(selections: Sequence[str] = ()) -> list[Backend]:
    """Open the backends of selection strings, each device once; ``"numpy"`` joins a single one."""
    names = list(selections) or [d.selection for d in devices() if d.available and d.kind != "simulator"]
    if len(names) == 1:
        names.insert(0, "numpy")
    return list({backend.info.selection: backend for backend in map(get_backend, names)}.values())


def run(
    backends: Sequence[Backend],
    scene: Scene | None = None,
    step: Callable[[str], None] = lambda text: None,
    *,
    sonar: bool = True,
    checks: list[Check] | None = None,
) -> list[Check]:
    """Compare backends with the truth and in pairs."""
    scene, checks = scene or built_in_scene(), [] if checks is None else checks
    results: dict[str, Results] = {}
    for backend in backends:
        step(backend.info.selection)
        results[backend.info.selection], truth_checks = evaluate_backend(backend, scene, sonar=sonar)
        checks += truth_checks
    for left, right in itertools.combinations(results, 2):
        for quantity, (value, tolerance) in results[left].items():
            if quantity in results[right]:
                checks.append(Check.of(left, right, quantity, value, results[right][quantity][0], tolerance.twice()))
    return checks


def evaluate_backend(backend: Backend, scene: Scene, *, sonar: bool = True) -> tuple[Results, list[Check]]:
    """Compute a scene on a backend; return the results, and their comparisons with the truth on its rounded inputs."""
    results, checks = _tables(backend, scene)
    launches: dict[str, Launch] = {}
    for precision in PRECISIONS[: 1 + backend.info.float64]:
        results |= _ranges(backend, scene, precision, sonar=sonar)
        for model in (name for name in _MODELS if sonar or name != _SONAR):
            key = f"{precision} {model}"
            scores, score_checks, launches[key] = _scores(backend, scene, precision, model)
            results |= scores
            checks += score_checks
    if backend.info.float64:
        single = launches["float32 field, nearest"].parts
        double = replay(launches["float64 field, nearest"], single)[1].astype(np.float32)
        tolerance = TOLERANCES["field look-ups"]
        checks.append(
            Check.of(backend.info.selection, "float64", "field, nearest, look-ups", single, double, tolerance)
        )
    return results, checks


def _tables(backend: Backend, scene: Scene) -> tuple[Results, list[Check]]:
    """Compute the map's tables, and compare the distance transform with SciPy's."""
    name, obstacles = backend.info.selection, scene.grid.obstacles()
    rows, cols = obstacles.shape
    squared, exact = distance_transform(obstacles, squared=True, backend=backend), TOLERANCES["distance transform"]
    planes = backend.download(
        empty_rectangles(backend, obstacles, Planes(1)), np.empty(4 * (rows + 2) * (cols + 2), np.uint16)
    )
    sides = np.minimum(planes & 255, planes >> 8)
    results: Results = {exact.name: (squared, exact), "empty squares": (sides, TOLERANCES["empty squares"])}
    return results, [Check.of(name, "SciPy", "distance transform", squared, scipy_squares(obstacles), exact)]


def _ranges(backend: Backend, scene: Scene, precision: Precision, *, sonar: bool) -> Results:
    """Compute expected ranges and, for the ring of sonars, ranges of cones and angles of incidence."""
    caster = RayCaster(scene.grid, scene.scanner.range_max, backend=backend, precision=precision)
    ranges, angles = TOLERANCES[f"{precision} ranges"], TOLERANCES[f"{precision} angles of incidence"]
    results: Results = {ranges.name: (caster.cast(scene.poses, scene.scanner.bearings), ranges)}
    if sonar:
        ring = _model(_SONAR, scene, backend, precision)
        assert isinstance(ring, BeamModel)
        results[f"{precision} ranges of cones"] = ring.expected_ranges(scene.poses), ranges
        # A cone without return has no angle of incidence; -1 marks it.
        results[angles.name] = np.nan_to_num(ring.incidence(scene.poses), nan=-1.0), angles
    return results


def _scores(backend: Backend, scene: Scene, precision: str, model: str) -> tuple[Results, list[Check], Launch]:
    """Score a scene with one model; compare with the truth, the unspecialised model and scores without ``per_beam``."""
    name, key = backend.info.selection, f"{precision} {model}"
    beam, scan = beam_tolerance(precision), scan_tolerance(precision, scene.scanner.count)
    recorder = Recorder(backend)
    log_p, parts = _score(model, scene, recorder, precision)
    (launch,) = recorder.launches
    true_log_p, true_parts = replay(launch)
    _, unspecialized = _score(model, scene, backend, precision, specialize=False)
    repeats = _REPEATS if backend.info.kind == "gpu" else 1
    poses = np.tile(scene.poses, (repeats, 1))
    alone = _model(model, scene, backend, precision).log_likelihood(poses, scene.ranges)
    loose, same_bits = TOLERANCES[f"specialize=False, {precision}"], TOLERANCES["batching, order, repetition"]
    checks = [
        Check.of(name, "truth", f"{key}, scans", launch.values["log_p"], true_log_p, scan),
        Check.of(name, "truth", f"{key}, beams", launch.parts, true_parts, beam),
        Check.of(name, "specialize=False", f"{key}, beams", unspecialized, parts, loose),
        Check.of(name, "per_beam=True", f"{key}, scans alone", alone, np.tile(log_p, repeats), same_bits),
    ]
    return {f"{key}, scans": (log_p, scan), f"{key}, beams": (parts, beam)}, checks, launch


def _model(model: str, scene: Scene, backend: Any, precision: str, **options: Any) -> BeamModel | LikelihoodFieldModel:
    make, parameters = _MODELS[model]
    scanner = sonar_of(scene.scanner) if model == _SONAR else scene.scanner
    return make(scene.grid, scanner, **parameters, backend=backend, precision=precision, **options)


def sonar_of(scanner: Scanner) -> Scanner:
    """Make a ring of sonars with a scanner's bearings and cones of three rays."""
    return Scanner(
        scanner.bearings, scanner.range_max, range_min=scanner.range_min, mount=scanner.mount,
        cone=_CONE, cone_rays=3, critical_incidence=_CRITICAL,
    )  # fmt: skip


def _score(model: str, scene: Scene, backend: Any, precision: str, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    made = _model(model, scene, backend, precision, **options)
    return made.log_likelihood(scene.poses, scene.ranges, per_beam=True)


def scipy_squares(obstacles: np.ndarray) -> np.ndarray:
    """Compute the squared distance transform (int32) with SciPy; the map must have an obstacle."""
    from scipy.ndimage import distance_transform_edt

    return np.rint(np.square(distance_transform_edt(~obstacles))).astype(np.int32)
