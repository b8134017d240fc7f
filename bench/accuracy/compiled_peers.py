"""Models and filters of nav2_amcl and Beluga, compiled from the user's copies of their sources."""

from __future__ import annotations

import ctypes
import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt

import gpusense as gs

CODE = Path(__file__).resolve().parent / "peer_code"
MODELS = {"beam": 0, "field": 1, "field, prob": 2}
_NAV2_FILES = (
    "map/map.c",
    "map/map_range.c",
    "pf/pf.c",
    "pf/pf_kdtree.c",
    "pf/pf_pdf.c",
    "pf/pf_vector.c",
    "pf/eig3.c",
)
_C = ("gcc", "-O2", "-DNDEBUG", "-DHAVE_DRAND48", "-fPIC", "-c")
# nav2_amcl pushes obstacles into the queue of its distances with a priority that it never sets (map_cspace.cpp): zero.
_SET = "-ftrivial-auto-var-init=zero"
_FLAGS = ("-std=c++17", "-O2", "-DNDEBUG", "-fPIC", "-shared")


@dataclass(frozen=True)
class Compiled:
    """A peer in a shared library, see the files in ``peer_code``."""

    name: str
    library: ctypes.CDLL

    def score(
        self,
        grid: gs.OccupancyGrid,
        scanner: gs.Scanner,
        parameters: Sequence[float],
        model: str,
        options: int,
        poses: np.ndarray,
        ranges: np.ndarray,
        nearest: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the weight of each pose, and the cells of the likelihood field: distances [m], or densities.

        ``poses``: (N, 3) poses. ``ranges``: (K,) readings [m]. ``nearest``: Index of the nearest obstacle of each cell,
        or -1; None for the peer's own distances.
        """
        rows, cols = grid.shape
        weights, field = np.empty(len(poses)), np.zeros(grid.shape, np.float32)
        cells = np.ascontiguousarray(grid.cells)
        geometry = np.array([grid.resolution, *grid.origin])
        kept = [np.ascontiguousarray(array, np.float64) for array in (parameters, poses, ranges, scanner.bearings)]
        given = None if nearest is None else np.ascontiguousarray(nearest, np.int64)
        self.library.score(
            _pointer(cells), rows, cols, _pointer(geometry), _pointer(kept[0]), MODELS[model], options,
            _pointer(kept[1]), len(poses), _pointer(kept[2]), _pointer(kept[3]), len(ranges),
            ctypes.c_double(scanner.range_min), ctypes.c_double(scanner.range_max),
            None if given is None else _pointer(given), _pointer(weights), _pointer(field),
        )  # fmt: skip
        return weights, field

    def cast(self, grid: gs.OccupancyGrid, scanner: gs.Scanner, poses: np.ndarray) -> np.ndarray:
        """Return (N, K) ranges of the map."""
        ranges = np.empty((len(poses), scanner.count))
        cells, geometry = np.ascontiguousarray(grid.cells), np.array([grid.resolution, *grid.origin])
        kept = [np.ascontiguousarray(array, np.float64) for array in (poses, scanner.bearings)]
        self.library.cast(
            _pointer(cells), *grid.shape, _pointer(geometry), _pointer(kept[0]), len(poses), _pointer(kept[1]),
            scanner.count, ctypes.c_double(scanner.range_max), _pointer(ranges),
        )  # fmt: skip
        return ranges


class Weigher:
    """A model of a peer that is made once; its calls return only weights.

    Args:
        compiled: The peer.
        grid: The map, without a yaw.
        scanner: The scanner, without a mount.
        parameters, model, options: As of ``Compiled.score``.
    """

    def __init__(
        self,
        compiled: Compiled,
        grid: gs.OccupancyGrid,
        scanner: gs.Scanner,
        parameters: Sequence[float],
        model: str,
        options: int = 0,
    ) -> None:
        self._library, self._scanner = compiled.library, scanner
        self._bearings = np.ascontiguousarray(scanner.bearings, np.float64)
        cells, geometry = np.ascontiguousarray(grid.cells), np.array([grid.resolution, *grid.origin])
        given = np.ascontiguousarray(parameters, np.float64)
        make = compiled.library.prepare
        make.restype = ctypes.c_void_p
        self._made = ctypes.c_void_p(
            make(_pointer(cells), *grid.shape, _pointer(geometry), _pointer(given), MODELS[model], options,
                 scanner.count, ctypes.c_double(scanner.range_max), None)
        )  # fmt: skip

    def __call__(self, poses: np.ndarray, ranges: np.ndarray) -> np.ndarray:
        """Return the weights of (N, 3) poses for (K,) readings."""
        weights = np.empty(len(poses))
        placed, read = np.ascontiguousarray(poses, np.float64), np.ascontiguousarray(ranges, np.float64)
        self._library.weigh(
            self._made, _pointer(placed), len(placed), _pointer(read), _pointer(self._bearings), len(read),
            ctypes.c_double(self._scanner.range_min), ctypes.c_double(self._scanner.range_max), _pointer(weights),
        )  # fmt: skip
        return weights

    def __del__(self) -> None:
        if hasattr(self, "_made"):
            self._library.discard(self._made)


class Follower:
    """A particle filter of a peer: motion model, weights, resampling, and the pose that it reports.

    The number of particles is fixed, every scan is used, and no random poses are injected. nav2_amcl reports the mean
    of its heaviest cluster, Beluga the mean of all particles.

    Args:
        weigher: The model, which must outlive the filter.
        particles: Their number.
        mean: Pose of the start.
        deviations: Standard deviations of x, y and heading around it [m, m, rad].
        alpha: The four parameters of the odometry's noise.
        seed: Of the random numbers.
    """

    def __init__(
        self,
        weigher: Weigher,
        particles: int,
        mean: Sequence[float],
        deviations: Sequence[float],
        alpha: Sequence[float],
        seed: int,
    ) -> None:
        self._weigher, begin = weigher, weigher._library.start
        begin.restype = ctypes.c_void_p
        given = [np.ascontiguousarray(array, np.float64) for array in (mean, deviations, alpha)]
        self._filter = ctypes.c_void_p(begin(weigher._made, particles, *map(_pointer, given), seed))

    def step(self, odometry: Sequence[float], ranges: np.ndarray) -> np.ndarray:
        """Process the pose of the odometry and (K,) readings [m]; return the pose on the map."""
        moved, read, found = np.array(odometry, np.float64), np.ascontiguousarray(ranges, np.float64), np.empty(3)
        scanner, bearings = self._weigher._scanner, self._weigher._bearings
        self._weigher._library.step(
            self._filter, _pointer(moved), _pointer(read), _pointer(bearings), len(read),
            ctypes.c_double(scanner.range_min), ctypes.c_double(scanner.range_max), _pointer(found),
        )  # fmt: skip
        return found

    def __del__(self) -> None:
        if hasattr(self, "_filter"):
            self._weigher._library.stop(self._filter)


def build(name: str, source: Path, include: Sequence[Path], folder: Path) -> Compiled:
    """Compile a peer, ``"amcl"`` or ``"beluga"``."""
    library = folder / f"{name}.so"
    if name == "amcl":
        root = source / "nav2_amcl"
        objects = []
        for file in _NAV2_FILES:
            objects.append(str(folder / f"{Path(file).stem}.o"))
            # The models' function of this name is in nav2.cpp.
            renamed = ["-Dpf_update_sensor=filter_update_sensor"] if file == "pf/pf.c" else []
            _run(*_C, *renamed, f"-I{root / 'include'}", str(root / "src" / file), "-o", objects[-1])
        models = [str(path) for path in sorted((root / "src" / "sensors" / "laser").glob("*.cpp"))]
        models.append(str(root / "src" / "motion_model" / "differential_motion_model.cpp"))
        _run("g++", *_FLAGS, _SET, f"-I{root}", f"-I{root / 'include'}", f"-I{CODE / 'stubs'}", "-o", str(library),
             str(CODE / "nav2.cpp"), *models, *objects)  # fmt: skip
    else:
        headers = [f"-I{path}" for path in (source / "beluga" / "include", *include)]
        _run("g++", *_FLAGS, *headers, "-DSOPHUS_USE_BASIC_LOGGING", "-o", str(library), str(CODE / "beluga.cpp"),
             "-ltbb")  # fmt: skip
    return Compiled(name, ctypes.CDLL(str(library)))


def version(source: Path, package: str) -> str:
    """Return the version that a package states."""
    found = re.search(r"<version>(.*?)</version>", (source / package / "package.xml").read_text(encoding="utf-8"))
    return f"{package} {found[1] if found else 'unknown'}"


def nearest_obstacles(mask: np.ndarray) -> np.ndarray:
    """Return the index of the nearest obstacle of each cell of a mask by SciPy, -1 without an obstacle."""
    if not mask.any():
        return np.full(mask.shape, -1)
    row, col = distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return np.asarray(row.astype(np.int64) * mask.shape[1] + col)


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _run(*command: str) -> None:
    subprocess.run(command, check=True)
