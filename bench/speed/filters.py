"""Sensor models of nav2_amcl and Beluga, compiled from copies of their sources; rows for baselines.py.

NAV2 names a copy of navigation2, BELUGA one of Beluga, BELUGA_INCLUDE folders of headers that the compiler does not
find by itself: Sophus, Eigen, range-v3, TBB. LIBRARY_PATH and LD_LIBRARY_PATH lead the compiler and the loader to TBB.
Both run one thread. A weight's logarithm is the log-likelihood; nav2_amcl's beam model and likelihood field, and
Beluga's, add cubes of densities, which is not a likelihood. nav2_amcl rounds positions to cells; the other programs
truncate.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from accuracy import compiled_peers

from gpusense.evaluation.benchmark.candidates import Candidate, Runner
from gpusense.evaluation.benchmark.scenes import Scene
from gpusense.world.grid import OccupancyGrid

# By peer: its variable, its package, and the package of its headers.
PEERS = {"amcl": ("NAV2", "nav2_amcl", ""), "beluga": ("BELUGA", "beluga", "BELUGA_INCLUDE")}
# By problem: the peers' models, and their names in rows.
MODELS = {"beam": {"beam": "sum of cubes"}, "field": {"field": "sum of cubes", "field, prob": "product"}}
_kept: list[tempfile.TemporaryDirectory[str]] = []


def runner_of(compiled: compiled_peers.Compiled, scene: Scene, problem: str, model: str) -> Runner:
    """Prepare a model for a scene; its runner returns the logarithms of the weights."""
    grid, beam, field = scene.grid, scene.beam, scene.field
    placed = OccupancyGrid(np.where(grid.occupied, 100, 0).astype(np.int8), grid.resolution)
    one = beam if problem == "beam" else field
    parameters = (one.z_hit, beam.z_short, beam.z_max, one.z_rand, one.sigma_hit, beam.lambda_short,
                  field.max_distance)  # fmt: skip
    weigh = compiled_peers.Weigher(compiled, placed, scene.scanner, parameters, model)

    def run(poses: np.ndarray) -> np.ndarray:
        moved = np.empty_like(poses)
        moved[:, :2] = grid.world_to_cells(poses[:, :2]) * grid.resolution
        moved[:, 2] = poses[:, 2] - grid.origin[2]
        with np.errstate(divide="ignore"):
            return np.log(weigh(moved, scene.readings))

    return run


def load(name: str) -> tuple[compiled_peers.Compiled | None, str, str]:
    """Compile a peer; return it, its version, and the reason where it fails."""
    variable, package, headers = PEERS[name]
    source = Path(os.environ.get(variable, ""))
    if not os.environ.get(variable):
        return None, package, f"not compiled: {variable} must name a copy of its sources"
    include = [Path(one) for one in os.environ.get(headers, "").split(os.pathsep) if one] if headers else []
    _kept.append(tempfile.TemporaryDirectory())
    try:
        made = compiled_peers.build(name, source, include, Path(_kept[-1].name))
        return made, compiled_peers.version(source, package), ""
    except (OSError, subprocess.CalledProcessError) as error:
        return None, package, f"not compiled: {' '.join(str(error).split())[:200]}"


def candidates() -> list[Candidate]:
    """Return the rows of both peers; those that cannot run say why."""
    found = []
    for name in PEERS:
        compiled, version, missing = load(name)
        found += [
            Candidate(problem, PEERS[name][1], _maker(compiled, problem, model), words, precision="float64",
                      outside=f"{version}, 1 thread", missing=missing)
            for problem, models in MODELS.items() for model, words in models.items()
        ]  # fmt: skip
    return found


def _maker(compiled: Any, problem: str, model: str) -> Callable[[Scene, None, str], Runner]:
    return lambda scene, backend, precision: runner_of(compiled, scene, problem, model)
