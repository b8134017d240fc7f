"""Measure the share of the drift of jarvis's lasers that the mounts in the log's transforms cause.

    python bench/accuracy/chaining_mount.py --backend opencl --output bench/results/chaining_mount

A chain of each laser is made with odometry and closures. Nelder and Mead's method finds the mount (x, y, heading) and
the clock's offset that make the drift over 5 m against the references least on one half of the run; the other half
tests them. "corrected" has the mount of the other half, "as stated" that of the transforms; both have the clock's
offset of the other half.

The second table has the headings of mounts at which the motions of quarters of a log over 0.5 m best fit its odometry,
or its reference. Least squares with a robust kernel fit the mount (x, y, heading) and scales of distances and turns. If
odometry determined the heading of a mount, its quarters would agree with one another, and with the reference's.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares, minimize

import gpusense as gs

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from chaining import drifts, ends_of_paths, figures
from chaining_logs import Log, load, references
from common import make_parser, parse, publish, table

LASERS = ("jarvis-s3000", "jarvis-nav350")
LENGTH = 5.0
# Logs with raw odometry, and the length of the motions that mounts are fitted to [m].
LOGS = (*LASERS, "olin", "aces", "csail")
MOTION = 0.5
# First steps of the search [m, m, rad, s].
STEPS = (0.02, 0.02, 0.01, 0.03)


def remounted(poses: np.ndarray, mount: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return the robot's poses (S, 3) if the scanner is mounted as stated plus an offset (3,)."""
    return gs.compose_poses(gs.compose_poses(poses, mount), gs.invert_poses(mount + off))


def fitted(log: Log, poses: np.ndarray, part: slice, steps: tuple[float, ...]) -> np.ndarray:
    """Return the offsets of mount and clock (4,) with the least drift on a part; those with a step of 0 stay 0."""
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


def measured(log: Log, backend: str) -> list[dict[str, Any]]:
    """Return the rows of a laser, one for each half."""
    chain = gs.chain_scans(log.ranges, odometry=log.odometry, times=log.times, backend=backend, **log.arguments)
    mount, half = np.array(log.scanner.mount), len(log.ranges) // 2
    parts = {"first": slice(0, half), "second": slice(half, None)}
    rows = []
    for tuned, part in parts.items():
        other = parts["second" if tuned == "first" else "first"]
        plain, found = (fitted(log, chain.poses, part, steps) for steps in ((0.0, 0.0, 0.0, STEPS[3]), STEPS))
        row = {"log": log.name, "tuned_on": tuned, "mount": found[:3].tolist(), "earlier_s": found[3]}
        for name, value in (("stated", plain), ("corrected", found)):
            moved = remounted(chain.poses, mount, value[:3])
            row[name] = drifts(moved[other], references(log, value[3])[other], LENGTH)
        rows.append(row)
    return rows


def heading_of_mount(poses: np.ndarray, others: np.ndarray) -> float:
    """Return the offset of the mount's heading [rad] with which poses (S, 3) best follow the motions of others."""
    first, second, _ = ends_of_paths(others, MOTION)
    moved, wanted = (gs.pose_difference(p[first], p[second]) for p in (poses, others))

    def errors(values: np.ndarray) -> np.ndarray:
        off = np.broadcast_to(values[:3], moved.shape)
        placed = gs.compose_poses(gs.compose_poses(off, moved), gs.invert_poses(off))
        miss = placed - wanted * values[[3, 3, 4]]
        miss[:, 2] = 0.5 * gs.wrap_angle(miss[:, 2])
        return miss.ravel()

    return float(least_squares(errors, [0.0, 0.0, 0.0, 1.0, 1.0], loss="soft_l1", f_scale=0.01).x[2])


def quarters(log: Log, backend: str) -> dict[str, Any]:
    """Return the headings of the mount for each quarter of a log, by odometry and by references."""
    chain = gs.chain_scans(log.ranges, odometry=log.odometry, times=log.times, backend=backend, **log.arguments)
    truth = references(log, figures(log, "", chain.poses, 0.0)["earlier_s"])
    row: dict[str, Any] = {"log": log.name}
    for name, others in (("odometry", log.odometry), ("reference", truth)):
        parts = np.array_split(np.flatnonzero(np.isfinite(others).all(axis=1)), 4)
        row[name] = [heading_of_mount(chain.poses[part], others[part]) for part in parts]
    return row


def main(argv: list[str] | None = None) -> None:
    """Measure, and publish a table."""
    arguments = parse(make_parser(__doc__, backend="auto", data=True), argv)
    rows = []
    for name in LASERS:
        rows += measured(load(Path(arguments.data), name), arguments.backend)
    columns = ["laser", "mount tuned on", "correction: mm, mm, deg", "drift of the other half as stated", "corrected"]
    lines = [
        [
            row["log"], f"{row['tuned_on']} half",
            "{:.0f}, {:.0f}, {:.2f}".format(*np.multiply(row["mount"], (1e3, 1e3, np.degrees(1)))),
            *("{:.2f} %, {:.3f} deg/m".format(*row[name]) for name in ("stated", "corrected")),
        ]
        for row in rows
    ]  # fmt: skip
    found = [quarters(load(Path(arguments.data), name), arguments.backend) for name in LOGS]
    headings = [
        [row["log"], *(", ".join(f"{np.degrees(h):.2f}" for h in row[name]) for name in ("odometry", "reference"))]
        for row in found
    ]
    text = table(columns, lines) + "\n\n" + table(["log", "heading by odometry, deg", "by the reference"], headings)
    publish(__file__, arguments, text, {"rows": rows, "quarters": found})


if __name__ == "__main__":
    main()
