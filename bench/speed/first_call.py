"""Measure first calls in a new process, with an empty and with a full cache on disk.

    python bench/speed/first_call.py --backend opencl --backend warp:cpu
    python bench/speed/first_call.py --backend opencl --tree .:now --tree ../old:before --output NAME

A new process imports the package, opens the device, and calls the likelihood field and then the beam model for the
first time. "Cold" begins with an empty cache folder, so that the device is also proved; "warm" is the next process with
the same folder. Modules have bytecode, as in an installed package. Trees (checkouts, with a name each) take
turns, so that their ratio is valid on a busy machine.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import ROOT, make_parser, parse, publish, table

_PROCESS = """
import json, sys, time
marks = [time.perf_counter()]
def mark(): marks.append(time.perf_counter())
import gpusense as gs
mark()
import numpy as np
from gpusense.backends import get_backend
from gpusense.worlds import building
grid = building(0)
scanner = gs.Scanner.uniform(angle_min=-1.5, angle_increment=0.05, count=60, range_max=12.0)
poses, ranges = np.random.default_rng(0).uniform(2, 8, (2000, 3)), np.full(60, 3.0)
before = time.perf_counter()
device = get_backend(sys.argv[1])
mark()
marks[1] += before - marks[1]
gs.LikelihoodFieldModel(grid, scanner, backend=device).log_likelihood(poses, ranges)
mark()
gs.BeamModel(grid, scanner, backend=device).log_likelihood(poses, ranges)
mark()
print(json.dumps([1e3 * (b - a) for a, b in zip(marks, marks[1:])]))
"""
STEPS = ("import and scene", "open", "field", "beam model")
COLUMNS = ("backend", "tree", "cache", *STEPS, "open and field", "all")


def milliseconds(tree: Path, backend: str, folder: str, bytecode: str) -> list[float]:
    """Run one process and return the milliseconds of its steps; its modules' bytecode is in a folder."""
    places = dict.fromkeys(("GPUSENSE_CACHE_DIR", "XDG_CACHE_HOME", "POCL_CACHE_DIR", "WARP_CACHE_PATH"), folder)
    search = os.pathsep.join(filter(None, (str(tree.resolve()), os.environ.get("PYTHONPATH"))))
    environment = os.environ | places | {"PYTHONPATH": search, "PYTHONPYCACHEPREFIX": bytecode}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    # Modules of the working directory are not imported.
    command = [sys.executable, "-P", "-c", _PROCESS, backend]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return [float(value) for value in json.loads(done.stdout.splitlines()[-1])]


def measured(trees: list[tuple[Path, str]], backend: str, repeats: int) -> list[dict[str, Any]]:
    """Return a row for each tree and state of the cache: medians over the repeats."""
    times: dict[tuple[str, str], list[list[float]]] = {}
    with tempfile.TemporaryDirectory() as bytecode:
        for _, name in trees:
            Path(bytecode, name).mkdir()
        # The first run of each tree writes its bytecode.
        for repeat in range(repeats + 1):
            for tree, name in trees:
                with tempfile.TemporaryDirectory() as folder:
                    for state in ("cold", "warm"):
                        run = milliseconds(tree, backend, folder, str(Path(bytecode, name)))
                        if repeat:
                            times.setdefault((name, state), []).append(run)
    rows = []
    for (name, state), runs in times.items():
        steps = {step: median(run[i] for run in runs) for i, step in enumerate(STEPS)}
        field = median(run[1] + run[2] for run in runs)
        whole = median(sum(run) for run in runs)
        rows.append({"backend": backend, "tree": name, "cache": state, **steps, "open and field": field, "all": whole})
    return rows


def cells(row: dict[str, Any]) -> list[str]:
    """Format the cells of a row."""
    return [str(row[column]) if column in COLUMNS[:3] else f"{row[column]:.0f}" for column in COLUMNS]


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__, backend="kernels")
    parser.add_argument(
        "--tree", action="append", default=[], metavar="PATH:NAME", help="a checkout (default: this one)"
    )
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parse(parser)
    texts = arguments.tree or [f"{ROOT}:this"]
    trees = [(Path(path), name) for path, _, name in (text.rpartition(":") for text in texts)]
    rows = [row for backend in arguments.backend for row in measured(trees, backend, arguments.repeats)]
    remark = f"Milliseconds, {arguments.repeats} runs."
    publish(__file__, arguments, table(COLUMNS, map(cells, rows)), {"rows": rows}, remark)
    return 0


if __name__ == "__main__":
    sys.exit(main())
