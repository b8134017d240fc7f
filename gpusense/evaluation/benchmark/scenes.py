"""Make scenes: a map, a scanner, a true pose, a scan simulated at that pose, and two clouds of particles."""

from __future__ import annotations

import functools
import hashlib
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpusense._util.typing import Floats, Precision
from gpusense.backends import Backend
from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, is_free, sample_readings
from gpusense.models.scan.caster import RayCaster
from gpusense.world.grid import OccupancyGrid
from gpusense.world.map_files import read_map
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Reading, Scanner, classify

CLOUDS = ("global", "tracking")
"""Uniform over the free cells and all headings; normal around the true pose, restricted to free space."""
SIGMA_POSITION, SIGMA_HEADING = 0.5, 0.25  # of the tracking cloud [m, rad]
RANGE_MAX = 30.0

# Width and height of the generated maps, in full and in quick runs [m].
_SIZES = {"building": (50.0, 50.0), "clutter": (50.0, 50.0)}
_QUICK_SIZES = {"building": (20.0, 14.0), "clutter": (15.0, 15.0)}
_RESOLUTION = 0.05
_CLEARANCE = 0.4  # from the true pose to the nearest cell that is not free [m]
_TRIED_POSES = 32
_MOST_ROUNDS = 1000


@dataclass(frozen=True)
class MapSource:
    """Source of a scene's map.

    Attributes:
        origin: Description of a generated map, or the name of the map's file.
        size: Width and height of a generated map [m].
    """

    name: str
    origin: str
    path: Path | None = None
    size: tuple[float, float] = (0.0, 0.0)

    def grid(self, seed: int) -> OccupancyGrid:
        """Read the map, or generate it from the seed."""
        if self.path is not None:
            return read_map(self.path)
        make = {"building": building, "clutter": clutter}[self.name]
        return make(seed, self.size, _RESOLUTION)


@dataclass(frozen=True)
class Scene:
    """The inputs that all candidates share.

    Attributes:
        origin: Description of a generated map, or the name of the map's file.
        grid: The map; unknown cells and the surroundings of the map are free.
        pose: (3,) true pose of the scan [m, m, rad].
        readings: (K,) the scan, drawn from the beam model [m]; +inf where there is no return.
        clouds: (N, 3) particles by the cloud's name [m, m, rad].
    """

    name: str
    origin: str
    grid: OccupancyGrid
    scanner: Scanner
    pose: Floats
    readings: Floats
    clouds: Mapping[str, Floats]
    beam: BeamParameters
    field: LikelihoodFieldParameters

    @functools.cached_property
    def hits(self) -> int:
        """Count the readings that are ranges, which a model evaluates for each particle."""
        return int(np.count_nonzero(classify(self.readings, self.scanner) == Reading.HIT))

    @functools.cached_property
    def fingerprint(self) -> str:
        """Return 16 hexadecimal digits of a hash over map, scan and particles; equal scenes have equal digits."""
        digest = hashlib.sha256()
        grid = self.grid
        placed = (grid.resolution, *grid.origin, float(grid.occupied_threshold), self.scanner.range_max)
        for part in (grid.cells, np.array(placed), self.scanner.bearings, self.readings, *self.clouds.values()):
            digest.update(np.ascontiguousarray(part).tobytes())
        digest.update(repr((grid.shape, self.beam, self.field)).encode())
        return digest.hexdigest()[:16]


def sources(names: Sequence[str] | None = None, maps: Sequence[Path] = (), *, quick: bool = False) -> list[MapSource]:
    """List the maps of a run: generated ones by ``names``, and ``maps``; all generated ones if neither is passed."""
    sizes = _QUICK_SIZES if quick else _SIZES
    chosen = [
        MapSource(name, f"generated, {width:g} x {height:g} m", None, (width, height))
        for name, (width, height) in sizes.items()
        if name in (names or ()) or not (names or maps)
    ]
    chosen += [MapSource(path.stem, path.name, path) for path in maps]
    if len({source.name for source in chosen}) < len(chosen):
        raise ValueError(f"map: every scene must have a name of its own, got {', '.join(s.name for s in chosen)}")
    return chosen


def make_scene(source: MapSource, device: Backend, *, beams: int, particles: int, seed: int) -> Scene:
    """Make the scene of a map; it depends on these arguments alone."""
    grid = source.grid(seed)
    scanner = Scanner.uniform(
        angle_min=-math.pi, angle_increment=2 * math.pi / max(beams, 1), count=beams, range_max=RANGE_MAX
    )
    names = ("pose", "scan", *CLOUDS)
    key = zlib.crc32(source.name.encode())
    rng = {name: np.random.default_rng([seed, key, i]) for i, name in enumerate(names)}
    pose, expected = _true_pose(source.name, grid, scanner, device, rng["pose"])
    # Readings are rounded to a tenth of a millimetre, so that they are equal on every device that casts them.
    readings = np.round(sample_readings(expected, RANGE_MAX, BeamParameters(), rng["scan"]), 4)
    clouds = {
        "global": cloud_uniform(grid, particles, rng["global"]),
        "tracking": _cloud_in_free_space(grid, pose, particles, rng["tracking"]),
    }
    return Scene(
        source.name, source.origin, grid, scanner, pose, readings, clouds, BeamParameters(), LikelihoodFieldParameters()
    )


def _true_pose(
    name: str, grid: OccupancyGrid, scanner: Scanner, device: Backend, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Draw a pose away from walls at which most beams hit; return it with its expected ranges."""
    from scipy.ndimage import distance_transform_edt

    wanted = _CLEARANCE / grid.resolution + math.sqrt(2)
    clear = distance_transform_edt(np.pad(grid.free, 1))[1:-1, 1:-1] >= wanted
    if not clear.any():
        raise ValueError(f"scene {name}: the map must have a place {_CLEARANCE} m away from everything, got none")
    room = OccupancyGrid(np.where(clear, 0, 100).astype(np.int8), grid.resolution, grid.origin)
    poses = cloud_uniform(room, _TRIED_POSES, rng)
    precision: Precision = "float64" if device.info.float64 else "float32"
    caster = RayCaster(grid, scanner.range_max, backend=device, precision=precision)
    expected = np.minimum(caster.cast(poses, scanner.bearings).astype(np.float64), scanner.range_max)
    seen = np.count_nonzero(expected < scanner.range_max, axis=1)
    # Take the first pose with enough hits, since the pose with most hits would always be in the smallest room.
    chosen = int(np.argmax(seen >= min(2 * scanner.count / 3, seen.max())))
    return poses[chosen], expected[chosen]


def _cloud_in_free_space(grid: OccupancyGrid, pose: Floats, n: int, rng: np.random.Generator) -> Floats:
    """Draw (n, 3) particles of the tracking cloud; particles outside free cells are drawn again."""
    kept, count = [np.empty((0, 3))], 0
    for _ in range(_MOST_ROUNDS):
        if count >= n:
            break
        drawn = cloud_around(pose, n, SIGMA_POSITION, SIGMA_HEADING, rng)
        kept.append(drawn[is_free(grid, drawn[:, :2])])
        count += len(kept[-1])
    return np.concatenate(kept)[:n]


def clutter(seed: int = 0, size: tuple[float, float] = (50.0, 50.0), resolution: float = 0.05) -> OccupancyGrid:
    """Generate a walled hall of (W, H) [m] full of boxes: shelves, crates, and many objects of at most 4 cells."""
    rng = np.random.default_rng(seed)
    cols, rows = (round(side / resolution) for side in size)
    cells = np.zeros((rows, cols), np.int8)
    area = size[0] * size[1]
    # Number per square metre, and the shortest and longest side [m].
    for density, shortest, longest in ((0.01, 0.8, 4.0), (0.05, 0.3, 1.0), (0.3, resolution, 4 * resolution)):
        for _ in range(round(density * area)):
            height, width = np.maximum(np.rint(rng.uniform(shortest, longest, 2) / resolution), 1).astype(int)
            row, col = rng.integers(0, max(rows - height, 1)), rng.integers(0, max(cols - width, 1))
            cells[row : row + height, col : col + width] = 100
    wall = max(round(0.2 / resolution), 1)
    cells[:wall], cells[-wall:], cells[:, :wall], cells[:, -wall:] = 100, 100, 100, 100
    return OccupancyGrid(cells, resolution)
