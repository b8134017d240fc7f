"""How long a map's preparation takes, step by step, and what an edit of 50 x 50 cells costs against it.

    python bench/preparation.py --backend opencl --backend warp:cpu --cells 2000

For each backend and map: distances without and with a cap of 40 cells, empty rectangles for 1, 2 and 4 sectors, and a
model's preparation of the whole map, each as the best and the median of several runs; then where the time goes (every
upload, allocation and kernel waits for the device, so their sum is more than the whole); then ``update_map`` against a
new model, whose log-likelihoods must be the same. Distances must be SciPy's. Exit code 1 where anything differs.
"""

from __future__ import annotations

import argparse
import functools
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import Backend, get_backend
from gpusense.evaluation.selftest import scipy_squares
from gpusense.evaluation.worlds import building
from gpusense.tables.cells import packed
from gpusense.tables.distances import squared_distances
from gpusense.tables.rectangles import empty_rectangles

RESOLUTION, CAP, EDIT = 0.05, 1601, 50
SCANNER = gs.Scanner(np.linspace(-2, 2, 60), 10.0)
MODELS = {"beam model": gs.BeamModel, "field": gs.LikelihoodFieldModel}


class Waiting:
    """A backend that waits after every step and notes what it took."""

    def __init__(self, backend: Backend) -> None:
        self.backend, self.info, self.spent = backend, backend.info, defaultdict[str, float](float)

    def timed(self, name: str, step: Callable[..., Any]) -> Callable[..., Any]:
        """The step, with its seconds added to those of the name."""

        def run(*arguments: Any, **named: Any) -> Any:
            self.backend.synchronize()
            begin = time.perf_counter()
            result = step(*arguments, **named)
            self.backend.synchronize()
            self.spent[name] += time.perf_counter() - begin
            return result

        return run

    def __getattr__(self, name: str) -> Any:
        step = getattr(self.backend, name)
        if name == "compile":
            return lambda kernel, flags: self.timed(kernel, step(kernel, flags))
        return self.timed(name, step) if name in ("upload", "empty") else step


def maps(size: int) -> dict[str, np.ndarray]:
    """Cells of an ordinary map, and of those that are hard on a search."""
    metres = size * RESOLUTION
    line = np.arange(size)
    empty = np.zeros((size, size), np.int8)
    one, diagonal = empty.copy(), empty.copy()
    one[3, 5] = diagonal[line, size - 1 - line] = 100
    sparse = np.where(np.random.default_rng(0).random(empty.shape) < 2e-5, np.int8(100), np.int8(0))
    rooms = building(0, (metres, metres), RESOLUTION).cells
    return {"building": rooms, "empty": empty, "one obstacle": one, "diagonal": diagonal, "sparse": sparse}


def times(step: Callable[[], Any], repeats: int) -> str:
    """Best and median milliseconds after one run that does not count."""
    step()
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        step()
        taken.append(1e3 * (time.perf_counter() - begin))
    return f"{min(taken):8.2f} {statistics.median(taken):8.2f}"


def whole(kind: type[Any], grid: gs.OccupancyGrid, backend: Any) -> Any:
    """A model that has prepared all of its map."""
    model = kind(grid, SCANNER, backend=backend, specialize=False)
    model.prepare(np.zeros((1, 3)))
    return model


def time_map(backend: Backend, name: str, cells: np.ndarray, repeats: int) -> bool:
    """Print the times of a map; whether its distances are exact."""
    grid = gs.OccupancyGrid(cells, RESOLUTION)
    obstacles = grid.obstacles()
    steps: dict[str, Callable[[], Any]] = {
        "bits on the host": lambda: packed(obstacles),
        "distances": lambda: squared_distances(backend, obstacles),
        "distances to 40 cells": lambda: squared_distances(backend, obstacles, CAP),
    }
    steps |= {
        f"rectangles, sectors: {n}": functools.partial(empty_rectangles, backend, obstacles, n) for n in (1, 2, 4)
    }
    steps |= {f"{key}, whole": functools.partial(whole, kind, grid, backend) for key, kind in MODELS.items()}
    for step, run in steps.items():
        print(f"{backend.info.selection:12} {name:14} {step:24} {times(run, repeats)} ms")
    found = backend.download(squared_distances(backend, obstacles), np.empty(cells.shape, np.int32))
    exact = np.full(cells.shape, np.iinfo(np.int32).max) if not obstacles.any() else scipy_squares(obstacles)
    return bool((found == exact).all())


def time_steps(backend: Backend, cells: np.ndarray) -> None:
    """Print where the time goes."""
    grid = gs.OccupancyGrid(cells, RESOLUTION)
    for key, kind in MODELS.items():
        whole(kind, grid, backend)
        waiting = Waiting(backend)
        whole(kind, grid, waiting)
        spent = ", ".join(f"{step} {1e3 * taken:.2f}" for step, taken in waiting.spent.items())
        print(f"{backend.info.selection:12} {key}: {spent} ms")


def time_edits(backend: Backend, cells: np.ndarray, repeats: int) -> bool:
    """Print the times of edits; whether edited models say what new ones do."""
    rng, same = np.random.default_rng(1), True
    size = len(cells)
    poses = rng.uniform((0, 0, -3), (size * RESOLUTION, size * RESOLUTION, 3), (200, 3))
    ranges = rng.uniform(0, 10, SCANNER.count)
    for key, kind in MODELS.items():
        model = whole(kind, gs.OccupancyGrid(cells, RESOLUTION), backend)
        edits, rebuilds = [], []
        for _ in range(repeats):
            patch = np.where(rng.random((EDIT, EDIT)) < 0.05, 100, 0)
            place = rng.integers(0, size - EDIT, 2)
            begin = time.perf_counter()
            model.update_map(patch, place)
            middle = time.perf_counter()
            anew = whole(kind, model.grid, backend)
            edits.append(1e3 * (middle - begin))
            rebuilds.append(1e3 * (time.perf_counter() - middle))
            same &= bool((model.log_likelihood(poses, ranges) == anew.log_likelihood(poses, ranges)).all())
        edit, rebuild = statistics.median(edits), statistics.median(rebuilds)
        print(
            f"{backend.info.selection:12} {key}: update_map of {EDIT} x {EDIT} cells {edit:.2f} ms, a new model "
            f"{rebuild:.2f} ms, ratio {rebuild / edit:.1f}"
        )
    return same


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", help="selection string; may be given more than once")
    parser.add_argument("--cells", type=int, default=2000, help="rows and columns of the maps (default %(default)s)")
    parser.add_argument("--repeats", type=int, default=9, help="runs that count (default %(default)s)")
    arguments = parser.parse_args()
    made, right = maps(arguments.cells), True
    for selection in arguments.backend or ["auto"]:
        backend = get_backend(selection)
        print(f"{backend.info.selection}: {backend.info.name}; best and median")
        for name, cells in made.items():
            right &= time_map(backend, name, cells, arguments.repeats)
        time_steps(backend, made["building"])
        right &= time_edits(backend, made["building"], arguments.repeats)
    print("as exact as it must be" if right else "NOT as exact as it must be")
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
