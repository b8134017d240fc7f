"""Families of small maps and rays that both precisions represent exactly, with the oracle's walks."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from support.ray_oracles import Ray, walk

from gpusense.backends import get_backend
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.structs import Caster, RangeScale, Window
from gpusense.tables.rectangles import Planes, empty_rectangles

LAST_FLOAT32 = 1 - 2.0**-24
FRACTIONS = (0.0, 0.25, 0.5, 0.75, LAST_FLOAT32)
PRECISIONS = ("float64", "float32")
# Tolerances of float32 in cells, cells and radians; tolerances of float64 are near its rounding.
FLOAT32_CELLS, FLOAT32_MOVE, FLOAT32_TURN = 1e-3, 1e-4, 1e-6
FLOAT64_RELATIVE, FLOAT64_MOVE, FLOAT64_TURN = 1e-12, 1e-13, 1e-15


@dataclass(frozen=True, eq=False)
class Scene:
    """Rays in cell units; every number is a float32, so that both precisions have the same inputs."""

    occupied: np.ndarray
    cell: np.ndarray
    frac: np.ndarray
    direction: np.ndarray
    limit: float
    outside_occupied: bool = False
    grazes: bool = True

    def ray(self, i: int) -> Ray:
        (x, y), frac, direction = self.cell[i].tolist(), self.frac[i].tolist(), self.direction[i].tolist()
        return Ray((x, y), (frac[0], frac[1]), (direction[0], direction[1]), self.limit)

    @functools.cached_property
    def exact(self) -> np.ndarray:
        """Return the walk's ranges, correctly rounded."""
        cells = self.occupied.tolist()
        return np.array([walk(cells, self.ray(i), self.outside_occupied).t for i in range(len(self.cell))])


ONE_SECTOR = Planes(1)


@functools.cache
def cast(scene: Scene, backend: str, precision: str, form: Planes = ONE_SECTOR, *, wide: bool = False) -> np.ndarray:
    """Return the kernel's ranges in cells; a pose's heading is the direction of its single ray.

    Args:
        scene: Map and rays.
        backend: The device.
        precision: ``"float32"`` or ``"float64"``.
        form: Form of the planes of rectangles.
        wide: True to use the kernel for the device's lanes, if any.
    """
    device, real = get_backend(backend), np.dtype(precision)
    rows, cols = scene.occupied.shape
    flags = {"FLOAT64"} if precision == "float64" else set()
    flags |= {"OUTSIDE_OCCUPIED"} if scene.outside_occupied else set()
    flags |= {"ORIGINS_OUTSIDE"} if not ((scene.cell >= 0) & (scene.cell < (cols, rows))).all() else set()
    pose = np.concatenate([scene.frac, scene.direction], axis=1)
    count = len(pose)
    flags |= form.flags
    table = empty_rectangles(device, scene.occupied, form)
    cell, pose = device.upload(scene.cell.astype(np.int32)), device.upload(pose.astype(real))
    rays, ranges = device.upload(np.array([[1.0, 0.0]], real)), device.empty(count, real)
    code = with_lanes_flag(device.info.lanes, "cast_ranges", flags) if wide else frozenset(flags)
    device.compile("cast_ranges", code)(
        (1, count),
        table,
        cell,
        pose,
        rays,
        ranges,
        Window(0, 0, rows, cols),
        count,
        1,
        Caster(0, 0.0, 0.0),
        RangeScale(scene.limit, 1.0, scene.limit),
    )
    return device.download(ranges, np.empty(count, real))


def as_float32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64)


def some_map(rng: np.random.Generator, density: float | None = None, largest: int = 40) -> np.ndarray:
    rows, cols = rng.integers(1, largest + 1, 2)
    return rng.random((rows, cols)) < (rng.choice([0.01, 0.05, 0.2]) if density is None else density)


def some_cells(rng: np.random.Generator, occupied: np.ndarray, count: int, beyond: int = 0) -> np.ndarray:
    rows, cols = occupied.shape
    return np.stack([rng.integers(-beyond, n + beyond, count) for n in (cols, rows)], axis=1)


def unit(angle: np.ndarray) -> np.ndarray:
    return as_float32(np.stack([np.cos(angle), np.sin(angle)], axis=-1))


def random_scenes(rng: np.random.Generator) -> list[Scene]:
    """Yield scenes of any kind, including origins outside."""
    scenes = []
    for number in range(10):
        occupied = some_map(rng)
        frac = rng.integers(0, 1 << 24, (2500, 2)) / (1 << 24)
        direction = unit(rng.uniform(-np.pi, np.pi, 2500))
        cell = some_cells(rng, occupied, 2500, beyond=0 if number % 2 else 6)
        limit = float(rng.choice([3.75, 20, 100]))
        scenes.append(Scene(occupied, cell, frac, direction, limit, number % 4 == 2))
    return scenes


def lattice_scenes(rng: np.random.Generator) -> list[Scene]:
    """Yield origins on edges and corners, and directions of small rational slope: many rays pass exactly through
    corners."""
    scenes = []
    for number in range(10):
        occupied = some_map(rng)
        most = 8 if number % 3 else 32
        direction = rng.integers(-most, most + 1, (2000, 2)) / most
        direction[(direction == 0).all(axis=1)] = (1, 0)
        frac = rng.choice(FRACTIONS, (2000, 2))
        cell = some_cells(rng, occupied, 2000, beyond=4 * (number % 2))
        scenes.append(Scene(occupied, cell, frac, direction, float(rng.choice([4, 7.5, 60])), number % 4 == 3))
    return scenes


def axis_scenes(rng: np.random.Generator) -> list[Scene]:
    """Yield rays along the axes, on and off edges, also with a direction component of -0."""
    scenes = []
    for number in range(6):
        occupied = some_map(rng)
        direction = np.array([(1, 0), (-1, 0), (0, 1), (0, -1), (1, -0.0), (-0.0, -1)])[rng.integers(0, 6, 2500)]
        frac = rng.choice([*FRACTIONS, 2.0**-24, 2.0**-140], (2500, 2))
        cell = some_cells(rng, occupied, 2500, beyond=5 * (number % 2))
        scenes.append(Scene(occupied, cell, frac, direction, float(rng.choice([2, 5.5, 60])), number == 3, False))
    return scenes


def diagonal_scenes(rng: np.random.Generator) -> list[Scene]:
    """Yield exactly 45 degrees and slopes of a power of two, in maps of walls that touch only at corners."""
    scenes = []
    for number in range(8):
        occupied = np.zeros((32, 32), bool)
        for _ in range(6):
            start, length = rng.integers(0, 24, 2), rng.integers(2, 9)
            for i in range(length):
                occupied[start[1] + (i if number % 2 else length - i), start[0] + i] = True
        occupied |= rng.random(occupied.shape) < 0.02
        speed = as_float32(rng.choice([1.0, 0.5, math.sqrt(0.5), 0.3, 2.0], 2500))
        slope = rng.choice([1.0, 1.0, 0.5, 2.0], 2500)
        direction = np.stack([speed, speed * slope], axis=1) * rng.choice([-1, 1], (2500, 2))
        frac = rng.choice([0.0, 0.5, 0.25, 0.75], (2500, 2))
        cell = some_cells(rng, occupied, 2500, beyond=3 * (number % 3))
        scenes.append(Scene(occupied, cell, frac, direction, 90.0, number == 3, False))
    return scenes


def tiny_component_scenes(rng: np.random.Generator) -> list[Scene]:
    """Yield direction components that are denormal, close to the smallest positive number, or merely small."""
    scenes = []
    sizes = as_float32(np.array([1e-45, 1e-40, 9e-31, 1.1e-30, 1e-20, 1e-8, 3e-7]))
    for number in range(4):
        occupied = some_map(rng)
        small = rng.choice(sizes, 2000) * rng.choice([-1, 1], 2000)
        large = rng.choice([-1.0, 1.0], 2000)
        direction = np.stack([large, small] if number % 2 else [small, large], axis=1)
        frac = rng.choice([*FRACTIONS, 2.0**-24, 2.0**-140], (2000, 2))
        cell = some_cells(rng, occupied, 2000, beyond=number)
        scenes.append(Scene(occupied, cell, frac, direction, 50.0))
    return scenes


def small_map_scenes(rng: np.random.Generator) -> list[Scene]:
    """Yield 1 x 1, 1 x N, N x 1, empty and full maps."""
    scenes = []
    for shape in ((1, 1), (1, 30), (30, 1), (12, 9)):
        for density in (0.0, 0.1, 1.0):
            for outside_occupied in (False, True):
                occupied = rng.random(shape) < density
                direction = unit(rng.integers(0, 16, 600) * (np.pi / 8))
                frac, cell = rng.choice(FRACTIONS, (600, 2)), some_cells(rng, occupied, 600, beyond=2)
                scenes.append(Scene(occupied, cell, frac, direction, 12.0, outside_occupied))
    return scenes


def limit_scenes(rng: np.random.Generator) -> list[Scene]:
    """Yield a wall exactly at the limit, one ulp of float32 before it and one behind it."""
    scenes = []
    occupied = np.zeros((20, 20), bool)
    occupied[:, 15] = occupied[15, :] = True
    for limit in (4.0, 4.5, 6.0, 12.0):
        for ulp in (-1, 0, 1):
            cell = rng.integers(2, 15, (400, 2))
            direction = np.array([(1.0, 0.0), (0.0, 1.0), (0.5, 0.5), (1.0, 0.25)])[rng.integers(0, 4, 400)]
            frac = rng.choice([0.0, 0.5], (400, 2))
            moved = float(np.nextafter(np.float32(limit), np.float32(limit + ulp)))
            scenes.append(Scene(occupied, cell, frac, direction, moved, False, False))
    return scenes


def corner_scenes(rng: np.random.Generator) -> list[Scene]:
    """Yield rays aimed at corners of cells, within a few ulp of float32."""
    scenes = []
    for number in range(6):
        occupied = some_map(rng, 0.08, 30)
        cell = some_cells(rng, occupied, 1500)
        frac = rng.integers(0, 1 << 24, (1500, 2)) / (1 << 24)
        corner = np.stack([rng.integers(0, n + 1, 1500) for n in occupied.shape[::-1]], axis=1)
        to = corner - cell - frac
        direction = as_float32(to / np.maximum(np.hypot(*to.T), 1e-6)[:, None])
        direction = direction * (1 + rng.integers(-2, 3, (1500, 2)) * 2.0**-24)
        scenes.append(Scene(occupied, cell, frac, as_float32(direction), 60.0, number == 5))
    return scenes


FAMILIES = {
    "random": random_scenes,
    "lattice": lattice_scenes,
    "axes": axis_scenes,
    "diagonals": diagonal_scenes,
    "tiny components": tiny_component_scenes,
    "small maps": small_map_scenes,
    "limits": limit_scenes,
    "corners": corner_scenes,
}


@functools.cache
def scenes_of(family: str) -> list[Scene]:
    return FAMILIES[family](np.random.default_rng([2005, *family.encode()]))
