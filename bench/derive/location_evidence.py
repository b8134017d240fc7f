"""Fit the weights of the probability that a pose on a whole map is right: ``gpusense/matching/location.py``.

    GPUSENSE_DATA=DATA python bench/derive/location_evidence.py --backend opencl

Scans of half A of the logs and of generated buildings, some with people, are located on their own map and on the other
maps of their half. Right and wrong poses have equal weight. ``--half B`` prints stated against observed probabilities
for the held-out logs.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import gpusense as gs
from gpusense.evaluation.worlds import free_pose
from gpusense.matching.location import explained_logs

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import make_parser, parse
from verdict_pairs import HALF_A, HALF_B, data, recording, scanners, with_people

# Errors of a pose that counts as right [m, rad].
RIGHT, RIGHT_TURN = 0.5, np.radians(5.0)
PEOPLE = (0.0, 0.0, 0.1, 0.3)


def located(model, ranges, truth):
    """Return the evidence, p_right, whether the pose is right, and the status of a scan."""
    found = gs.locate_scan(model, ranges, resolution=0.1)
    turn = abs(np.angle(np.exp(1j * (found.pose[2] - truth[2]))))
    right = np.hypot(*(found.pose - truth)[:2]) <= RIGHT and turn <= RIGHT_TURN
    return found.evidence, found.p_right, bool(right), found.status


def cases(half: str, backend: str, count: int, seed: int):
    """Yield (name of the map, name of the scans, evidence, p_right, right, status)."""
    rng = np.random.default_rng(seed)
    grids, scans = {}, {}
    for name in HALF_A if half == "A" else HALF_B:
        path = data() / "carmen_logs" / "derived_maps" / f"{name}_even_05cm.yaml"
        if path.exists():
            grids[name] = gs.read_map(path)
            ranges, scanner, poses, _ = recording(name)
            odd = rng.choice(np.arange(1, len(ranges), 2), count, replace=False)
            scans[name] = scanner, ranges[odd], poses[odd]
    for i in range(3 if half == "A" else 0):
        grid, scanner = gs.worlds.building(i), scanners()[i]
        grids[f"building {i}"] = grid
        poses = np.array([free_pose(grid, rng) for _ in range(count)])
        exact = gs.RayCaster(grid, scanner.range_max, backend=backend).cast(poses, scanner.bearings).astype(np.float64)
        noisy = np.where(exact < scanner.range_max, exact + rng.normal(0, 0.02, exact.shape), np.inf)
        scans[f"building {i}"] = scanner, noisy, poses
    for place, grid in grids.items():
        for name, (scanner, ranges, poses) in scans.items():
            model = gs.LikelihoodFieldModel(grid, scanner, backend=backend, beams=180)
            for k in range(count if name == place else max(count // len(scans), 1)):
                seen = with_people(ranges[k], rng.choice(PEOPLE), rng)
                yield place, name, *located(model, seen, poses[k] if name == place else np.full(3, 1e9))


def main(argv: list[str] | None = None) -> None:
    """Fit, and print the weights, and stated against observed probabilities."""
    parser = make_parser(__doc__, backend="auto")
    parser.add_argument("--count", type=int, default=60, help="scans of each map (default: %(default)s)")
    parser.add_argument("--half", choices=("A", "B"), default="A", help="default: %(default)s, which fits")
    arguments = parse(parser, argv)
    rows = list(cases(arguments.half, arguments.backend, arguments.count, arguments.seed))
    said, right = np.array([row[3] for row in rows]), np.array([row[4] for row in rows])
    status, own = np.array([row[5] for row in rows]), np.array([row[0] == row[1] for row in rows])
    if arguments.half == "A":
        evidence = np.array([row[2] for row in rows])
        weight = np.where(right, 0.5 / right.sum(), 0.5 / (~right).sum())
        logs = explained_logs(evidence)
        gap, ahead = np.minimum(evidence[:, 3], 1.0), evidence[:, 4]
        alone = np.isinf(evidence[:, 3])

        def probability(b: np.ndarray) -> np.ndarray:
            explained = 1 / (1 + np.exp(-np.clip(b[0] + logs @ b[1:4], -50, 50)))
            return explained * np.where(alone, 1, 1 / (1 + np.exp(-np.clip(b[4] * gap + b[5] * ahead, -50, 50))))

        def loss(b: np.ndarray) -> float:
            p = np.clip(probability(b), 1e-9, 1 - 1e-9)
            return float(-(weight * np.where(right, np.log(p), np.log(1 - p))).sum() + 1e-4 * (b @ b))

        b = minimize(loss, np.array([-6.0, -0.3, -2.0, 0.0, 2.0, 5.0]), bounds=[(None, None)] * 4 + [(0, None)] * 2).x
        print(f"_CONSTANT = {b[0]:.2f}\n_WEIGHTS = ({', '.join(f'{v:.2f}' for v in b[1:4])})")
        print(f"_RIVAL_WEIGHTS = ({b[4]:.2f}, {b[5]:.2f})")
        said = probability(b)
    for low in np.arange(0, 1, 0.1):
        some = (said >= low) & (said < low + 0.1 + (low > 0.85))
        if some.any():
            share = np.where(right, 1 / right.sum(), 1 / (~right).sum())[some]
            print(f"said {np.average(said[some], weights=share):.2f}, happened "
                  f"{np.average(right[some], weights=share):.2f}, {some.sum()} scans")  # fmt: skip
    for name in sorted({row[0] for row in rows}):
        mine = np.array([row[0] == name for row in rows])
        print(f"{name}: right {right[mine & own].mean():.2f}, said 0.8 {(said[mine & right] >= 0.8).mean():.2f}, "
              f"found {(status[mine & right] == 'found').mean():.2f}; wrong or of other maps: said 0.8 "
              f"{(said[mine & ~right] >= 0.8).mean():.3f} of {np.count_nonzero(mine & ~right)}")  # fmt: skip


if __name__ == "__main__":
    main()
