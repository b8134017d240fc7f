"""Compare rays in many worlds at once with rays in one map; measure moving shapes and replaced worlds.

    python bench/speed/worlds.py --backend opencl --worlds 64,1024
    python bench/speed/worlds.py --backend warp:cuda:0 --worlds 256,1024,4096,8192 --shapes 64

Every world is a room of 256 x 256 cells with boxes in it, each with 16 robots of 360 beams. One map has as many robots
and as many cells as the largest number of worlds, up to 4096 x 4096. Rates are of whole calls with poses and indices in
host memory, on CUDA on the device.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import add_repeats, make_parser, note, parse, publish, table

SIDE, ROBOTS, RESOLUTION, RANGE_MAX = 256, 16, 0.05, 10.0
BEARINGS = np.linspace(-np.pi, np.pi, 360, endpoint=False)
COLUMNS = ("worlds", "shapes", "M rays/s", "of one map", "made [ms]", "replaced [ms]", "bytes a cell")


def rooms(count: int, rng: np.random.Generator, side: int = SIDE) -> np.ndarray:
    """Return cells of rooms with a wall around them and boxes in them."""
    cells = np.zeros((count, side, side), np.int8)
    cells[:, [0, -1]] = cells[:, :, [0, -1]] = 100
    for _ in range(12 * (side // SIDE) ** 2):
        row, col = rng.integers(4, side - 24, (2, count))
        height, width = rng.integers(3, 20, (2, count))
        for w in range(count):
            cells[w, row[w] : row[w] + height[w], col[w] : col[w] + width[w]] = 100
    return cells


def poses_in(worlds: int, rng: np.random.Generator, side: int = SIDE) -> np.ndarray:
    """Return poses of the robots of all worlds."""
    count = worlds * ROBOTS
    return np.column_stack([rng.uniform(1, side * RESOLUTION - 1, (count, 2)), rng.uniform(-3, 3, count)])


def least(run: Callable[[], Any], backend: Any, repeats: int, seconds: float) -> float:
    """Return the least time of a call that has ended [s]."""
    run()
    backend.synchronize()
    best, begin = float("inf"), time.perf_counter()
    for _ in range(repeats):
        before = time.perf_counter()
        run()
        backend.synchronize()
        best = min(best, time.perf_counter() - before)
        if time.perf_counter() - begin > seconds:
            break
    return best


def on_device(backend: Any, *arrays: np.ndarray) -> list[Any]:
    """Return arrays on the device where PyTorch has it, else unchanged."""
    if not backend.info.selection.startswith("warp:cuda"):
        return list(arrays)
    try:
        import torch
    except ImportError:
        import warp as wp

        return [wp.array(array, device=backend.info.selection.removeprefix("warp:")) for array in arrays]
    return [torch.from_numpy(array).to(backend.info.selection.removeprefix("warp:")) for array in arrays]


def shapes_of(worlds: int, count: int, rng: np.random.Generator) -> gs.Shapes:
    """Return discs, boxes and segments in equal numbers."""
    each = count // 4
    extent = SIDE * RESOLUTION
    discs = np.concatenate([rng.uniform(0, extent, (worlds, 2 * each, 2)), np.full((worlds, 2 * each, 1), 0.2)], axis=2)
    boxes = np.concatenate([rng.uniform(0, extent, (worlds, each, 3)), np.full((worlds, each, 2), 0.4)], axis=2)
    begin = rng.uniform(0, extent, (worlds, each, 2))
    return gs.Shapes(discs=discs, boxes=boxes, segments=np.concatenate([begin, begin + 0.5], axis=2))


def measure(name: str, numbers: list[int], shapes: int, repeats: int, seconds: float) -> list[dict[str, Any]]:
    """Measure one map, then each number of worlds."""
    backend, rng, rows = get_backend(name), np.random.default_rng(0), []
    most = max(numbers)
    side = min(SIDE * int(np.sqrt(most)), 4096)
    few = min(most, 4096)
    grid = gs.OccupancyGrid(rooms(1, rng, side)[0], RESOLUTION)
    caster = gs.RayCaster(grid, RANGE_MAX, backend=backend)
    (poses,) = on_device(backend, poses_in(few, rng, side))
    one = len(poses) * len(BEARINGS) / least(lambda: caster.cast(poses, BEARINGS), backend, repeats, seconds)
    rows.append(dict(worlds=1, shapes=0, rate=one, ratio=1.0, made=None, replaced=None, bytes=None))
    note(f"one map of {side} x {side}: {one / 1e6:.0f} M rays/s")
    for count in numbers:
        kinds = rooms(min(count, 256), rng)
        cells = np.resize(kinds, (count, SIDE, SIDE))
        begin = time.perf_counter()
        worlds = gs.Worlds(cells, RESOLUTION, backend=backend)
        in_worlds = gs.RayCaster(worlds, RANGE_MAX, backend=backend)
        index = np.arange(count, dtype=np.int32).repeat(ROBOTS)
        poses, where = on_device(backend, poses_in(count, rng), index)
        in_worlds.cast(poses, BEARINGS, world=where)
        backend.synchronize()
        made = time.perf_counter() - begin
        rays = count * ROBOTS * len(BEARINGS)

        def cast(caster: Any = in_worlds, poses: Any = poses, where: Any = where) -> None:
            caster.cast(poses, BEARINGS, world=where)

        rate = rays / least(cast, backend, repeats, seconds)
        changed = np.arange(min(256, count))
        (new,) = on_device(backend, kinds[: len(changed)])
        replaced = least(lambda w=worlds, c=changed, n=new: w.replace(c, n), backend, repeats, seconds)
        row = dict(worlds=count, shapes=0, rate=rate, ratio=rate / one, made=made, replaced=replaced,
                   bytes=worlds.nbytes / (count * SIDE * SIDE))  # fmt: skip
        rows.append(row)
        note(f"{count} worlds: {rate / 1e6:.0f} M rays/s, {row['ratio']:.2f} of one map, {1e3 * replaced:.2f} ms")
        if shapes:
            worlds.shapes = shapes_of(count, shapes, rng)
            with_shapes = rays / least(cast, backend, repeats, seconds)
            rows.append({**row, "shapes": shapes, "rate": with_shapes, "ratio": with_shapes / one})
            note(f"{count} worlds, {shapes} shapes each: {with_shapes / 1e6:.0f} M rays/s, {rate / with_shapes:.2f} x")
        del worlds, in_worlds, cast
    return rows


def main(argv: list[str] | None = None) -> None:
    """Measure, and write the results."""
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--worlds", default="64,1024", help="numbers of worlds, with commas (default: 64,1024)")
    parser.add_argument("--shapes", type=int, default=0, help="moving shapes of each world (default: 0)")
    add_repeats(parser, 20, 5.0)
    arguments = parse(parser, argv)
    numbers = [int(number) for number in arguments.worlds.split(",")]
    rows = measure(arguments.backend, numbers, arguments.shapes, arguments.repeats, arguments.seconds)
    lines = [
        (
            row["worlds"], row["shapes"], f"{row['rate'] / 1e6:.0f}", f"{row['ratio']:.2f}",
            *(f"{1e3 * row[key]:.2f}" if row[key] is not None else "" for key in ("made", "replaced")),
            f"{row['bytes']:.1f}" if row["bytes"] is not None else "",
        )
        for row in rows
    ]  # fmt: skip
    publish(__file__, arguments, table(COLUMNS, lines), {"rows": rows})


if __name__ == "__main__":
    main()
