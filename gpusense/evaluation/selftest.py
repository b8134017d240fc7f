"""Do the backends of this machine agree? Each against the float64 truth on its own rounded inputs, and pairwise."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense.backends import Backend, devices, get_backend
from gpusense.evaluation.replay import Launch, Recorder, replay
from gpusense.evaluation.tolerances import TOLERANCES, Check, Tolerance, beam_tolerance, scan_tolerance
from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose, simulate_scan
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.tables.distances import distance_transform
from gpusense.tables.rectangles import empty_rectangles
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
# How wide a sonar hears [rad], and beyond which angle walls are mirrors to it [rad].
_CONE, _CRITICAL = 0.2, 1.1


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
    backends: Sequence[Backend],
    scene: Scene | None = None,
    step: Callable[[str], None] = lambda text: None,
    *,
    sonar: bool = True,
) -> list[Check]:
    """Compare backends, each with the truth and each two; ``step`` gets a backend's name before its turn.

    ``sonar`` says whether a ring of sonars is among the models, for which the normals of the map are found often.
    """
    scene, checks = scene or built_in_scene(), []
    found: dict[str, Results] = {}
    for backend in backends:
        step(backend.info.selection)
        found[backend.info.selection], own = own_results(backend, scene, sonar=sonar)
        checks += own
    for left, right in itertools.combinations(found, 2):
        for quantity, (value, tolerance) in found[left].items():
            if quantity in found[right]:
                checks.append(Check.of(left, right, quantity, value, found[right][quantity][0], tolerance.twice()))
    return checks


def own_results(backend: Backend, scene: Scene, *, sonar: bool = True) -> tuple[Results, list[Check]]:
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
        if sonar:
            ring = _model(_SONAR, scene, backend, precision)
            assert isinstance(ring, BeamModel)
            results[f"{precision} ranges of cones"] = ring.expected_ranges(scene.poses), ranges
            angles = TOLERANCES[f"{precision} angles of incidence"]
            # A cone from which nothing returns has no angle, which -1 tells from every one.
            results[angles.name] = np.nan_to_num(ring.incidence(scene.poses), nan=-1.0), angles
        beam, scan = beam_tolerance(precision), scan_tolerance(precision, scene.scanner.count)
        for model in (name for name in _MODELS if sonar or name != _SONAR):
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
    scanner = sonar_of(scene.scanner) if model == _SONAR else scene.scanner
    return make(scene.grid, scanner, **parameters, backend=backend, precision=precision, **options)


def sonar_of(scanner: Scanner) -> Scanner:
    """A ring of sonars with a scanner's bearings, cones of three rays."""
    return Scanner(
        scanner.bearings, scanner.range_max, range_min=scanner.range_min, mount=scanner.mount,
        cone=_CONE, cone_rays=3, critical_incidence=_CRITICAL,
    )  # fmt: skip


def _score(model: str, scene: Scene, backend: Any, precision: str, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    made = _model(model, scene, backend, precision, **options)
    return made.log_likelihood(scene.poses, scene.ranges, per_beam=True)


def scipy_squares(obstacles: np.ndarray) -> np.ndarray:
    """The squared distance transform as SciPy has it, for maps with an obstacle: int32."""
    from scipy.ndimage import distance_transform_edt

    return np.rint(np.square(distance_transform_edt(~obstacles))).astype(np.int32)
