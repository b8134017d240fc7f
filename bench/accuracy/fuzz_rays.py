"""Fuzzed rays: are float32 ranges the same bits on every device?

    python bench/fuzz_rays.py --backend opencl --backend warp:cpu --rays 2000000 --output bench/results/fuzz_rays_cpu

Every case is a map, poses and bearings drawn to be awkward: sparse to dense maps of one cell to hundreds on a side,
diagonal walls, resolutions from 1 mm to 100 m, origins at 5e6 m with yaw, poses on edges and corners, in walls and off
the map, headings of multiples of 45 degrees to the last bit and of 1e6 rad, both policies for what lies outside. Each
device is compared with float32 NumPy bit by bit. Exit code 1 where a bit differs.
"""

from __future__ import annotations

import argparse
import json
import platform
import shlex
import sys
import time
from pathlib import Path

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend


def draw_grid(rng: np.random.Generator) -> gs.OccupancyGrid:
    """A map to trip over."""
    rows, cols = (int(n) for n in np.ceil(10 ** rng.uniform(0, 2.7, 2)))
    density = rng.choice([0.0, 0.002, 0.02, 0.2, 0.7, 1.0], p=[0.05, 0.3, 0.3, 0.2, 0.1, 0.05])
    cells = np.where(rng.random((rows, cols)) < density, 100, 0)
    cells[rng.random((rows, cols)) < 0.02] = -1
    if rng.random() < 0.5:
        wall = np.arange(min(rows, cols))
        cells[wall, wall if rng.random() < 0.5 else cols - 1 - wall] = 100
    resolution = float(rng.choice([1e-3, 0.05, 0.1, 1.0, 100.0]))
    far = rng.random() < 0.3
    origin = (*rng.uniform(-5e6, 5e6, 2), rng.uniform(-3, 3)) if far else (0.0, 0.0, float(rng.choice([0.0, 0.7])))
    return gs.OccupancyGrid(cells, resolution, origin)


def draw_poses(rng: np.random.Generator, grid: gs.OccupancyGrid, count: int) -> np.ndarray:
    """Poses in, on the edges of, and around the map."""
    rows, cols = grid.shape
    col, row = rng.uniform(-0.3 * cols - 2, 1.3 * cols + 2, count), rng.uniform(-0.3 * rows - 2, 1.3 * rows + 2, count)
    on_edge = rng.random((2, count)) < 0.25
    col, row = np.where(on_edge[0], np.rint(col), col), np.where(on_edge[1], np.rint(row), row)
    cos, sin = np.cos(grid.origin[2]), np.sin(grid.origin[2])
    x, y = col * grid.resolution, row * grid.resolution
    theta = rng.uniform(-np.pi, np.pi, count)
    theta = np.where(rng.random(count) < 0.25, np.rint(theta / (np.pi / 4)) * (np.pi / 4), theta)
    theta = np.where(rng.random(count) < 0.1, theta + 1e6, theta)
    return np.stack([grid.origin[0] + cos * x - sin * y, grid.origin[1] + sin * x + cos * y, theta], axis=1)


def main() -> int:
    """Fuzz until enough rays are cast."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", help="selection string; default: every device present")
    parser.add_argument("--rays", type=int, default=2_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="path without ending for the .json file")
    arguments = parser.parse_args()
    present = [d.selection for d in gs.devices() if d.available and d.kind != "simulator" and d.backend != "numpy"]
    backends = arguments.backend or present
    rng = np.random.default_rng(arguments.seed)
    cast = maps = nothing = 0
    differing = dict.fromkeys(backends, 0)
    while cast < arguments.rays:
        grid = draw_grid(rng)
        poses = draw_poses(rng, grid, 300)
        bearings = np.concatenate([rng.uniform(-np.pi, np.pi, 36), np.arange(-4, 4) * (np.pi / 4)])
        range_max = grid.resolution * float(10 ** rng.uniform(0, 3.3))
        policy = {"outside": str(rng.choice(["free", "occupied"])), "unknown": str(rng.choice(["free", "occupied"]))}
        truth = gs.RayCaster(grid, range_max, backend="numpy", **policy).cast(poses, bearings)
        for backend in backends:
            ranges = gs.RayCaster(grid, range_max, backend=backend, **policy).cast(poses, bearings)
            differing[backend] += int(np.count_nonzero(ranges.view(np.uint32) != truth.view(np.uint32)))
        cast, maps = cast + truth.size, maps + 1
        nothing += int(np.count_nonzero(truth == np.float32(range_max)))
    names = {backend: get_backend(backend).info for backend in backends}
    report = {
        "command": shlex.join(["python", "bench/fuzz_rays.py", *sys.argv[1:]]), "date": time.strftime("%Y-%m-%d"),
        "platform": platform.platform(terse=True), "numpy": np.__version__, "rays": cast, "maps": maps,
        "rays_without_obstacle": nothing,
        "differing_bits_from_numpy_float32": {
            b: {"device": names[b].name, "driver": names[b].driver, "rays": differing[b]} for b in backends
        },
    }  # fmt: skip
    print(json.dumps(report, indent=1))
    if arguments.output:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.with_suffix(".json").write_text(json.dumps(report, indent=1) + "\n")
    return int(any(differing.values()))


if __name__ == "__main__":
    sys.exit(main())
