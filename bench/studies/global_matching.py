"""Localise recorded scans without a guess, match local maps, build maps, and compare with brute force.

    python bench/studies/global_matching.py --data DATA --output bench/results/global_matching_cpu
    python bench/studies/global_matching.py --data DATA --part locate --scans 20

``locate``: odd scans of a log in the map of its even scans by ``locate_scan`` (5 cm, 1 degree, 180 beams), and scans of
another building, which must not be found. ``window``: 41 x 41 x 61 poses, 360 end points, by brute force and by branch
and bound. ``large``: a map of 2000 x 2000 cells. ``maps``: ``build_map`` of even scans beside the derived map: share of
odd end points near an obstacle, and mean log-likelihoods of odd scans. ``match``: local maps of 20 odd scans in the
global map. ``olin``: scans of a robot with a turned scanner in its map.
"""

from __future__ import annotations

import functools
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.matching.score_tables import ScoreTables, field_scores
from gpusense.matching.search import PoseGrid, Search

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import recordings
from common import best, make_parser, note, odd_scans, parse, publish, table

PAIRS = (("intel", "intel"), ("csail", "csail"), ("intel", "csail"), ("csail", "intel"))
# Errors of a pose that counts as right [m, degrees].
RIGHT = (0.5, 5.0)


def off(pose: np.ndarray, truth: Any) -> tuple[float, float]:
    """Return the errors of a pose [m, degrees]."""
    distance, turn = recordings.errors(pose, truth)
    return distance, float(np.degrees(turn))


def evenly(items: list[Any], count: int) -> list[Any]:
    """Return at most ``count`` items, evenly chosen."""
    return items if len(items) <= count else [items[i * len(items) // count] for i in range(count)]


def locate(backend: str, arguments: Any) -> list[dict[str, Any]]:
    """Localise odd scans in their own and in another building's map."""
    rows = []
    for log, place in PAIRS:
        grid, _ = odd_scans(arguments.data, place)
        _, scans = odd_scans(arguments.data, log)
        chosen = evenly(scans, arguments.scans)
        model = gs.LikelihoodFieldModel(grid, chosen[0][1].scanner, backend=backend, beams=180)
        rows.append({"log": log, "map": place} | located(model, [(s.ranges, s.pose) for _, s in chosen]))
        note(f"{backend} {log} in {place}")
    return rows


def located(model: gs.LikelihoodFieldModel, scans: list[tuple[np.ndarray, Any]]) -> dict[str, Any]:
    """Localise scans and return shares, errors, times and evaluations."""
    gs.locate_scan(model, scans[0][0])
    errors, status, seconds, share = [], [], [], []
    for ranges, pose in scans:
        begin = time.perf_counter()
        found = gs.locate_scan(model, ranges)
        seconds.append(time.perf_counter() - begin)
        errors.append(off(found.pose, pose))
        status.append(found.status)
        share.append(found.evaluated / found.poses)
    right = np.array([position < RIGHT[0] and heading < RIGHT[1] for position, heading in errors])
    told = np.array(status)
    return {
        "scans": len(scans), "right": float(right.mean()), "found": float((told == "found").mean()),
        "found_wrong": int(((told == "found") & ~right).sum()), "ambiguous": float((told == "ambiguous").mean()),
        "no_match": float((told == "no match").mean()),
        "error_median": [float(np.median(np.array(errors)[right, i])) if right.any() else None for i in (0, 1)],
        "milliseconds_median": 1e3 * float(np.median(seconds)),
        "milliseconds_95": 1e3 * float(np.quantile(seconds, 0.95)), "evaluated_median": float(np.median(share)),
    }  # fmt: skip


def window(backend: str, arguments: Any) -> list[dict[str, Any]]:
    """Search 41 x 41 x 61 poses around an offset guess by brute force, then by branch and bound."""
    grid, scans = odd_scans(arguments.data, "intel")
    distances = gs.distance_transform(grid.occupied, resolution=grid.resolution, backend=backend)
    scan = scans[50][1]
    near = scan.ranges < 20
    ends = scan.ranges[near, None] * np.stack([np.cos(scan.scanner.bearings), np.sin(scan.scanner.bearings)], 1)[near]
    points = np.resize(ends, (360, 2)) / grid.resolution
    guess = np.array([[*(grid.world_to_cells([scan.pose[:2]])[0] + [4, -7]), scan.pose[2] + 0.1]])
    poses = PoseGrid.around(guess, (20, 20), 30, np.radians(0.5))
    search = Search(ScoreTables(get_backend(backend), field_scores(distances, 0.1, 1.0), levels=3))
    rows, scores = [], []
    for level in (0, 1, 2, 3):
        found = search.find([points], poses, level=level)
        shortest, median = best(lambda level=level: search.find([points], poses, level=level), arguments.repeats, 5.0)
        scores.append((int(found.score[0]), int(found.row[0]), int(found.col[0]), int(found.heading[0])))
        rows.append({"level": level, "poses": poses.count, "points": len(points), "milliseconds": 1e3 * shortest,
                     "milliseconds_median": 1e3 * median, "evaluated": found.evaluated / poses.count})  # fmt: skip
    assert len(set(scores)) == 1, scores
    return rows


def large(backend: str, arguments: Any) -> list[dict[str, Any]]:
    """Localise scans of csail in its map, padded by unknown cells to 2000 x 2000 cells."""
    grid, scans = odd_scans(arguments.data, "csail")
    cells = np.full((2000, 2000), -1, np.int8)
    cells[: grid.shape[0], : grid.shape[1]] = grid.cells
    roomy = gs.OccupancyGrid(cells, grid.resolution, grid.origin)
    chosen = evenly(scans, max(arguments.scans // 4, 2))
    model = gs.LikelihoodFieldModel(roomy, chosen[0][1].scanner, backend=backend, beams=180)
    return [{"log": "csail", "map": "csail, 2000 x 2000"} | located(model, [(s.ranges, s.pose) for _, s in chosen])]


def agreement(grid: gs.OccupancyGrid, scans: list[Any], backend: str) -> dict[str, Any]:
    """Return the share of end points near an obstacle, and mean log-likelihoods of scans, of ranges below 20 m."""
    scanner = scans[0].scanner
    distances = gs.distance_transform(grid.occupied, resolution=grid.resolution, backend=backend)
    ends = np.concatenate([
        np.array(s.pose[:2]) + (s.ranges[:, None] * np.stack(
            [np.cos(s.pose[2] + scanner.bearings), np.sin(s.pose[2] + scanner.bearings)], axis=1))[s.ranges < 20]
        for s in scans
    ])  # fmt: skip
    col, row = np.floor(grid.world_to_cells(ends)).astype(int).T
    inside = (col >= 0) & (col < grid.shape[1]) & (row >= 0) & (row < grid.shape[0])
    near = np.full(len(ends), np.inf)
    near[inside] = distances[row[inside], col[inside]]
    models = (
        gs.LikelihoodFieldModel(grid, scanner, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend=backend),
        gs.BeamModel(grid, scanner, gs.BeamParameters(sigma_hit=0.1), backend=backend),
    )
    log_p = [
        float(np.mean([model.log_likelihood(np.array([s.pose]), np.where(s.ranges < 20, s.ranges, np.nan))[0]
                       for s in scans[::3]]))
        for model in models
    ]  # fmt: skip
    return {"within_5_cm": float((near < 0.051).mean()), "within_15_cm": float((near < 0.151).mean()),
            "occupied": int(grid.occupied.sum()), "field": log_p[0], "beam": log_p[1]}  # fmt: skip


def maps(backend: str, arguments: Any) -> list[dict[str, Any]]:
    """Build maps of even scans, and compare them and the derived maps with odd scans."""
    rows = []
    for log in ("intel", "csail", "aces", "belgioioso"):
        derived, odd = odd_scans(arguments.data, log)
        scans = list(gs.read_log(arguments.data / f"carmen_logs/{log}-corrected.log.gz"))[::2]
        build = functools.partial(
            gs.build_map, [s.ranges for s in scans], [s.pose for s in scans], scans[0].scanner, range_limit=20.0,
            backend=backend,
        )  # fmt: skip
        tests = [scan for _, scan in evenly(odd, 3 * arguments.scans)]
        built = build()
        shortest, _ = best(build, 3, 5.0)
        for name, grid in (("build_map", built), ("derived map", derived)):
            rows.append({"log": log, "map": name, "scans": len(scans)} | agreement(grid, tests, backend)
                        | ({"milliseconds": 1e3 * shortest} if name == "build_map" else {}))  # fmt: skip
        note(f"{backend} map of {log}")
    return rows


def match(backend: str, arguments: Any) -> list[dict[str, Any]]:
    """Match local maps of 20 odd scans with the global map, without and with a guess."""
    rows = []
    for log in ("intel", "csail"):
        grid, odd = odd_scans(arguments.data, log)
        firsts = range(0, len(odd) - 20, max((len(odd) - 20) // max(arguments.scans // 10, 1), 1))
        for guessed in (False, True):
            errors, status, seconds = [], [], []
            for first in firsts:
                part = [scan for _, scan in odd[first : first + 20]]
                base = np.array(part[0].pose)
                poses = np.array([s.pose for s in part]) - [*base[:2], base[2]]
                cos, sin = np.cos(base[2]), np.sin(base[2])
                poses[:, :2] = poses[:, :2] @ np.array([[cos, -sin], [sin, cos]])
                local = gs.build_map(
                    [s.ranges for s in part], poses, part[0].scanner, range_limit=15.0, backend=backend
                )
                guess = base + np.array([0.3, -0.4, 0.1]) if guessed else None
                begin = time.perf_counter()
                matched = gs.match_map(local, grid, guess, backend=backend)
                seconds.append(time.perf_counter() - begin)
                errors.append(off(matched.pose, base))
                status.append(matched.found)
            right = [position < RIGHT[0] and heading < RIGHT[1] for position, heading in errors]
            rows.append({"log": log, "guess": guessed, "maps": len(errors), "right": float(np.mean(right)),
                         "found": float(np.mean(status)), "error_median": np.median(errors, axis=0).tolist(),
                         "milliseconds_median": 1e3 * float(np.median(seconds))})  # fmt: skip
        note(f"{backend} local maps of {log}")
    return rows


def olin(backend: str, arguments: Any) -> list[dict[str, Any]]:
    """Localise scans of the Olin bag in its map."""
    recording = recordings.load("olin")
    ((grid, scanner),) = recording.places
    model = gs.LikelihoodFieldModel(grid, scanner, backend=backend, beams=180)
    chosen = evenly([(event.ranges, event.truth) for event in recording.events], arguments.scans)
    return [{"log": "olin", "map": "olin"} | located(model, chosen)]


PARTS = {"locate": locate, "window": window, "large": large, "maps": maps, "match": match, "olin": olin}


def shown(value: Any) -> str:
    """Format a figure."""
    if isinstance(value, list):
        return " / ".join(map(shown, value))
    return f"{value:.4g}" if isinstance(value, float) else "-" if value is None else str(value)


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__, backend="kernels", data=True)
    parser.add_argument("--part", action="append", choices=PARTS, help="default: all")
    parser.add_argument("--scans", type=int, default=200, help="of each log (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=20, help="of the window (default: %(default)s)")
    arguments = parse(parser)
    arguments.data = Path(arguments.data)
    text, report = [], {}
    for name in arguments.part or PARTS:
        rows = [{"device": backend} | row for backend in arguments.backend for row in PARTS[name](backend, arguments)]
        columns = list(dict.fromkeys(key for row in rows for key in row))
        text.append(f"### {name}\n\n{table(columns, [[shown(row.get(key)) for key in columns] for row in rows])}")
        report[name] = rows
    publish(__file__, arguments, "\n\n".join(text), report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
