"""Fit the inflation of covariances of chains to some logs, and test the covariances on others.

    python bench/accuracy/chaining_covariances.py --backend opencl --output bench/results/chaining_covariances

Chains are made without closures, from odometry. Errors are those of relative poses between scans that are 2 to 20 m
apart along the path; their covariances are those of the pose graph times an inflation, plus the errors of both
references: 3 cm and 0.01 rad each, for jarvis 1 cm and 0.004 rad, as in ``features.py``, and none in simulations. The
normalised squared error (NEES) is divided by 3, so that 1 is right; "within" has the shares of errors in the ellipsoids
of 50, 80 and 95 %.

The inflation of a log is the one at which the mean NEES is 1; the largest tenth is left out, since references are wrong
there. The inflation of half of the logs is the median of theirs, and is tested on the other half.
The tracks of jarvis and olin have another frame and clock than the scans. The mount's heading and place and the clock's
offset that make drifts least on one half of a log are used for the errors on the other half.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

import gpusense as gs

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from chaining import drifts
from chaining_logs import Log, load, references
from common import make_parser, note, parse, publish, table

from gpusense.chaining.chain import Chainer
from gpusense.chaining.drift import Drift
from gpusense.chaining.graph import solve

HALVES = (("fr079", "aces", "jarvis-s3000", "olin"), ("csail", "fhw", "seattle", "jarvis-nav350"))
SIMULATED = ("office", "corridor")
LENGTHS = (2.0, 5.0, 10.0, 20.0)
KEPT = 0.9
# Deviations of reference poses [m, rad].
REFERENCE, JARVIS_REFERENCE = (0.03, 0.01), (0.01, 0.004)
INFLATIONS = np.geomspace(0.02, 50, 200)
LEVELS = (0.5, 0.8, 0.95)
# Path of the drift that mounts and clocks are fitted to [m], and first steps of the search [m, m, rad, s].
LENGTH = 5.0
STEPS = (0.02, 0.02, 0.01, 0.03)


def simulated(name: str, seed: int) -> Log:
    """Return a simulated run through rooms or corridors with exact poses."""
    rng = np.random.default_rng(seed)
    cells = np.zeros((400, 600), int)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    if name == "office":
        for _ in range(60):
            row, col = rng.integers(10, 380), rng.integers(10, 580)
            if not (abs(row - 200) < 40 or abs(col - 300) < 40):
                cells[row : row + rng.integers(4, 16), col : col + rng.integers(4, 16)] = 100
    else:
        cells[160:170], cells[230:240] = 100, 100
        for col in range(20, 580, 45):
            cells[160 : 160 + rng.integers(12, 18), col : col + 6] = 100
    grid = gs.OccupancyGrid(cells, resolution=0.05)
    scanner = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / 180, count=181, range_max=25.0)
    x = np.arange(3.0, 26.0, 0.12)
    poses = np.stack([x, 10 + 0.3 * np.sin(x), np.arctan(0.3 * np.cos(x))], axis=1)
    ranges = gs.RayCaster(grid, range_max=25.0, backend="numpy").cast(poses, scanner.bearings)
    ranges = ranges + rng.normal(0, 0.015, ranges.shape)
    steps = gs.pose_difference(poses[:-1], poses[1:])
    odometry = [poses[0]]
    for step in steps * 1.02 + rng.normal(0, (0.004, 0.002, 0.004), steps.shape):
        odometry.append(gs.compose_poses(odometry[-1], step))
    return Log(f"simulated {name} {seed}", ranges, scanner, np.array(odometry), poses, None)


class Errors(NamedTuple):
    """Errors (L, 3) of relative poses, their covariances by the chain, and those of both references."""

    off: np.ndarray
    spread: np.ndarray
    reference: np.ndarray
    length: np.ndarray

    def squared(self, inflation: float) -> np.ndarray:
        """Return the squared errors in standard deviations, divided by 3."""
        inverse = np.linalg.inv(inflation * self.spread + self.reference)
        return np.einsum("li,lij,lj->l", self.off, inverse, self.off) / 3

    def inflation(self) -> float:
        """Return the inflation at which the mean of most squared errors is 1."""
        return float(INFLATIONS[np.argmin([abs(kept(self.squared(one)) - 1) for one in INFLATIONS])])


def kept(squared: np.ndarray) -> float:
    """Return the mean without the largest tenth."""
    return float(np.sort(squared)[: max(int(KEPT * len(squared)), 1)].mean())


def errors_of(log: Log, backend: str) -> Errors:
    """Return the errors of a chain of a log."""
    timed = log.times is not None
    chainer = Chainer(
        log.ranges, log.scanner, log.odometry, times=log.times, duration=log.duration if timed else 0.0,
        close_loops=False, backend=backend,
    )  # fmt: skip
    for _ in chainer.steps():
        pass
    poses = chainer.chain().poses
    poses, truth = matched_frames(log, poses)
    joint = chainer._joint()
    solution = solve(joint.poses, chainer._all_links(joint))
    known = np.flatnonzero(np.isfinite(truth[joint.nodes]).all(axis=1))
    chosen = known[:: max(len(known) // 280, 1)]
    true, found = truth[joint.nodes[chosen]], poses[joint.nodes[chosen]]
    path = np.append(0.0, np.cumsum(np.hypot(*np.diff(true[:, :2], axis=0).T)))
    drift, parts = Drift(solution, anchors=np.union1d(0, chosen)), []
    exact = log.name.startswith("simulated")
    deviation = (
        (0.0, 0.0) if exact else JARVIS_REFERENCE if log.track is not None and "jarvis" in log.name else REFERENCE
    )
    reference = 2 * np.diag(np.square([deviation[0], deviation[0], deviation[1]]))
    for length in LENGTHS:
        first, second = np.arange(len(chosen)), np.searchsorted(path, path + length)
        first, second = first[second < len(chosen)], second[second < len(chosen)]
        if log.track is not None:
            border = np.searchsorted(joint.nodes[chosen], len(poses) // 2)
            first, second = (ends[(first < border) == (second < border)] for ends in (first, second))
        if not len(first):
            continue
        moved = [gs.pose_difference(p[first], p[second]) for p in (true, found)]
        off = moved[1] - moved[0]
        off[:, 2] = gs.wrap_angle(off[:, 2])
        spread = drift.relative(chosen[first], chosen[second])
        parts.append(Errors(off, spread, np.tile(reference, (len(off), 1, 1)), np.full(len(off), length)))
    return Errors(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def remounted(poses: np.ndarray, mount: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return the robot's poses (S, 3) if the scanner is mounted as stated plus an offset (3,)."""
    return gs.compose_poses(gs.compose_poses(poses, mount), gs.invert_poses(mount + off))


def fitted(log: Log, poses: np.ndarray, part: slice, steps: tuple[float, ...]) -> np.ndarray:
    """Return the offsets of mount and clock (4,) with the least drift on a part; offsets with a step of 0 stay 0."""
    free = np.flatnonzero(steps)
    start = np.array([0.0, 0.0, 0.0, 0.05])

    def drift(values: np.ndarray) -> float:
        found = start.copy()
        found[free] = values
        moved = remounted(poses, np.array(log.scanner.mount), found[:3])
        return drifts(moved[part], references(log, found[3])[part], LENGTH)[0]

    simplex = start[free] + np.concatenate([np.zeros((1, len(free))), np.diag(np.array(steps)[free])])
    result = start.copy()
    result[free] = minimize(
        drift, start[free], method="Nelder-Mead", options={"initial_simplex": simplex, "maxiter": 200}
    ).x
    return result


def matched_frames(log: Log, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return poses and references (S, 3) in one frame and of one clock, for pairs of poses within a half of the log."""
    if log.track is None:
        return poses, references(log, 0.0)
    half = len(poses) // 2
    placed, truth = np.empty_like(poses), np.empty_like(poses)
    parts = slice(0, half), slice(half, None)
    for part, other in (parts, parts[::-1]):
        found = fitted(log, poses, other, STEPS)
        placed[part] = remounted(poses, np.array(log.scanner.mount), found[:3])[part]
        truth[part] = references(log, found[3])[part]
    return placed, truth


def row(name: str, errors: Errors, inflation: float) -> dict[str, Any]:
    """Return the figures of a log with an inflation."""
    scaled = errors.squared(inflation)
    within = [float(np.mean(3 * scaled <= chi2.ppf(level, 3))) for level in LEVELS]
    by_length = [float(scaled[errors.length == one].mean()) if (errors.length == one).any() else np.nan
                 for one in LENGTHS]  # fmt: skip
    return {"log": name, "poses": len(scaled), "nees": float(np.mean(scaled)), "median": float(np.median(scaled)),
            "kept": kept(scaled), "within": within, "by_length": by_length}  # fmt: skip


def main(argv: list[str] | None = None) -> None:
    """Measure the logs and publish the tables."""
    parser = make_parser(__doc__, backend="auto", data=True)
    parser.add_argument("--seeds", type=int, default=2, help="runs of each simulated building")
    arguments = parse(parser, argv)
    errors = {}
    for name in [log for half in HALVES for log in half]:
        errors[name] = errors_of(load(Path(arguments.data), name), arguments.backend)
        note(f"{name}: NEES {errors[name].squared(1.0).mean():.2f}")
    made = [simulated(name, seed) for name in SIMULATED for seed in range(arguments.seeds)]
    for log in made:
        errors[log.name] = errors_of(log, arguments.backend)
        note(f"{log.name}: NEES {errors[log.name].squared(1.0).mean():.2f}")
    rows = []
    for one, two in (HALVES, HALVES[::-1]):
        factor = float(np.median([errors[name].inflation() for name in one]))
        for name in (*two, *(log.name for log in made)):
            rows.append({"chosen_on": ", ".join(one), "factor": factor, **row(name, errors[name], factor)})
    for name in errors:
        rows.append({"chosen_on": "as it is", "factor": 1.0, **row(name, errors[name], 1.0)})
    lines = [
        [r["chosen_on"], f"{r['factor']:.3f}", r["log"], r["poses"], f"{r['nees']:.2f}", f"{r['kept']:.2f}",
         f"{r['median']:.2f}", " / ".join(f"{100 * share:.0f}" for share in r["within"]),
         " / ".join("" if np.isnan(one) else f"{one:.2f}" for one in r["by_length"])]
        for r in rows
    ]  # fmt: skip
    columns = [
        "inflation chosen on",
        "inflation",
        "log",
        "pairs of poses",
        "NEES",
        "of 90 %",
        "median",
        "within 50 / 80 / 95 %",
        "NEES over 2 / 5 / 10 / 20 m",
    ]
    publish(__file__, arguments, table(columns, lines), {"rows": rows})


if __name__ == "__main__":
    main()
