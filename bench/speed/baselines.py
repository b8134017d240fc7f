"""List other implementations as candidates, which error_vs_time/measure.py runs on the scenes of ``gpusense bench``.

numba (``pip install numba``): this project's code after public descriptions, parallel over particles on all processors:

- ``numba field``: the likelihood field as Beluga scores it: a precomputed grid of z_hit N(d; 0, sigma_hit) + z_rand /
    range_max, with one look-up per beam. ``log grid`` stores logarithms, so that a beam costs an addition; ``log of
    products`` stores densities as Beluga's ``LikelihoodFieldProbModel`` does and takes one logarithm for several beams;
    ``sum of cubes`` is the weight 1 + sum p^3 of AMCL and of Beluga's ``LikelihoodFieldModel``, which is not a
    likelihood.
- ``numba march``: ray marching of f1tenth_gym: steps through the Euclidean distances between cell centres, with
    headings rounded to a table of sines.

range_libc appears where the variable RANGE_LIBC names a copy of its sources, which are compiled then; f1tenth_gym where
it can be imported, or where F1TENTH_GYM names its file of the scan simulator, which is executed. Both run one thread.
They get the whole map in cells, without its yaw. ``filters.py`` adds the models of nav2_amcl and Beluga.
"""

from __future__ import annotations

import ctypes
import importlib.util
import inspect
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

from gpusense._util.extras import install_command
from gpusense.evaluation.benchmark.candidates import Candidate, Runner
from gpusense.evaluation.benchmark.runner import LeftOutError
from gpusense.evaluation.benchmark.scenes import Scene
from gpusense.world.scanner import Reading, classify

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from speed import filters

THETA_BINS = (2000,)
CDDT_BINS = (108, 720)
TABLE_BINS = 54
# f1tenth_gym stops where an obstacle is nearer than this [m].
NEAR = 1e-4
# Beams whose densities are multiplied before a logarithm is taken: no product over- or underflows float64.
BLOCK = 16

try:
    import numba
except ImportError as error:
    numba, NUMBA_MISSING = None, f"not installed ({error}): {install_command('numba')}"
else:
    NUMBA_MISSING = ""


def in_cells(scene: Scene, poses: np.ndarray) -> np.ndarray:
    """Return (N, 3) poses in the grid's frame, in cell units."""
    placed = np.empty_like(poses)
    placed[:, :2] = scene.grid.world_to_cells(poses[:, :2])
    placed[:, 2] = poses[:, 2] - scene.grid.origin[2]
    return placed


def hits(scene: Scene) -> np.ndarray:
    """Return the indices of the readings that are ranges."""
    return np.flatnonzero(classify(scene.readings, scene.scanner) == Reading.HIT)


if numba is not None:

    @numba.njit(parallel=True, cache=True)
    def sum_grid(grid, beyond, poses, points):
        """Sum a grid over the end points of each pose."""
        rows, cols = grid.shape
        found = np.empty(len(poses))
        for i in numba.prange(len(poses)):
            c, s, total = math.cos(poses[i, 2]), math.sin(poses[i, 2]), 0.0
            for k in range(len(points)):
                col = math.floor(poses[i, 0] + c * points[k, 0] - s * points[k, 1])
                row = math.floor(poses[i, 1] + s * points[k, 0] + c * points[k, 1])
                inside = 0 <= col < cols and 0 <= row < rows
                total += grid[row, col] if inside else beyond
            found[i] = total
        return found

    @numba.njit(parallel=True, cache=True)
    def score_products(grid, beyond, poses, points):
        """Add logarithms of products of a grid of densities, some beams at a time."""
        rows, cols = grid.shape
        found = np.empty(len(poses))
        for i in numba.prange(len(poses)):
            c, s, total, product = math.cos(poses[i, 2]), math.sin(poses[i, 2]), 0.0, 1.0
            for k in range(len(points)):
                col = math.floor(poses[i, 0] + c * points[k, 0] - s * points[k, 1])
                row = math.floor(poses[i, 1] + s * points[k, 0] + c * points[k, 1])
                inside = 0 <= col < cols and 0 <= row < rows
                product *= grid[row, col] if inside else beyond
                if k % BLOCK == BLOCK - 1:
                    total, product = total + math.log(product), 1.0
            found[i] = total + math.log(product)
        return found

    @numba.njit(parallel=True, cache=True)
    def march(distances, resolution, poses, bearings, cosines, sines, range_max):
        """March through distances between cell centres [m] to ranges [m]; poses in metres in the grid's frame."""
        rows, cols = distances.shape
        bins = len(cosines)
        found = np.empty((len(poses), len(bearings)))
        for i in numba.prange(len(poses)):
            for k in range(len(bearings)):
                bin_ = math.floor((poses[i, 2] + bearings[k]) / (2 * math.pi) * bins) % bins
                c, s, x, y = cosines[bin_], sines[bin_], poses[i, 0], poses[i, 1]
                total = 0.0
                while total <= range_max:
                    col, row = math.floor(x / resolution), math.floor(y / resolution)
                    if not (0 <= col < cols and 0 <= row < rows):
                        total = range_max
                        break
                    d = distances[row, col]
                    if d <= NEAR:
                        break
                    x, y, total = x + d * c, y + d * s, total + d
                found[i, k] = min(total, range_max)
        return found


def numba_field(kind: str) -> Callable[[Scene, None, str], Runner]:
    """Make a runner of a score with a precomputed grid."""

    def make(scene: Scene, backend: None, precision: str) -> Runner:
        p, chosen = scene.field, hits(scene)
        distance = np.minimum(distances_of(scene), p.max_distance)
        scale = p.z_hit / (p.sigma_hit * math.sqrt(2 * math.pi))

        def density(d: Any) -> Any:
            return scale * np.exp(-0.5 * (d / p.sigma_hit) ** 2) + p.z_rand / scene.scanner.range_max

        values, beyond = density(distance), float(density(p.max_distance))
        if kind == "log grid":
            values, beyond = np.log(values), math.log(beyond)
        elif kind == "sum of cubes":
            values, beyond = values**3, beyond**3
        grid = values.astype(precision)
        cells, bearings = scene.readings[chosen] / scene.grid.resolution, scene.scanner.bearings[chosen]
        points = cells[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
        if kind == "log of products":
            return lambda poses: score_products(grid, beyond, in_cells(scene, poses), points)
        # The weight of nav2_amcl and Beluga is 1 + sum of cubed densities.
        after = np.log1p if kind == "sum of cubes" else np.asarray
        return lambda poses: after(sum_grid(grid, beyond, in_cells(scene, poses), points))

    return make


def distances_of(scene: Scene) -> np.ndarray:
    """Return the distance from each cell centre to the nearest obstacle's [m]; a large one without obstacles."""
    obstacles = scene.grid.occupied
    if not obstacles.any():
        return np.full(obstacles.shape, scene.scanner.range_max)
    return distance_transform_edt(~obstacles) * scene.grid.resolution


def numba_march(bins: int) -> Callable[[Scene, None, str], Runner]:
    """Make a runner of f1tenth-style marching with a number of headings."""

    def make(scene: Scene, backend: None, precision: str) -> Runner:
        side, scanner = scene.grid.resolution, scene.scanner
        distances, turns = distances_of(scene), 2 * math.pi * np.arange(bins) / bins
        cosines, sines = np.cos(turns), np.sin(turns)

        def run(poses: np.ndarray) -> np.ndarray:
            placed = in_cells(scene, poses)
            placed[:, :2] *= side
            return march(distances, side, placed, scanner.bearings, cosines, sines, scanner.range_max)

        return run

    return make


SOURCE = "RANGE_LIBC"
CODE = Path(__file__).resolve().parents[1] / "accuracy" / "peer_code" / "range_libc.cpp"
KINDS = ("BL", "RM", "CDDT", "PCDDT", "GLT")
# range_libc's release options.
_FLAGS = ("-w", "-std=c++11", "-march=native", "-ffast-math", "-fno-math-errno", "-O3", "-fPIC", "-shared")
# Rays of the look-up table, of one thread: at some millions a second.
_MOST_RAYS = 100_000_000
_kept: list[tempfile.TemporaryDirectory[str]] = []


def load_range_libc() -> tuple[ctypes.CDLL | None, str]:
    """Compile range_libc; return the library, or the reason where it fails."""
    source = os.environ.get(SOURCE, "")
    if not source:
        return None, f"not compiled: {SOURCE} must name a copy of its sources"
    _kept.append(tempfile.TemporaryDirectory())
    library = Path(_kept[-1].name) / "range_libc.so"
    # lodepng is a header and a source.
    sources = [str(CODE), str(Path(source) / "vendor" / "lodepng" / "lodepng.cpp")]
    command = ["g++", *_FLAGS, f"-I{source}", "-DUSE_CUDA=0", "-o", str(library), *sources]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()
        return None, f"not compiled: {reason[0] if reason else error}"
    loaded = ctypes.CDLL(str(library))
    loaded.make.restype = ctypes.c_void_p
    return loaded, ""


class RangeLibc:
    """A caster of range_libc on a map in cells."""

    def __init__(self, library: ctypes.CDLL, kind: str, occupied: np.ndarray, range_max: float, bins: int) -> None:
        rows, cols = occupied.shape
        if kind == "GLT" and rows * cols * bins > _MOST_RAYS:
            raise LeftOutError(f"its table of {rows * cols * bins:.1e} rays would take too long on one thread")
        self._library, self._kind = library, KINDS.index(kind)
        cells = np.ascontiguousarray(occupied, np.uint8)
        # It prints while it builds tables.
        sys.stdout.flush()
        with open(os.devnull, "w") as silent:
            shown = os.dup(1)
            os.dup2(silent.fileno(), 1)
            try:
                self._caster = ctypes.c_void_p(
                    library.make(self._kind, _pointer(cells), cols, rows, ctypes.c_float(range_max), bins)
                )
            finally:
                os.dup2(shown, 1)
                os.close(shown)

    def cast(self, poses: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Return (N, K) ranges of (N, 3) poses, all in cells."""
        placed, turned = np.ascontiguousarray(poses, np.float32), np.ascontiguousarray(angles, np.float32)
        found = np.empty((len(placed), len(turned)), np.float32)
        self._library.cast(
            self._kind, self._caster, _pointer(placed), ctypes.c_long(len(placed)), _pointer(turned),
            ctypes.c_long(len(turned)), _pointer(found),
        )  # fmt: skip
        return found

    def __del__(self) -> None:
        if hasattr(self, "_caster"):
            self._library.destroy(self._kind, self._caster)


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def range_libc_caster(library: Any, kind: str, bins: int) -> Callable[[Scene, None, str], Runner]:
    """Make a runner of a range_libc method, in cells and in the frame of the grid."""

    def make(scene: Scene, backend: None, precision: str) -> Runner:
        limit = scene.scanner.range_max / scene.grid.resolution
        caster = RangeLibc(library, kind, scene.grid.occupied, limit, bins)

        def run(poses: np.ndarray) -> np.ndarray:
            return caster.cast(in_cells(scene, poses), scene.scanner.bearings) * scene.grid.resolution

        return run

    return make


def f1tenth_scan(module: Any, bins: int) -> Callable[[Scene, None, str], Runner]:
    """Make a runner of f1tenth_gym's scan simulator, which casts one scan a call."""

    def make(scene: Scene, backend: None, precision: str) -> Runner:
        bearings, limit = scene.scanner.bearings, scene.scanner.range_max
        known = inspect.signature(module.ScanSimulator2D.__init__).parameters
        options = {"eps": NEAR, "theta_dis": bins, "max_range": limit, "std_dev": 0.0}
        options = {name: value for name, value in options.items() if name in known}
        simulator = module.ScanSimulator2D(len(bearings), float(bearings[-1] - bearings[0]), **options)
        simulator.dt = distances_of(scene)
        simulator.map_height, simulator.map_width = simulator.dt.shape
        simulator.map_resolution = scene.grid.resolution
        simulator.orig_x, simulator.orig_y, yaw = scene.grid.origin
        simulator.orig_c, simulator.orig_s = math.cos(yaw), math.sin(yaw)
        middle = 0.5 * float(bearings[0] + bearings[-1])
        # Newer versions take the noise's generator; None means no noise.
        noise = (None,) if "rng" in inspect.signature(simulator.scan).parameters else ()

        def run(poses: np.ndarray) -> np.ndarray:
            turned = poses + np.array([0.0, 0.0, middle])
            return np.minimum(np.array([simulator.scan(pose, *noise) for pose in turned]), limit)

        return run

    return make


def laser_models() -> tuple[Any, str]:
    """Return f1tenth_gym's module of the scan simulator, or why there is none."""
    file = os.environ.get("F1TENTH_GYM", "")
    if not file:
        return imported("f110_gym.envs.laser_models", "f1tenth_gym.envs.laser_models")
    try:
        spec = importlib.util.spec_from_file_location("f1tenth_laser_models", file)
        module = sys.modules["f1tenth_laser_models"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    except Exception as error:
        return None, f"F1TENTH_GYM cannot be imported ({type(error).__name__}: {error})"
    return module, ""


def imported(*names: str) -> tuple[Any, str]:
    """Return the first module that can be imported, or the reasons why none can."""
    reasons = []
    for name in names:
        try:
            return importlib.import_module(name), ""
        except Exception as error:
            reasons.append(f"{name} cannot be imported ({type(error).__name__}: {error})")
    return None, "; ".join(reasons)


def candidates() -> list[Candidate]:
    """Return the outside rows; those that cannot run say why."""
    threads = "all threads" if numba is None else f"{numba.get_num_threads()} threads"
    name = "numba" if numba is None else f"numba {numba.__version__}, {threads}"
    own = {"outside": name, "missing": NUMBA_MISSING}
    found = [
        Candidate("field", "numba field", numba_field(kind), kind, exact=kind != "sum of cubes", **own)
        for kind in ("log grid", "log of products", "sum of cubes")
    ]
    found += [
        Candidate("ranges", "numba march", numba_march(bins), "", "headings", bins, precision="float64", **own)
        for bins in THETA_BINS
    ]
    library, missing = load_range_libc()
    own = {"outside": "range_libc, 1 thread", "missing": missing}
    casters = [("BL", None), ("RM", None), *(("CDDT", bins) for bins in CDDT_BINS), ("PCDDT", CDDT_BINS[0]),
               ("GLT", TABLE_BINS)]  # fmt: skip
    found += [
        Candidate(
            "ranges", "range_libc", range_libc_caster(library, kind, bins or 0), kind, "bins" if bins else "", bins,
            **own,
        )
        for kind, bins in casters
    ]  # fmt: skip
    module, missing = laser_models()
    own = {"outside": "f1tenth_gym, 1 thread", "missing": missing}
    found += [
        Candidate("ranges", "f1tenth_gym", f1tenth_scan(module, bins), "", "headings", bins, precision="float64", **own)
        for bins in THETA_BINS
    ]
    return found + filters.candidates()
