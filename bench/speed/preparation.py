"""Measure the preparation of a map step by step, and an edit of 50 x 50 cells beside it.

    python bench/speed/preparation.py --backend opencl --backend warp:cpu --cells 2000

For each backend and map: distances without and with a cap of 40 cells, empty rectangles for 1, 2 and 4 sectors, and a
model's preparation of the whole map, each as the best and the median of several runs; then every upload, allocation
and kernel, which wait for the device, so that their sum is more than the whole; then ``update_map`` against a
new model, whose log-likelihoods must be the same. Distances must be SciPy's. Exit code 1 where anything differs.
"""

from __future__ import annotations

import functools
import math
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import Backend, get_backend
from gpusense.backends.proxy import Proxy
from gpusense.evaluation.selftest import scipy_squares
from gpusense.evaluation.worlds import building
from gpusense.tables.cells import packed
from gpusense.tables.distances import squared_distances
from gpusense.tables.rectangles import Planes, empty_rectangles

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import MODELS, best, make_parser, note, parse, publish, table, table_line

RESOLUTION, CAP, EDIT = 0.05, 1601, 50
SCANNER = gs.Scanner(np.linspace(-2, 2, 60), 10.0)
COLUMNS = ("backend", "map", "step", "best, ms", "median, ms")
Row = dict[str, Any]


class Waiting(Proxy):
    """A backend that waits after every step and sums the seconds of each."""

    def __init__(self, backend: Backend) -> None:
        super().__init__(backend)
        self.spent = defaultdict[str, float](float)

    def timed(self, name: str, step: Callable[..., Any]) -> Callable[..., Any]:
        """Return the step, with its seconds added to those of the name."""

        def run(*arguments: Any, **named: Any) -> Any:
            self.synchronize()
            begin = time.perf_counter()
            result = step(*arguments, **named)
            self.synchronize()
            self.spent[name] += time.perf_counter() - begin
            return result

        return run

    def compile(self, kernel: str, flags: frozenset[str]) -> Any:
        """See Backend.compile."""
        return self.timed(kernel, super().compile(kernel, flags))

    def upload(self, array: np.ndarray, out: Any = None, *, wait: bool = True) -> Any:
        """See Backend.upload."""
        return self.timed("upload", super().upload)(array, out, wait=wait)

    def empty(self, count: int, dtype: np.dtype, *, zero: bool = False) -> Any:
        """See Backend.empty."""
        return self.timed("empty", super().empty)(count, dtype, zero=zero)


def maps(size: int) -> dict[str, np.ndarray]:
    """Make the cells of an ordinary map, and of maps that are hard on a search."""
    metres = size * RESOLUTION
    line = np.arange(size)
    empty = np.zeros((size, size), np.int8)
    one, diagonal = empty.copy(), empty.copy()
    one[3, 5] = diagonal[line, size - 1 - line] = 100
    sparse = np.where(np.random.default_rng(0).random(empty.shape) < 2e-5, np.int8(100), np.int8(0))
    rooms = building(0, (metres, metres), RESOLUTION).cells
    return {"building": rooms, "empty": empty, "one obstacle": one, "diagonal": diagonal, "sparse": sparse}


def times(step: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Return the best and the median seconds after one run that does not count."""
    step()
    least, median = best(step, repeats, math.inf)
    return {"best_s": least, "median_s": median}


def whole(kind: type[Any], grid: gs.OccupancyGrid, backend: Any) -> Any:
    """Make a model that has prepared all of its map."""
    model = kind(grid, SCANNER, backend=backend, specialize=False)
    model.prepare(np.zeros((1, 3)))
    return model


def time_map(backend: Backend, name: str, cells: np.ndarray, repeats: int) -> tuple[list[Row], bool]:
    """Measure the steps of a map's preparation.

    Returns:
        A row for each step, and whether the distances are SciPy's.
    """
    grid = gs.OccupancyGrid(cells, RESOLUTION)
    obstacles = grid.obstacles()
    steps: dict[str, Callable[[], Any]] = {
        "bits on the host": lambda: packed(obstacles),
        "distances": lambda: squared_distances(backend, obstacles),
        "distances to 40 cells": lambda: squared_distances(backend, obstacles, CAP),
    }
    steps |= {
        f"rectangles, {n} sectors": functools.partial(empty_rectangles, backend, obstacles, Planes(n))
        for n in (1, 2, 4)
    }
    steps |= {f"{key}, whole": functools.partial(whole, kind, grid, backend) for key, kind in MODELS.items()}
    rows = []
    for step, run in steps.items():
        rows.append({"backend": backend.info.selection, "map": name, "step": step, **times(run, repeats)})
        note(table_line(cells_of(rows[-1])))
    found = backend.download(squared_distances(backend, obstacles), np.empty(cells.shape, np.int32))
    exact = np.full(cells.shape, np.iinfo(np.int32).max) if not obstacles.any() else scipy_squares(obstacles)
    return rows, bool((found == exact).all())


def time_steps(backend: Backend, cells: np.ndarray) -> list[Row]:
    """Measure every upload, allocation and kernel of a preparation, each of which waits for the device."""
    grid = gs.OccupancyGrid(cells, RESOLUTION)
    rows = []
    for key, kind in MODELS.items():
        whole(kind, grid, backend)
        waiting = Waiting(backend)
        whole(kind, grid, waiting)
        for step, taken in waiting.spent.items():
            where = {"backend": backend.info.selection, "map": "building"}
            rows.append({**where, "step": f"{key}: {step}", "best_s": taken, "median_s": taken})
    return rows


def time_edits(backend: Backend, cells: np.ndarray, repeats: int) -> tuple[list[Row], bool]:
    """Measure edits of a map.

    Returns:
        Rows of edits and of new models, and whether edited models give the log-likelihoods of new ones.
    """
    rng, same = np.random.default_rng(1), True
    size = len(cells)
    poses = rng.uniform((0, 0, -3), (size * RESOLUTION, size * RESOLUTION, 3), (200, 3))
    ranges = rng.uniform(0, 10, SCANNER.count)
    rows = []
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
            edits.append(middle - begin)
            rebuilds.append(time.perf_counter() - middle)
            same &= bool((model.log_likelihood(poses, ranges) == anew.log_likelihood(poses, ranges)).all())
        for what, taken in ((f"update_map of {EDIT} x {EDIT} cells", edits), ("a new model", rebuilds)):
            where = {"backend": backend.info.selection, "map": "building", "step": f"{key}, {what}"}
            rows.append({**where, "best_s": min(taken), "median_s": statistics.median(taken)})
            note(table_line(cells_of(rows[-1])))
    return rows, same


def cells_of(row: Row) -> list[str]:
    """Format the cells of a row."""
    seconds = [f"{1e3 * row[key]:.2f}" for key in ("best_s", "median_s")]
    return [row["backend"], row["map"], row["step"], *seconds]


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__)
    parser.add_argument("--cells", type=int, default=2000, help="rows and columns of the maps (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=9, help="runs that count (default: %(default)s)")
    arguments = parse(parser)
    made, rows, right = maps(arguments.cells), [], True
    for selection in arguments.backend:
        backend = get_backend(selection)
        for name, cells in made.items():
            found, exact = time_map(backend, name, cells, arguments.repeats)
            rows, right = rows + found, right and exact
        rows += time_steps(backend, made["building"])
        found, same = time_edits(backend, made["building"], arguments.repeats)
        rows, right = rows + found, right and same
    remark = f"Maps of {arguments.cells} x {arguments.cells} cells. " + (
        "Distances and edited models are exact." if right else "Distances or edited models are NOT exact."
    )
    publish(__file__, arguments, table(COLUMNS, map(cells_of, rows)), {"rows": rows, "exact": right}, remark)
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
