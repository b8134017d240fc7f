"""Draw awkward worlds, poses and readings."""

from __future__ import annotations

import dataclasses
import sys
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import gpusense as gs

Outcome = Iterator[tuple[str, Any]]

# Particle-beams of an ordinary case.
ORDINARY = 40_000


@dataclasses.dataclass
class World:
    """A map, a scanner, and its scan at one pose."""

    grid: gs.OccupancyGrid
    scanner: gs.Scanner
    pose: np.ndarray
    truth: np.ndarray


@dataclasses.dataclass
class Device:
    """Hold a device: its backend, a function that copies an array to it, and one that overwrites an array there."""

    backend: Any
    there: Callable[[np.ndarray], Any] | None
    change: Callable[[Any, np.ndarray], None] | None
    gpu: bool


@dataclasses.dataclass
class Case:
    """Hold the arguments of an action."""

    rng: np.random.Generator
    device: Device
    config: dict[str, Any]
    world: World
    models: list[Any]

    @property
    def model(self) -> Any:
        """Return the first model."""
        return self.models[0]


def draw_grid(rng: np.random.Generator, most: float = 2.7, resolutions: tuple[float, ...] = ()) -> gs.OccupancyGrid:
    """Draw an awkward map of up to 10 ** most cells on a side."""
    rows, cols = (int(n) for n in np.ceil(10 ** rng.uniform(0, most, 2)))
    density = rng.choice([0.0, 0.002, 0.02, 0.2, 0.7, 1.0], p=[0.05, 0.3, 0.3, 0.2, 0.1, 0.05])
    cells = np.where(rng.random((rows, cols)) < density, 100, 0)
    cells[rng.random((rows, cols)) < 0.02] = -1
    if rng.random() < 0.5:
        wall = np.arange(min(rows, cols))
        cells[wall, wall if rng.random() < 0.5 else cols - 1 - wall] = 100
    resolution = float(rng.choice(resolutions or [1e-3, 0.05, 0.1, 1.0, 100.0]))
    far = rng.random() < 0.3
    origin = (*rng.uniform(-5e6, 5e6, 2), rng.uniform(-3, 3)) if far else (0.0, 0.0, float(rng.choice([0.0, 0.7])))
    return gs.OccupancyGrid(cells, resolution, origin)


def in_world(grid: gs.OccupancyGrid, col: np.ndarray, row: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Move poses from cells of a map to the world."""
    cos, sin = np.cos(grid.origin[2]), np.sin(grid.origin[2])
    x, y = col * grid.resolution, row * grid.resolution
    return np.stack([grid.origin[0] + cos * x - sin * y, grid.origin[1] + sin * x + cos * y, theta], axis=-1)


def draw_poses(rng: np.random.Generator, grid: gs.OccupancyGrid, count: int, huge: float, out: float) -> np.ndarray:
    """Draw poses in the map, on its edges and around it; some headings are of many turns."""
    rows, cols = grid.shape
    reach = out * (0.3 * np.array([cols, rows]) + 2)
    col, row = rng.uniform(-reach[0], cols + reach[0], count), rng.uniform(-reach[1], rows + reach[1], count)
    on_edge = rng.random((2, count)) < 0.25
    col, row = np.where(on_edge[0], np.rint(col), col), np.where(on_edge[1], np.rint(row), row)
    theta = rng.uniform(-np.pi, np.pi, count)
    theta = np.where(rng.random(count) < 0.25, np.rint(theta / (np.pi / 4)) * (np.pi / 4), theta)
    theta = np.where(rng.random(count) < huge, theta + 1e6, theta)
    return in_world(grid, col, row, theta)


def draw_cloud(case: Case, count: int) -> np.ndarray:
    """Draw poses around the true one, all over and beyond the map, or within it."""
    rng, world = case.rng, case.world
    huge = 0.1 * case.config.get("huge", 0)
    way = rng.choice(3, p=[0.5, 0.3, 0.2])
    if way == 0:
        spread = world.grid.resolution * 10 ** rng.uniform(-2, 1)
        cloud = world.pose + rng.standard_normal((count, 3)) * [spread, spread, 0.05]
        cloud[:, 2] += np.where(rng.random(count) < huge, 1e6, 0.0)
        return cloud
    return draw_poses(rng, world.grid, count, huge, float(way == 1))


def draw_scanner(rng: np.random.Generator, grid: gs.OccupancyGrid, wanted: dict[str, Any]) -> gs.Scanner:
    """Draw a scanner of up to 400 beams, except for the attributes in ``wanted``."""
    options = dict(wanted)
    few = int(10 ** rng.uniform(0, 2.6))
    count = int(rng.choice([few, 0, 1, 17, 64, 65, 129, 181, 400], p=[0.65, 0.01, 0.04, *[0.05] * 6]))
    step = rng.choice([2 * np.pi / max(count, 1), 0.0174, np.pi / 4 * 1e-2])
    bearings = rng.uniform(-np.pi, np.pi) + np.arange(count) * step
    if rng.random() < 0.2:
        bearings = rng.uniform(-np.pi, np.pi, count)
    if options.pop("repeat", False):
        bearings = bearings[rng.integers(max(count // 3, 1), size=count)]
    elif rng.random() < 0.1:
        bearings = np.arange(count) * (np.pi / 4)
    range_max = options.pop("range_max", grid.resolution * float(10 ** rng.uniform(0.3, 2.5)))
    range_min = range_max * options.pop("nearest", 0.0)
    mount = tuple(grid.resolution * 5 * np.array(options.pop("mount"))) if "mount" in options else (0.0, 0.0, 0.0)
    turned = (*mount[:2], mount[2] / grid.resolution / 5)
    return gs.Scanner(bearings, range_max, range_min, turned, **options)


def walk(grid: gs.OccupancyGrid, scanner: gs.Scanner, pose: np.ndarray) -> np.ndarray:
    """Estimate a scan by steps of a quarter of a cell, without the package's code."""
    x, y, turn = scanner.mount
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = pose[0] + cos * x - sin * y - grid.origin[0], pose[1] + sin * x + cos * y - grid.origin[1]
    cos, sin = np.cos(grid.origin[2]), np.sin(grid.origin[2])
    col, row = (cos * dx + sin * dy) / grid.resolution, (cos * dy - sin * dx) / grid.resolution
    angle = pose[2] + turn + scanner.bearings[:, None] - grid.origin[2]
    steps = np.arange(0, min(scanner.range_max / grid.resolution, sum(grid.shape)), 0.25)
    cols, rows = (np.floor(col + steps * np.cos(angle)), np.floor(row + steps * np.sin(angle)))
    inside = (cols >= 0) & (cols < grid.shape[1]) & (rows >= 0) & (rows < grid.shape[0])
    at = np.where(inside, rows, 0).astype(int), np.where(inside, cols, 0).astype(int)
    met = inside & (grid.cells[at] >= 65)
    return np.where(met.any(axis=1), steps[np.argmax(met, axis=1)] * grid.resolution, scanner.range_max)


def draw_world(rng: np.random.Generator, config: dict[str, Any]) -> World:
    """Draw a map, a scanner and its pose."""
    grid = draw_grid(rng, config.get("most", 2.0), config.get("resolutions", (0.05, 0.05, 0.1, 0.1, 1.0, 1e-3)))
    scanner = draw_scanner(rng, grid, config.get("scanner", {}))
    rows, cols = grid.shape
    where = rng.uniform(0, cols, 1), rng.uniform(0, rows, 1), rng.uniform(-np.pi, np.pi, 1)
    pose = in_world(grid, *where)[0]
    return World(grid, scanner, pose, walk(grid, scanner, pose))


def draw_readings(rng: np.random.Generator, world: World, scans: int | None = None) -> np.ndarray:
    """Draw one or several scans: true ranges, random ones, and special readings."""
    top, shape = world.scanner.range_max, (*(() if scans is None else (scans,)), world.scanner.count)
    z = world.truth + rng.standard_normal(shape) * world.grid.resolution * rng.choice([1e-3, 0.5, 2.0])
    z = np.where(rng.random(shape) < 0.1, rng.uniform(0, top, shape), z)
    near = (top * (1 - 1e-9), float(np.nextafter(top, 0)), float(np.float32(top)), world.scanner.range_min)
    special = np.array([np.nan, np.inf, -np.inf, 0.0, top, 2 * top, -1.0, *near])
    often = rng.choice([0.05, 0.5, 1.0], p=[0.92, 0.06, 0.02])
    z = np.where(rng.random(shape) < often, special[rng.integers(len(special), size=shape)], z)
    if rng.random() < 0.03:
        z[...] = special[rng.integers(5)]
    return z.astype(np.float32) if rng.random() < 0.25 else z


def draw_count(case: Case) -> int:
    """Draw the number of particles: none to a few thousand, at times more than a launch of several scans can take."""
    rng, rays = case.rng, max(case.world.scanner.count * case.world.scanner.cone_rays, 1)
    if rng.random() < 0.01:
        return 0
    if rng.random() < 0.003 and "slow" not in case.config:
        return (1 << 20) // rays % 6000 + 1
    return max(min(int(10 ** rng.uniform(0, 3.6)), ORDINARY // rays), 1)


def seeds(seed: int, name: str, *numbers: int) -> np.random.Generator:
    """Return the seeds of a case or a round."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), *numbers])


def pyopencl_device(info: Any) -> Device | None:
    """Return a device with a user's queue and pyopencl's arrays; None without pyopencl."""
    try:
        import pyopencl as cl
        import pyopencl.array
    except ImportError:
        print("pyopencl is not here: no arrays on the device", file=sys.stderr)
        return None
    wanted, listed = (info.name, info.driver), [each for own in cl.get_platforms() for each in own.get_devices()]
    named = [(each.name.strip(), f"{each.platform.name.strip()} {each.driver_version.strip()}") for each in listed]
    found = [device for device, name in zip(listed, named, strict=True) if name == wanted]
    if not found:
        print(f"pyopencl does not show {info.name}: no arrays on the device", file=sys.stderr)
        return None
    queue = cl.CommandQueue(cl.Context(found[:1]))

    def there(array: np.ndarray) -> Any:
        return cl.array.to_device(queue, np.ascontiguousarray(array))

    return Device(queue, there, lambda own, new: own.set(np.ascontiguousarray(new)), info.kind == "gpu")


def warp_device(selection: str, info: Any) -> Device | None:
    """Return a device with Warp's arrays; None without Warp."""
    try:
        import warp as wp
    except ImportError:
        print("warp is not here: no arrays on the device", file=sys.stderr)
        return None
    where = info.selection.partition(":")[2]

    def there(array: np.ndarray) -> Any:
        kind = wp.float32 if array.dtype == np.float32 else wp.float64
        return wp.array(np.ascontiguousarray(array), dtype=kind, device=where)

    return Device(selection, there, lambda own, new: own.assign(np.ascontiguousarray(new)), info.kind == "gpu")


def devices_of(selection: str, as_gpu: bool) -> tuple[Device, Device, Any]:
    """Return the device of most cases, the device for cases with device arrays, and its description."""
    info = gs.RayCaster(gs.OccupancyGrid([[0]]), 1.0, backend=selection).device
    there = None
    if info.backend == "opencl":
        there = pyopencl_device(info)
    elif info.backend == "warp":
        there = warp_device(selection, info)
    plain = Device(selection, None, None, info.kind == "gpu")
    if as_gpu:
        from gpusense.backends import get_backend

        for device in [plain, *([there] if there else [])]:
            device.backend = get_backend(device.backend)
            device.backend.info = dataclasses.replace(device.backend.info, kind="gpu", lanes=1)
    return plain, there or plain, info
