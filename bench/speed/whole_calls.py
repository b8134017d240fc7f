"""Measure whole calls of the likelihood field beside numba's: NumPy arrays in and out, quantiles over all calls.

    python bench/speed/whole_calls.py --size 100 --output bench/results/whole_calls_name
    python bench/speed/whole_calls.py --load 2            # beside two processes that keep a processor busy each

Ways take turns of ``TURN`` calls in one run. "Launches alone" have their arrays on the device and a single wait.
numba's way is a table of log densities, parallel over particles (``score_logs`` of baselines.py), with the same float64
poses in and sums out; it finds cells without the low parts of poses.
"""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import Backend, get_backend

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import (
    Recorder,
    Scene,
    Way,
    add_scene,
    in_turns,
    make_parser,
    note,
    one_by_one,
    parse,
    publish,
    table,
    waited,
)
from speed import baselines

TURN = 20
QUANTILES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9)
COLUMNS = ("cloud", "way", *(f"{100 * q:g} %" for q in QUANTILES), "numba's median over this one's")
_BUSY = "while True: pass"


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """Keep a number of processes busy."""
    processes = [subprocess.Popen([sys.executable, "-c", _BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def numba_call(scene: Scene, scanner: gs.Scanner, ranges: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return numba's way to score poses, with the field's default parameters."""
    p = gs.LikelihoodFieldParameters()
    distance = np.minimum(gs.distance_transform(scene.grid.occupied, backend="numpy") * scene.grid.resolution,
                          p.max_distance)  # fmt: skip

    def log_density(d: np.ndarray) -> np.ndarray:
        peak = p.z_hit / (p.sigma_hit * np.sqrt(2 * np.pi))
        return np.log(peak * np.exp(-0.5 * (d / p.sigma_hit) ** 2) + p.z_rand / scanner.range_max)

    values, beyond = log_density(distance).astype(np.float32), float(log_density(np.float64(p.max_distance)))
    cells, turns = ranges / scene.grid.resolution, scanner.bearings
    points = cells[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    origin = np.array(scene.grid.origin)
    # Compiled anew: numba's cache on disk knows the module by the name that ``gpusense bench`` gives it.
    score = baselines.numba.njit(parallel=True)(baselines.score_logs.py_func)

    def run(poses: np.ndarray) -> np.ndarray:
        placed = poses - origin
        placed[:, :2] /= scene.grid.resolution
        return score(values, beyond, placed, points)

    return run


def ways_of(
    device: Backend, scene: Scene, scanner: gs.Scanner, ranges: np.ndarray, poses: np.ndarray
) -> dict[str, Way]:
    """Return the ways to score poses on a device."""
    model = gs.LikelihoodFieldModel(scene.grid, scanner, backend=device)
    recorder = Recorder(device)
    recorded = gs.LikelihoodFieldModel(scene.grid, scanner, backend=recorder)
    # The first call also makes the map's table.
    recorded.log_likelihood(poses, ranges)
    launches = recorder.launches_of(lambda: recorded.log_likelihood(poses, ranges))
    bound = model.bind(poses, ranges)
    ways = {
        "launches alone": Way(waited(device, one_by_one(launches))),
        "log_likelihood": Way(lambda _: model.log_likelihood(poses, ranges)),
        "bound": Way(lambda _: bound()),
    }
    if baselines.numba is None:
        note(f"numba is {baselines.NUMBA_MISSING}")
    else:
        other = numba_call(scene, scanner, ranges)
        error = float(np.abs(other(poses) - model.log_likelihood(poses, ranges)).max())
        note(f"{device.info.selection}: largest difference of numba's sums {error:.2g} nats")
        ways["numba"] = Way(lambda _: other(poses))
    return ways


def rows_of(selection: str, cloud: str, ways: dict[str, Way], arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure ways in turns and return a row for each."""
    with busy(arguments.load):
        times = dict(zip(ways, in_turns(list(ways.values()), arguments.calls, TURN), strict=True))
    medians = {way: float(np.median(taken)) for way, taken in times.items()}
    return [
        dict(
            backend=selection, cloud=cloud, way=way, ms=[float(1e3 * np.quantile(taken, q)) for q in QUANTILES],
            ratio=medians["numba"] / medians[way] if "numba" in medians else None,
        )
        for way, taken in times.items()
    ]  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Run the script."""
    parser = make_parser(__doc__, backend="kernels")
    add_scene(parser, 100.0)
    parser.add_argument("--particles", type=int, default=4096, help="particles of a call")
    parser.add_argument("--beams", type=int, default=360, help="beams of the scan")
    parser.add_argument("--calls", type=int, default=400, help="calls of each way")
    parser.add_argument("--load", type=int, default=0, help="busy processes beside the calls")
    arguments = parse(parser, argv)
    scene = Scene(arguments)
    scanner = scene.scanner(arguments.beams)
    ranges = scene.scan(scanner)
    rows = []
    for selection in arguments.backend:
        for cloud in ("tracking", "global"):
            poses = scene.cloud(cloud, arguments.particles).astype(np.float64)
            ways = ways_of(get_backend(selection), scene, scanner, ranges, poses)
            rows += rows_of(selection, cloud, ways, arguments)
    remark = (
        f"Milliseconds of {arguments.particles} x {arguments.beams}, quantiles of {arguments.calls} calls. "
        f"Scene: {scene.label}. Busy processes beside it: {arguments.load}."
    )
    lines = [
        (row["cloud"], f"{row['backend']} {row['way']}", *(f"{ms:.3f}" for ms in row["ms"]),
         "" if row["ratio"] is None else f"{row['ratio']:.2f}")
        for row in rows
    ]  # fmt: skip
    publish(__file__, arguments, table(COLUMNS, lines), dict(scene=scene.label, rows=rows), remark)
    return 0


if __name__ == "__main__":
    sys.exit(main())
