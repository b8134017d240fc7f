"""Fuzz rays: are float32 ranges the same bits on every device?

    python bench/accuracy/fuzz_rays.py --backend opencl --backend warp:cpu --rays 2000000 --output NAME

Every case has an awkward map, poses and bearings: sparse to dense maps of one cell to hundreds on a side, diagonal
walls, resolutions from 1 mm to 100 m, origins at 5e6 m with yaw, poses on edges and corners, in walls and off the map,
headings at exact multiples of 45 degrees and of 1e6 rad, both policies for the outside. Each device is compared with
float32 NumPy bit by bit. Exit code 1 where a bit differs.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import differing_bits, make_parser, parse, publish, table
from trees.cases import draw_grid, draw_poses


def main() -> int:
    """Fuzz the wanted number of rays."""
    parser = make_parser(__doc__, backend="kernels")
    parser.add_argument("--rays", type=int, default=2_000_000)
    arguments = parse(parser)
    backends = arguments.backend
    rng = np.random.default_rng(arguments.seed)
    cast = maps = nothing = 0
    differing = dict.fromkeys(backends, 0)
    while cast < arguments.rays:
        grid = draw_grid(rng)
        poses = draw_poses(rng, grid, 300, huge=0.1, out=1.0)
        bearings = np.concatenate([rng.uniform(-np.pi, np.pi, 36), np.arange(-4, 4) * (np.pi / 4)])
        range_max = grid.resolution * float(10 ** rng.uniform(0, 3.3))
        policy = {"outside": str(rng.choice(["free", "occupied"])), "unknown": str(rng.choice(["free", "occupied"]))}
        truth = gs.RayCaster(grid, range_max, backend="numpy", **policy).cast(poses, bearings)
        for backend in backends:
            ranges = gs.RayCaster(grid, range_max, backend=backend, **policy).cast(poses, bearings)
            differing[backend] += differing_bits(ranges, truth)
        cast, maps = cast + truth.size, maps + 1
        nothing += int(np.count_nonzero(truth == np.float32(range_max)))
    infos = {backend: get_backend(backend).info for backend in backends}
    rows = [
        {"backend": info.selection, "device": info.name, "driver": info.driver, "differing_rays": differing[backend]}
        for backend, info in infos.items()
    ]
    report = {"rays": cast, "maps": maps, "rays_without_obstacle": nothing, "rows": rows}
    text = table(("backend", "device", "driver", "rays with other bits"), (row.values() for row in rows))
    remark = f"{cast} rays in {maps} maps, {nothing} of them without an obstacle."
    publish(__file__, arguments, text, report, remark)
    return int(any(differing.values()))


if __name__ == "__main__":
    sys.exit(main())
