"""Compare rays in many worlds at once with rays in one map; measure moving shapes and replaced worlds.

    python bench/speed/worlds.py --backend opencl --worlds 64,1024
    python bench/speed/worlds.py --backend warp:cuda:0 --worlds 256,1024,4096,8192 --shapes 64 --kernels

Every world is a room of 256 x 256 cells with boxes in it, each with 16 robots of 360 beams. A single map has as many
robots as the largest number of worlds, and either the size of a room or as many cells as all rooms, up to 4096 x 4096.
Rates are of whole calls with poses and indices in host memory, on CUDA on the device. --kernels adds the time of each
launch by the device's clock, and --tiles casts rays of worlds in tiles of poses and rays, as rays of one map.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.models.scan import tiles

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import Recorder, add_repeats, make_parser, note, parse, publish, table
from launches import least_by_events

SIDE, ROBOTS, RESOLUTION, RANGE_MAX = 256, 16, 0.05, 10.0
BEARINGS = np.linspace(-np.pi, np.pi, 360, endpoint=False)
COLUMNS = (
    "worlds",
    "shapes",
    "M rays/s",
    "of one room",
    "of one map",
    "made [ms]",
    "replaced [ms]",
    "bytes a cell",
    "launches",
)


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


def rate_of_one(backend: Any, side: int, worlds: int, repeats: int, seconds: float) -> float:
    """Return the rate of the robots of some worlds in a single map [rays/s]."""
    rng = np.random.default_rng(0)
    caster = gs.RayCaster(gs.OccupancyGrid(rooms(1, rng, side)[0], RESOLUTION), RANGE_MAX, backend=backend)
    (poses,) = on_device(backend, poses_in(worlds, rng, side))
    rate = len(poses) * len(BEARINGS) / least(lambda: caster.cast(poses, BEARINGS), backend, repeats, seconds)
    note(f"one map of {side} x {side}: {rate / 1e6:.0f} M rays/s")
    return rate


def timed(recorder: Any, run: Callable[[], Any]) -> str:
    """Return the least time of each launch of a call by the device's clock, where a recorder records launches."""
    if not isinstance(recorder, Recorder):
        return ""
    each = least_by_events(recorder.watched, recorder.launches_of(run), 5)
    return "; ".join(f"{name} {seconds * 1e6:.0f} us" for name, seconds in each)


def measure(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure single maps, then each number of worlds."""
    backend, rng, rows = get_backend(arguments.backend), np.random.default_rng(0), []
    numbers = [int(number) for number in arguments.worlds.split(",")]
    repeats, seconds, few = arguments.repeats, arguments.seconds, min(max(numbers), 4096)
    room = rate_of_one(backend, SIDE, few, repeats, seconds)
    one = rate_of_one(backend, min(SIDE * int(np.sqrt(max(numbers))), 4096), few, repeats, seconds)
    for count in numbers:
        recorder = Recorder(backend) if arguments.kernels else backend
        kinds = rooms(min(count, 256), rng)
        cells = np.resize(kinds, (count, SIDE, SIDE))
        begin = time.perf_counter()
        worlds = gs.Worlds(cells, RESOLUTION, backend=recorder)
        caster = gs.RayCaster(worlds, RANGE_MAX, backend=recorder)
        index = np.arange(count, dtype=np.int32).repeat(ROBOTS)
        poses, where = on_device(backend, poses_in(count, rng), index)
        (new,), changed = on_device(backend, kinds), np.arange(len(kinds))

        def cast(caster: Any = caster, poses: Any = poses, where: Any = where) -> None:
            caster.cast(poses, BEARINGS, world=where)

        def replace(worlds: Any = worlds, new: Any = new, changed: Any = changed) -> None:
            worlds.replace(changed, new)

        cast()
        backend.synchronize()
        made, rays = time.perf_counter() - begin, count * ROBOTS * len(BEARINGS)
        for shapes in sorted({0, arguments.shapes}):
            if shapes:
                worlds.shapes = shapes_of(count, shapes, rng)
            rate, replaced = rays / least(cast, backend, repeats, seconds), least(replace, backend, repeats, seconds)
            rows.append(dict(
                worlds=count, shapes=shapes, rate=rate, of_room=rate / room, of_map=rate / one, made=made,
                replaced=replaced, bytes=worlds.nbytes / (count * SIDE * SIDE),
                launches="; ".join(timed(recorder, run) for run in (cast, replace)),
            ))  # fmt: skip
            note(" | ".join(line_of(rows[-1])))
        del worlds, caster, cast, replace
    return rows


def line_of(row: dict[str, Any]) -> list[str]:
    """Return the cells of a row."""
    return [
        str(row["worlds"]), str(row["shapes"]), f"{row['rate'] / 1e6:.0f}", f"{row['of_room']:.2f}",
        f"{row['of_map']:.2f}", f"{1e3 * row['made']:.2f}", f"{1e3 * row['replaced']:.2f}", f"{row['bytes']:.1f}",
        row["launches"],
    ]  # fmt: skip


def main(argv: list[str] | None = None) -> None:
    """Measure, and write the results."""
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--worlds", default="64,1024", help="numbers of worlds, with commas (default: 64,1024)")
    parser.add_argument("--shapes", type=int, default=0, help="moving shapes of each world (default: 0)")
    parser.add_argument("--kernels", action="store_true", help="measure each launch by the device's clock")
    parser.add_argument("--tiles", action="store_true", help="cast rays of worlds in tiles of poses and rays")
    add_repeats(parser, 20, 5.0)
    arguments = parse(parser, argv)
    if arguments.tiles:
        tiles.LEAST_OF_ONE_POSE = len(BEARINGS) + 1
    rows = measure(arguments)
    publish(__file__, arguments, table(COLUMNS, map(line_of, rows)), {"rows": rows})


if __name__ == "__main__":
    main()
