"""Compare ``compat="amcl"`` and ``compat="beluga"`` with nav2_amcl and Beluga, compiled from copies of their sources.

    python bench/accuracy/peers.py --nav2 NAVIGATION2 --beluga BELUGA --include SOPHUS --include EIGEN --data DATA
    python bench/accuracy/peers.py --nav2 NAVIGATION2 --beluga BELUGA --include SOPHUS --write WEIGHTS.json

Poses are on the map's free cells, anywhere on it and off it; some cells are in mode scale. Readings of a part of the
beams are NaN, infinite, too short, at range_max or beyond. Weights of likelihood fields are compared with exact
distances in the peers' code; *inexact* is the share of cells that differ with the peers' distances. nav2_amcl rounds
where other programs truncate, so it is compared on a grid whose origin is half a cell lower. ``--write`` stores weights
in small scenes, as in ``tests/models/scan/peer_weights.json``. Needs g++ with C++17, Sophus, Eigen, range-v3 and TBB.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.peers.weights import Beluga, Peer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from accuracy.compiled_peers import Compiled, build, nearest_obstacles, version
from common import make_parser, note, parse, publish, table

MAPS = {
    "intel": "carmen_logs/derived_maps/intel_even_05cm.yaml",
    "columbia": "ros_maps/columbia.yaml",
    "stata": "ros_maps/stata_basement.yaml",
    "willow": "ros_maps/willow-full.yaml",
}
# Fields in which rays to unknown cells and a long reach also matter.
DEFAULT = gs.compat.FieldWeights()
WIDE = gs.compat.FieldWeights(0.4, 0.0, 0.3, 0.7, 1.13)
BOUND = 1e-12


@dataclass(frozen=True)
class Case:
    """A model of a peer: its options, and the parameters of the likelihood field."""

    model: str
    peer: Peer
    field: gs.compat.FieldWeights = DEFAULT

    @property
    def options(self) -> int:
        """The options as ``Compiled.score`` takes them."""
        peer = self.peer
        return (peer.model_unknown_space + 2 * peer.boundaries) if isinstance(peer, Beluga) else 0

    @property
    def numbers(self) -> tuple[float, ...]:
        """The parameters as ``Compiled.score`` takes them."""
        beam, field = self.peer.beam, self.field
        if self.model == "beam":
            return beam.z_hit, beam.z_short, beam.z_max, beam.z_rand, beam.sigma_hit, beam.lambda_short, 0.0
        return field.z_hit, 0.0, 0.0, field.z_rand, field.sigma_hit, 0.0, field.max_distance

    def made(self, grid: gs.OccupancyGrid, scanner: gs.Scanner) -> gs.BeamModel | gs.LikelihoodFieldModel:
        """Return the model of gpusense in float64."""
        options: dict[str, Any] = dict(compat=self.peer, backend="numpy", precision="float64")
        if self.model == "beam":
            return gs.BeamModel(grid, scanner, **options)
        return gs.LikelihoodFieldModel(grid, scanner, self.field, **options)


def cases(name: str) -> Iterator[Case]:
    """Yield the models of a peer."""
    if name == "amcl":
        yield Case("beam", gs.compat.Amcl())
        for field in (DEFAULT, WIDE):
            yield Case("field", gs.compat.Amcl(), field)
            yield Case("field, prob", gs.compat.Amcl(prob=True), field)
        return
    yield Case("beam", gs.compat.Beluga())
    for unknown in (False, True):
        for boundaries in (False, True):
            options: dict[str, Any] = dict(model_unknown_space=unknown, only_obstacle_boundaries=boundaries)
            yield Case("field", gs.compat.Beluga(**options), WIDE if unknown else DEFAULT)
            yield Case("field, prob", gs.compat.Beluga(prob=True, **options), WIDE)


def poses_in(grid: gs.OccupancyGrid, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return poses on free cells, and as many anywhere on and around the map."""
    rows, cols = np.nonzero(grid.cells == 0)
    some = rng.integers(len(rows), size=count)
    inside = grid.cell_centers(rows[some], cols[some]) + rng.uniform(-0.5, 0.5, (count, 2)) * grid.resolution
    left, low, right, top = grid.bounds()
    margin = 0.1 * max(right - left, top - low)
    everywhere = rng.uniform((left - margin, low - margin), (right + margin, top + margin), (count, 2))
    places = np.concatenate([inside, everywhere])
    return np.column_stack([places, rng.uniform(-math.pi, math.pi, len(places))])


def readings_from(expected: np.ndarray, scanner: gs.Scanner, rng: np.random.Generator) -> np.ndarray:
    """Return noisy readings of a scan; some are NaN, infinite, too short, at range_max or beyond."""
    top = scanner.range_max
    ranges = expected + rng.normal(0, 0.1, len(expected))
    odd = (math.nan, math.inf, -math.inf, 0.5 * scanner.range_min, scanner.range_min, top, top + 0.13, 2 * top)
    # Beam 0 points ahead, so that Beluga's conversion to points keeps a reading of range_max exactly.
    where = rng.permutation(np.arange(1, len(ranges)))[: len(odd)]
    ranges[where] = odd
    ranges[where[odd.index(top)]], ranges[0] = ranges[0], top
    return ranges


def grid_for(name: str, grid: gs.OccupancyGrid) -> gs.OccupancyGrid:
    """Return the grid on which gpusense looks up the same cells as a peer."""
    if name == "beluga":
        return grid
    x, y, yaw = grid.origin
    return gs.OccupancyGrid(grid.cells, grid.resolution, (x - grid.resolution / 2, y - grid.resolution / 2, yaw))


def mask_of(case: Case, grid: gs.OccupancyGrid) -> np.ndarray:
    """Return the mask of the likelihood field's obstacles."""
    return case.peer.field_obstacles(grid, "free") == 1


def scene_of(grid: gs.OccupancyGrid, seed: int, beams: int, range_max: float, poses: int) -> dict[str, Any]:
    """Return a scanner, poses and readings on a grid."""
    rng = np.random.default_rng(seed)
    bearings = np.append(0.0, rng.uniform(-math.pi, math.pi, beams - 1))
    # No reading equals a distance between cells, where rounding would decide whether it is shorter than z*.
    scanner = gs.Scanner(bearings, range_max, 0.117)
    cloud = poses_in(grid, rng, poses)
    expected = gs.RayCaster(grid, range_max, backend="numpy").cast(cloud[:1], bearings)[0]
    return dict(scanner=scanner, poses=cloud, ranges=readings_from(expected, scanner, rng))


def compare(compiled: Compiled, case: Case, grid: gs.OccupancyGrid, scene: dict[str, Any]) -> dict[str, Any]:
    """Return the largest difference of weights, ranges and cells."""
    model = case.made(grid_for(compiled.name, grid), scene["scanner"])
    exact = None if case.model == "beam" else nearest_obstacles(mask_of(case, grid))
    arguments = (grid, scene["scanner"], case.numbers, case.model, case.options, scene["poses"], scene["ranges"])
    weights, field = compiled.score(*arguments, exact)
    ours = model.log_likelihood(scene["poses"], scene["ranges"])
    # Underflowed products cannot be compared.
    known = weights > 1e-290
    differences = np.abs(np.expm1(ours[known] - np.log(weights[known])))
    row = {"peer": compiled.name, "model": f"{case.model} {case.peer}", "poses": int(known.sum()),
           "weights": float(differences.max()), "lost": int((ours[~known] > math.log(1e-280)).sum())}  # fmt: skip
    if isinstance(model, gs.BeamModel):
        theirs = compiled.cast(grid, scene["scanner"], scene["poses"])
        apart = np.abs(model.expected_ranges(scene["poses"]) - theirs)
        return row | {"ranges": float(apart.max()), "beyond": int((theirs > scene["scanner"].range_max).sum())}
    inexact = compiled.score(*arguments)[1]
    return row | {"inexact": float((inexact != field).mean())}


def small_scenes() -> Iterator[tuple[gs.OccupancyGrid, dict[str, Any]]]:
    """Yield scenes of the tests: random cells with thick walls, cells in mode scale and unknown ones."""
    sizes = [(17, 23, 0.5, 6.3), (30, 12, 0.05, 0.9), (9, 9, 1, 0.4)]
    for seed, (rows, cols, resolution, range_max) in enumerate(sizes):
        rng = np.random.default_rng(seed)
        cells = rng.choice([0] * 40 + [100, -1, 37, 81], size=(rows, cols))
        cells[2:6, 3:8], cells[:, -1] = 100, -1
        grid = gs.OccupancyGrid(cells, resolution, (-1.25, 2.5, 0.0))
        scene = scene_of(grid, seed, 16, range_max, 10)
        yield grid, scene


def stored(compiled: list[Compiled]) -> list[dict[str, Any]]:
    """Return the small scenes with the peers' weights."""
    scenes = []
    for grid, scene in small_scenes():
        scanner, weights = scene["scanner"], []
        for peer in compiled:
            for case in cases(peer.name):
                exact = None if case.model == "beam" else nearest_obstacles(mask_of(case, grid))
                found = peer.score(
                    grid, scanner, case.numbers, case.model, case.options, scene["poses"], scene["ranges"], exact
                )[0]
                options = {one.name: getattr(case.peer, one.name) for one in fields(case.peer)}
                weights.append({
                    "peer": peer.name, "model": case.model, "options": options, "field": case.field.to_dict(),
                    "weights": found.tolist(),
                })  # fmt: skip
        scenes.append({
            "cells": grid.cells.tolist(), "resolution": grid.resolution, "origin": grid.origin,
            "bearings": scanner.bearings.tolist(), "range_max": scanner.range_max, "range_min": scanner.range_min,
            "poses": scene["poses"].tolist(), "readings": [repr(float(z)) for z in scene["ranges"]],
            "ranges": {peer.name: peer.cast(grid, scanner, scene["poses"]).tolist() for peer in compiled},
            "scores": weights,
        })  # fmt: skip
    return scenes


def compared(compiled: list[Compiled], data: Path, seed: int, poses: int) -> list[dict[str, Any]]:
    """Return the rows of all maps."""
    rows = []
    for name, file in MAPS.items():
        read = gs.read_map(data / file)
        rng = np.random.default_rng(seed)
        cells = np.where(rng.random(read.shape) < 0.002, rng.integers(1, 100, read.shape), read.cells)
        x, y, _ = read.origin
        grid = gs.OccupancyGrid(cells, read.resolution, (x, y, 0.0))
        scene = scene_of(grid, seed, 40, 12.0, poses)
        for peer in compiled:
            for case in cases(peer.name):
                rows.append({"map": name, **compare(peer, case, grid, scene)})
                note(f"{rows[-1]}")
    return rows


def main() -> int:
    """Compile, compare and write."""
    parser = make_parser(__doc__, backend="", data=True)
    parser.add_argument("--nav2", type=Path, required=True, help="a copy of navigation2")
    parser.add_argument("--beluga", type=Path, required=True, help="a copy of Beluga")
    parser.add_argument("--include", type=Path, action="append", default=[], help="a folder of headers, repeatable")
    parser.add_argument("--poses", type=int, default=1000, help="on free cells, and as many anywhere")
    parser.add_argument("--write", type=Path, help="write the scenes of the tests to this file, and compare nothing")
    arguments = parse(parser)
    with tempfile.TemporaryDirectory() as folder:
        compiled = [
            build("amcl", arguments.nav2, [], Path(folder)),
            build("beluga", arguments.beluga, arguments.include, Path(folder)),
        ]
        if arguments.write is not None:
            arguments.write.write_text(json.dumps(stored(compiled), separators=(",", ":")) + "\n", encoding="utf-8")
            return 0
        rows = compared(compiled, arguments.data, arguments.seed, arguments.poses)
    columns = ("map", "peer", "model", "poses", "weights", "ranges", "beyond", "inexact")
    lines = [[f"{row.get(name, ''):.2g}" if isinstance(row.get(name), float) else row.get(name, "") for name in columns]
             for row in rows]  # fmt: skip
    versions = [version(arguments.nav2, "nav2_amcl"), version(arguments.beluga, "beluga")]
    text = f"{', '.join(versions)}. Largest relative differences of weights, and differences of ranges [m].\n\n"
    publish(__file__, arguments, text + table(columns, lines), {"versions": versions, "rows": rows})
    return int(any(row["weights"] > BOUND or row["lost"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
