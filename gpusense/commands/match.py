"""Run ``gpusense match``: match the scans of a log to each other, or to a map."""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import gpusense as gs
from gpusense.commands import output
from gpusense.commands.arguments import Options, csv_file, not_negative_number, picture, positive_number, tum_file
from gpusense.commands.output import counted, degrees, draw, length, write_table
from gpusense.commands.scans import add_log, read_posed_steps, write_trajectory
from gpusense.commands.signals import working
from gpusense.evaluation import matching
from gpusense.matching import result as match_result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from gpusense.evaluation.matching import LogMatches

FIRST = ("log", "map", "reference", "tum", "plot")
SHARED = ("reference", "choice", "backend", "seed", "verbose")

EPILOG = """\
Each scan is matched to the one before, from the odometry's guess; with --map to the map, from its logged pose. Errors
are those against the logged poses, where the log has them. A match is wrong beyond 0.2 m or 5 degrees.
examples:
  gpusense match --log run.log.gz --limit 300
  gpusense match --log run.log.gz --guess identity --plot worst.png
  gpusense match --log run.bag --topic /scan --noise 0.03 --tum run.tum
  gpusense match --log run.log.gz --map map.yaml --shift 0.5 --turn 10 \\
      --out poses.csv"""

_COLUMNS = (
    "reference", "scan", "x", "y", "theta", "deviation_x", "deviation_y", "deviation_theta", "score", "status",
)  # fmt: skip


def add_options(add: Options) -> None:
    """Add the command's options."""
    add_log(add, "a log with scans")
    add("--map YAML", "a map_server map to which all scans are matched", Path)
    add("--guess", "the guess of each match (default: odometry, with --map logged)", ("odometry", "logged", "identity"))
    add("--shift M", "change guesses by up to this in x and in y, uniformly at random [m]", not_negative_number, 0.0)
    add("--turn DEG", "change headings of guesses by up to this [degrees]", not_negative_number, 0.0)
    add("--method", "method of match_scan", ("auto", "icp", "gauss_newton", "correlative"), "auto")
    add("--noise M", "standard deviation of ranges [m] (default: by match_scan, from the scans)", positive_number)
    add("--out CSV", "write poses, deviations and statuses", csv_file)
    add("--tum FILE", "write the trajectory: matches chained from the first scan on, or poses in the map; a failed "
        "match is replaced by its guess", tum_file)  # fmt: skip
    add("--plot FILE", "draw the match with the largest correction, before and after", picture)


def run(args: argparse.Namespace) -> int:
    """Match the scans and print the results; after Ctrl-C, the results so far."""
    grid = None if args.map is None else gs.read_map(args.map)
    scans = [(step.index, step.scan) for step in read_posed_steps(args)]
    parts: list[LogMatches] = []
    begun = time.perf_counter()
    calls = matching.match_log(
        scans, grid, guess=args.guess or ("odometry" if grid is None else "logged"), method=args.method,
        backend=args.backend, spread=(args.shift, math.radians(args.turn)), seed=args.seed, noise=args.noise,
    )  # fmt: skip
    with working(parts, len(scans)) as step:
        for part in calls:
            parts.append(part)
            for _ in part.indices:
                step(f"scan {part.indices[-1, 1]}")
    _report(args, grid, scans, parts, time.perf_counter() - begun)
    return 0


def _report(
    args: argparse.Namespace,
    grid: gs.OccupancyGrid | None,
    scans: list[tuple[int, gs.Scan]],
    parts: list[LogMatches],
    seconds: float,
) -> None:
    """Print and write the results of all matches, or of the matches before an interrupt."""
    matches = matching.joined(parts)
    total = matching.summary(matches) | {"milliseconds_each": 1e3 * seconds / len(matches.match)}
    match, first = matches.match, scans[0][1]
    deviations = np.sqrt(np.einsum("sii->si", match.covariance))
    columns = (*matches.indices.T, *match.pose.T, *deviations.T, match.score, match.status)
    write_table(args.out, **dict(zip(_COLUMNS, columns, strict=True)))
    poses = matching.trajectory(matches, np.array(first.odometry if first.pose is None else first.pose))
    write_trajectory(args.tum, [scan.time for _, scan in scans[: len(poses)]], poses)
    draw(args.plot, lambda: _worst(grid, dict(scans), matches))
    if args.json:
        names = ("pose", "covariance", "score", "iterations", "converged", "eigenvalues", "status")
        columns = (*matches.indices.T, *(getattr(match, name) for name in names))
        rows = [dict(zip(("reference", "scan", *names), row, strict=True)) for row in zip(*columns, strict=True)]
        output.report({"scans_chosen": len(scans), "summary": total, "matches": rows}, args)
        return
    _print(total)
    output.interrupted(len(match), len(scans) - (grid is None), "matches")
    output.files(args.out, args.plot, args.tum)
    output.details(args, f"score: median {total['score_median']:.3f}\n{total['milliseconds_each']:.3g} ms each with "
                   "the first call's compilation")  # fmt: skip


def _print(total: dict[str, Any]) -> None:
    """Print the share of matches that converged, their errors or corrections, and the reasons of the others."""
    count, statuses = total["matches"], total["statuses"]
    good = statuses.get("converged", 0) + statuses.get("unobservable", 0)
    known = total["wrong"] is not None
    kind, prefix = ("error", "") if known else ("correction", "correction_")
    median, most = (
        f"{length(total[f'{prefix}position_{name}'])} and {degrees(total[f'{prefix}heading_{name}'])} degrees"
        for name in ("median", "p95")
    )
    verdict = "MATCHED" if good == count else "PARTLY MATCHED" if good else "NO MATCH"
    output.result(f"{verdict}: {good} of {counted(count, 'scan')} agree; median {kind} {median}")
    output.fact(kind, f"95 % below {most}" + (f"; {total['wrong']} wrong, beyond 0.2 m or 5 degrees" if known else ""))
    if known:
        output.fact("guesses", f"median error {length(total['guess_position_median'])} and "
                    f"{degrees(total['guess_heading_median'])} degrees")  # fmt: skip
    for status, number in statuses.items():
        if status != "converged":
            output.fact("status", f"{number} {status}: {match_result.STATUSES[status]}")


def _worst(grid: gs.OccupancyGrid | None, scans: dict[int, gs.Scan], matches: LogMatches) -> Figure:
    """Draw the match with the largest correction."""
    from gpusense.plots.runs import match_figure

    distance, turn = matching.differences(matches.match.pose, matches.guess)
    worst = int(np.argmax(distance + turn * matches.match.lever / 10))
    first, second = matches.indices[worst]
    scan = scans[int(second)]
    reference = scans[int(first)].ranges if grid is None else grid
    return match_figure(reference, scan.ranges, scan.scanner, matches.guess[worst], matches.match.pose[worst])
