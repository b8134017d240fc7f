"""Chain the scans of recorded logs, and compare trajectories and maps with references.

    python bench/accuracy/chaining.py --backend opencl --output bench/results/chaining

Rows of a log: its raw odometry; "scan to scan", successive matches without key scans and loops; "chain" is
``gpusense.chain_scans``, with and without odometry, with and without closures; "KISS-ICP" where that library is
installed, on points with z = 0, with the best of voxels of 0.1, 0.3 and 1 m, with or without its correction of motion
during scans that have a duration; "CSM", from scan to scan, if its sources are given. "jarvis-both" has the scans of
both lasers. Both rows from scan to scan begin each match at the odometry's motion; KISS-ICP knows no odometry. Times
are wall time without the first call's compilation.

"error" is the root mean square distance from the reference after alignment. "drift" is the mean error of relative
poses over a path of 5, 20 and 100 m, per length. "contradicted" closures differ from the reference by more than 0.5 m
or 0.15 rad. "wrong motions" from scan to scan differ by more than 0.3 m or 0.1 rad; those "said" lie in doubtful
stretches. The references also have errors. Therefore "fit better" counts the contradicted closures that put more end
points of five scans around one place within 10 cm of those around the other than the reference does. The reference of
jarvis is a track by reflectors with a clock of its own, that of olin takes scans as instantaneous: each is shifted in
time by up to 0.25 s, to where the error of a row is least.

"held out" is the share of end points up to 20 m of odd scans within 5 and 15 cm of an occupied cell of the even scans'
map, at the poses of the row with odometry and closures, and at those of the reference.

The last table has groups of matches between places that agree with one another, whether used or not: by evidence, the
groups whose matches have references, and those of them that are mostly right. Where the drift cannot decide, closures
need an evidence of 6.5.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from chaining_logs import BOTH, Log, load, references
from chaining_peers import csm_steps, kiss_icp
from common import make_parser, note, parse, publish, table

from gpusense.chaining.chain import Chainer
from gpusense.chaining.closing import Loops
from gpusense.chaining.place_recognition import _consistent, _groups, _supported

LOGS = ("intel", "fr079", "csail", "aces", "fhw", "seattle", "jarvis-s3000", "jarvis-nav350", BOTH, "olin")
LENGTHS = (5, 20, 100)
LIMIT = 20.0
# Bounds of the evidence of groups of matches.
EVIDENCE = (0.0, 4.5, 6.5, 10.0, np.inf)


def aligned_error(poses: np.ndarray, truth: np.ndarray) -> float:
    """Return the root mean square distance after the best rigid alignment [m]."""
    known = np.isfinite(truth).all(axis=1)
    p, q = poses[known, :2] @ (1, 1j), truth[known, :2] @ (1, 1j)
    p, q = p - p.mean(), q - q.mean()
    turn = np.vdot(p, q)
    return float(np.sqrt(np.mean(np.abs(p * turn / abs(turn) - q) ** 2)))


def ends_of_paths(poses: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return indices of the first and last pose of each path of at least a length [m], and the paths' lengths."""
    path = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    last = np.searchsorted(path, path + length)
    first = np.flatnonzero(last < len(path))
    last = last[first]
    return first, last, path[last] - path[first]


def drifts(poses: np.ndarray, truth: np.ndarray, length: float) -> tuple[float, float]:
    """Return the mean error of relative poses over paths of a length: per cent, and degrees a metre."""
    rows = np.flatnonzero(np.isfinite(truth).all(axis=1))
    first, second, long = ends_of_paths(truth[rows], length)
    if not len(first):
        return np.nan, np.nan
    moved = [gs.pose_difference(p[rows[first]], p[rows[second]]) for p in (truth, poses)]
    off = gs.pose_difference(*moved)
    return float(100 * np.mean(np.hypot(off[:, 0], off[:, 1]) / long)), float(
        np.degrees(np.mean(np.abs(off[:, 2]) / long))
    )


def figures(log: Log, method: str, poses: np.ndarray, seconds: float) -> dict[str, Any]:
    """Return the figures of a trajectory."""
    shifts = np.arange(-0.25, 0.26, 0.01) if log.track is not None else [0.0]
    errors = [aligned_error(poses, references(log, shift)) for shift in shifts]
    earlier = float(shifts[int(np.argmin(errors))])
    truth = references(log, earlier)
    found: dict[str, Any] = {"log": log.name, "method": method, "scans": len(poses), "seconds": seconds}
    found |= {"error_m": min(errors), "earlier_s": earlier}
    for length in LENGTHS:
        both = [None if np.isnan(value) else value for value in drifts(poses, truth, length)]
        found[f"drift_{length}_percent"], found[f"drift_{length}_degrees"] = both
    return found


def chain_row(log: Log, arguments: argparse.Namespace, with_odometry: bool, loops: bool) -> tuple[dict, gs.ScanChain]:
    """Chain a log, and return its figures."""
    begun = time.perf_counter()
    chainer = Chainer(
        log.ranges, odometry=log.odometry if with_odometry else None, times=log.times, close_loops=loops,
        backend=arguments.backend, **log.arguments,
    )  # fmt: skip
    for _ in chainer.steps():
        pass
    chain = chainer.chain()
    seconds = time.perf_counter() - begun
    name = f"chain, {'with' if with_odometry else 'no'} odometry, {'closures' if loops else 'no closures'}"
    found = figures(log, name, chain.poses, seconds)
    truth, closures = references(log, found["earlier_s"]), chain.closures
    compared, wrong = contradicted(closures, truth)
    known = closures[compared]
    found["groups"] = [] if chainer.loops is None else judged_groups(chainer.loops, truth)
    found |= wrong_motions(chain, truth)
    found |= {"closures": len(closures), "compared": len(known), "contradicted": int(wrong.sum())}
    shares = [] if log.lasers is not None else [fits(log, chain.poses, truth, *link) for link in places(known[wrong])]
    found |= {"fit_better": sum(one > two for one, two in shares), "shares": shares}
    return found | {"doubtful": int(chain.doubtful.sum()), "key_scans": len(chain.keys)}, chain


def contradicted(links: Any, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the links between scans with references, and whether the references contradict each."""
    rows = np.flatnonzero(np.isfinite(truth[links.first] + truth[links.second]).all(axis=1))
    if not len(rows):
        return rows, np.zeros(0, bool)
    off = gs.pose_difference(gs.pose_difference(truth[links.first[rows]], truth[links.second[rows]]), links.pose[rows])
    return rows, (np.hypot(off[:, 0], off[:, 1]) > 0.5) | (np.abs(off[:, 2]) > 0.15)


def judged_groups(loops: Loops, truth: np.ndarray) -> list[dict[str, float]]:
    """Return the evidence of each group with references, its matches with references, and the right ones of these."""
    matches = loops.matches
    if not len(matches):
        return []
    agreement, group = _consistent(matches, loops.solution.poses), np.full(len(matches), -1)
    kept = _supported(agreement, np.ones(len(matches), bool))
    group[kept], evidence, _ = _groups(agreement, kept, matches)
    rows, wrong = contradicted(loops.matches.renumbered(loops.nodes), truth)
    result = []
    for k, strength in enumerate(evidence.tolist()):
        some = group[rows] == k
        if some.any():
            result.append({"evidence": strength, "compared": int(some.sum()), "right": int((some & ~wrong).sum())})
    return result


def groups_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of right groups by evidence."""
    bounds = list(itertools.pairwise(EVIDENCE))
    lines = []
    for row in rows:
        if not row.get("groups"):
            continue
        cells = []
        for low, high in bounds:
            some = [group for group in row["groups"] if low <= group["evidence"] < high]
            cells.append(f"{sum(2 * g['right'] > g['compared'] for g in some)} of {len(some)}" if some else "-")
        lines.append([row["log"], "with" if "with odometry" in row["method"] else "no", *cells])
    names = [f"evidence {low:g} to {high:g}" if np.isfinite(high) else f"from {low:g}" for low, high in bounds]
    return table(["log", "odometry", *names], lines)


def places(closures: Any) -> list[tuple[int, int, np.ndarray]]:
    """Return the scans and the pose of each closure."""
    return list(zip(closures.first.tolist(), closures.second.tolist(), closures.pose, strict=True))


def fits(
    log: Log, poses: np.ndarray, truth: np.ndarray, first: int, second: int, pose: np.ndarray
) -> tuple[float, float]:
    """Return the shares of end points around a scan near those around another one: at a pose, and at the reference.

    The chain places the scans around each in its frame.
    """
    from scipy.spatial import cKDTree

    def around(middle: int) -> np.ndarray:
        scans = np.arange(max(middle - 2, 0), min(middle + 3, len(poses)))
        placed = gs.pose_difference(np.repeat(poses[middle : middle + 1], len(scans), axis=0), poses[scans])
        sensor = gs.compose_poses(placed, np.array(log.scanner.mount))
        angle, z = sensor[:, 2, None] + log.scanner.bearings, log.ranges[scans]
        with np.errstate(invalid="ignore"):
            hit = np.isfinite(z) & (z > 0) & (z < min(LIMIT, log.scanner.range_max))
        z = np.where(hit, z, 0.0)
        return np.stack([sensor[:, :1] + z * np.cos(angle), sensor[:, 1:2] + z * np.sin(angle)], axis=-1)[hit]

    tree, ends = cKDTree(around(first)), around(second)
    at = np.column_stack([ends, np.zeros(len(ends))])
    one, two = (
        float(np.mean(tree.query(gs.compose_poses(moved, at)[:, :2])[0] <= 0.1))
        for moved in (pose, gs.pose_difference(truth[first], truth[second]))
    )
    return one, two


def wrong_motions(chain: gs.ScanChain, truth: np.ndarray) -> dict[str, int]:
    """Count the motions from scan to scan that are off by more than 0.3 m or 0.1 rad, and those of them in doubt."""
    known = np.flatnonzero(np.isfinite(truth[:-1] + truth[1:]).all(axis=1))
    off = gs.pose_difference(*(gs.pose_difference(p[known], p[known + 1]) for p in (truth, chain.poses)))
    wrong = (np.hypot(off[:, 0], off[:, 1]) > 0.3) | (np.abs(off[:, 2]) > 0.1)
    return {"wrong_motions": int(wrong.sum()), "said": int(chain.doubtful[known + 1][wrong].sum())}


def scan_to_scan(log: Log, backend: str) -> tuple[np.ndarray, float]:
    """Match each scan to the one before."""
    begun = time.perf_counter()
    guess = gs.pose_difference(log.odometry[:-1], log.odometry[1:])
    poses = [log.odometry[0]]
    for part in range(0, len(guess), 256):
        rows = slice(part, part + 256)
        match = gs.match_scan(log.ranges[:-1][rows], log.ranges[1:][rows], log.scanner, guess[rows], backend=backend)
        for step in np.where(match.usable[:, None], match.pose, guess[rows]):
            poses.append(gs.compose_poses(poses[-1], step))
    return np.array(poses), time.perf_counter() - begun


def held_out(log: Log, poses: np.ndarray, motions: np.ndarray | None, backend: str) -> tuple[float, float]:
    """Return the shares of odd scans' end points within 5 and 15 cm of an occupied cell of the even scans' map."""
    known = np.flatnonzero(np.isfinite(poses).all(axis=1))
    even, odd = known[::2], known[1::2]
    moved = None if motions is None else motions[even]
    grid = gs.build_map(log.ranges[even], poses[even], log.scanner, range_limit=LIMIT, motion=moved, backend=backend)
    distance = gs.distance_transform(grid.occupied, resolution=grid.resolution, backend=backend)
    readings = log.ranges[odd]
    if motions is not None:
        readings = gs.deskew_scan(readings, log.scanner, motions[odd])
    with np.errstate(invalid="ignore"):
        hit = np.isfinite(readings) & (readings > 0) & (readings < min(LIMIT, log.scanner.range_max))
    sensor = gs.compose_poses(poses[odd], np.array(log.scanner.mount))
    angle = sensor[:, 2, None] + log.scanner.bearings
    z = np.where(hit, readings, 0.0)
    ends = np.stack([sensor[:, 0, None] + z * np.cos(angle), sensor[:, 1, None] + z * np.sin(angle)], axis=-1)[hit]
    cells = np.floor((ends - grid.origin[:2]) / grid.resolution).astype(int)
    inside = ((cells >= 0) & (cells < grid.shape[::-1])).all(axis=1)
    near = np.full(len(cells), np.inf)
    near[inside] = distance[cells[inside, 1], cells[inside, 0]]
    return float(100 * np.mean(near <= 0.0501)), float(100 * np.mean(near <= 0.1501))


def peers(log: Log, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of other programs that are installed: the best of KISS-ICP, and CSM from scan to scan."""
    rows = []
    found = kiss_icp(log)
    if found:
        figured = [figures(log, f"KISS-ICP, voxels of {voxel} m", poses, time) for poses, time, voxel in found]
        rows.append(min(figured, key=lambda row: row["error_m"]))
    if arguments.csm is not None:
        guess = gs.pose_difference(log.odometry[:-1], log.odometry[1:])
        moved, seconds = csm_steps(arguments.csm, arguments.gsl, log.ranges, log.scanner, guess)
        poses = [log.odometry[0]]
        for step in moved:
            poses.append(gs.compose_poses(poses[-1], step))
        rows.append(figures(log, "CSM, scan to scan", np.array(poses), seconds))
    return rows


def measured(log: Log, arguments: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, Any] | None]:
    """Return the rows of a log, and the row of its maps, which is None for several lasers."""
    rows = [figures(log, "odometry", log.odometry, 0.0)]
    if log.lasers is None:
        gs.chain_scans(log.ranges[:6], log.scanner, log.odometry[:6], backend=arguments.backend)
        rows.append(figures(log, "scan to scan", *scan_to_scan(log, arguments.backend)))
        rows += peers(log, arguments)
    best: gs.ScanChain | None = None
    for with_odometry in (True, False):
        for loops in (False, True):
            found, chain = chain_row(log, arguments, with_odometry, loops)
            rows.append(found)
            best = chain if best is None or (with_odometry and loops) else best
            note(f"{log.name}, {found['method']}: {found['error_m']:.3f} m")
    assert best is not None
    if log.lasers is not None:
        return rows, None
    maps = {"log": log.name, "chain": held_out(log, best.poses, best.motions, arguments.backend)}
    truth = references(log, min(rows, key=lambda row: row["error_m"])["earlier_s"])
    maps["reference"] = held_out(log, truth, best.motions, arguments.backend)
    return rows, maps


def main(argv: list[str] | None = None) -> None:
    """Measure the logs and publish the tables."""
    parser = make_parser(__doc__, backend="auto", data=True)
    parser.add_argument("--log", action="append", choices=LOGS, help="default: all")
    parser.add_argument("--csm", type=Path, help="a copy of CSM's repository, which is compiled")
    parser.add_argument("--gsl", type=Path, help="where GSL's include and lib are, if the compiler does not find it")
    arguments = parse(parser, argv)
    rows, maps = [], []
    for name in arguments.log or LOGS:
        found, made = measured(load(Path(arguments.data), name), arguments)
        rows += found
        maps += [made] if made is not None else []

    def drift(row: dict[str, Any], length: int) -> str:
        if row[f"drift_{length}_percent"] is None:
            return "-"
        return f"{row[f'drift_{length}_percent']:.2f} / {row[f'drift_{length}_degrees']:.3f}"

    def closed(row: dict[str, Any]) -> str:
        if not row.get("closures"):
            return "-"
        return f"{row['closures']}, {row['contradicted']} of {row['compared']}, {row['fit_better']}"

    columns = [
        "log",
        "method",
        "error m",
        "drift 5 m: % / deg/m",
        "20 m",
        "100 m",
        "closures, contradicted, fit better",
        "wrong motions, said",
        "s",
    ]
    lines = [
        [
            row["log"], row["method"], f"{row['error_m']:.3f}", *(drift(row, length) for length in LENGTHS),
            closed(row),
            f"{row['wrong_motions']}, {row['said']}" if "said" in row else "-",
            f"{row['seconds']:.1f}" if row["seconds"] else "-",
        ]
        for row in rows
    ]  # fmt: skip
    held = [
        [made["log"], *(f"{made[name][0]:.1f} / {made[name][1]:.1f} %" for name in ("chain", "reference"))]
        for made in maps
    ]
    text = table(columns, lines) + "\n\n" + table(["log", "held out: chain", "held out: reference"], held)
    text += "\n\n" + groups_table(rows)
    publish(__file__, arguments, text, {"rows": rows, "maps": maps})


if __name__ == "__main__":
    main()
