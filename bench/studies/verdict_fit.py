"""Fit the log-likelihood ratio of a scan (``gpusense/localization/scan_evidence.py``) to simulated runs of filters.

Each run has people, moved and new furniture, glass, another building or a jump at random, and 16 to 360 beams. The
beams of each scan are judged at the estimate, unless its covariance is wide. A logistic regression with half of the
weight on wrong poses gives the coefficients. The tables compare fitted ratios with the counts in bins, and show the
correlation of ratios by the distance between their scans. Poses with errors of 0.5 to 1 m are left out.

Each fourth scan is also searched for on the whole map. A second regression, with the ratio of the scan as an offset,
gives the coefficients of a comparison with other places, from scans whose ratio is above -2; right poses, wrong maps
and right maps have weights of a half and two quarters.

A shard writes its runs to a file; ``--join`` fits the runs of all shards.

    python bench/studies/verdict_fit.py --runs 200 --output verdict_fit
    python bench/studies/verdict_fit.py --runs 200 --shard 1/16 --raw fit_1.npz
    python bench/studies/verdict_fit.py --join fit_*.npz --output verdict_fit
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
import verdict_runs as runs
from common import command_line, make_parser, parse, part_of, publish, table
from scipy.optimize import minimize

import gpusense as gs
from gpusense._util.progress import progress
from gpusense.localization.beam_consistency import beam_consistency, counts_of
from gpusense.localization.rival_search import RivalSearch
from gpusense.localization.scan_evidence import (
    BY_CHANCE,
    FARTHEST,
    FEW,
    HALF,
    IS_FOUND,
    NEAREST,
    OF_LEAD,
    ratio_of_scan,
)
from gpusense.localization.spread import is_wide

EDGES = (-math.inf, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, math.inf)
WAYS = (0.0, 0.1, 0.3, 0.6, 1.0, 1.5, 2.5, 4.0)
# Scans from one search to the next; least ratio of a scan in the regression of comparisons.
SEARCHED, DOUBTFUL = 4, -2.0


def follow(seed, args):
    """Return rows of scans with a narrow covariance: whether the pose is wrong, ``Counts``, x, y; and of comparisons.

    A comparison has: whether the pose is wrong, whether the map is, ratio of the scan, lead, beams, ratio of the beams
    at the other place, whether found.
    """
    rng = np.random.default_rng((5, seed))
    case = ("own", "own", "kidnapped", "wrong")[int(rng.integers(4))]
    people, moved, glass = (
        float(rng.choice([0, 0.1, 0.3])),
        float(rng.choice([0, 0.1, 0.3])),
        rng.choice([0, 0, 0.1, 0.2]),
    )
    grid, scanner, events = runs.simulated(
        2_000_000 + seed, scans=60, hidden=people, moved=moved, glass=float(glass),
        beams=int(rng.choice([16, 36, 180, 180, 360])), around=bool(rng.integers(2)),
        step=float(rng.choice([0.05, 0.15, 0.3])), case=case,
    )  # fmt: skip
    models = [recordings.field(args.backend, beams=60)(grid, scanner)]
    everywhere = case == "wrong" and bool(rng.integers(2))
    pf = gs.ParticleFilter(models, particles=2000 if everywhere else 500, seed=seed)
    # No place on another map is the true one.
    start = gs.worlds.free_pose(grid, rng, 0.2) if case == "wrong" and not everywhere else events[0].truth
    recordings.start_at(pf, None if everywhere else start)
    rows, compared = [], []
    for k, event in enumerate(recordings.play(pf, models, events)):
        pose, covariance = pf.mean_and_covariance()
        position, heading = recordings.errors(pose, event.truth)
        wrong = case == "wrong" or position > 1 or heading > 0.5
        if is_wide(covariance) or (not wrong and (position > 0.5 or heading > 0.25)):
            continue
        found = beam_consistency(grid, scanner, pose, event.ranges, covariance)
        rows.append((wrong, *counts_of([found]), *pose[:2]))
        if k % SEARCHED == SEARCHED - 1:
            tracker = pf._parts.tracker
            search, readings = RivalSearch(tracker.sensors), list(pf._parts.last.items())
            best = search.found(pose, covariance, readings, tracker.key(), pf.options.temperature)
            compared.append(
                (wrong, case == "wrong", ratio_of_scan([found]), best.lead, best.beams, best.walls, best.is_found)
            )
    return np.array(rows, np.float64).reshape(-1, 8), np.array(compared, np.float64).reshape(-1, 7)


def regression(design, wrong):
    """Return the coefficients of a logistic regression with equal weights of both classes."""
    weight = np.where(wrong, 0.5 / wrong.mean(), 0.5 / (1 - wrong.mean()))

    def loss(coefficients):
        z = design @ coefficients
        p = 1 / (1 + np.exp(-z))
        value = float((weight * np.logaddexp(0, np.where(wrong, -z, z))).mean())
        return value, design.T @ (weight * (p - wrong)) / len(z)

    return minimize(loss, np.zeros(design.shape[1]), jac=True, method="BFGS").x


def run_shard(args):
    """Return the rows of each run of a shard: of its scans, and of its comparisons."""
    first, count = args.shard
    seeds, begin, found = range(first - 1, args.runs, count), time.time(), []
    with progress(len(seeds)) as step:
        for seed in seeds:
            if args.seconds is not None and time.time() - begin > args.seconds:
                break
            step(f"run {seed}")
            found.append(follow(seed, args))
    return found


def write_shard(args):
    """Run a shard and write its rows."""
    found = run_shard(args)
    each, compared = ([rows[k] for rows in found] for k in (0, 1))
    np.savez_compressed(
        args.raw, scans=np.concatenate(each), lengths=[len(rows) for rows in each], compared=np.concatenate(compared),
        command=command_line("bench/studies/verdict_fit.py"),
    )  # fmt: skip
    print(f"{len(each)} runs: {args.raw}")


def joined(files):
    """Return the rows of the scans of each run, the rows of all comparisons, and the commands of shards."""
    each, compared, commands = [], [], []
    for file in files:
        with np.load(file) as data:
            each += np.split(data["scans"], np.cumsum(data["lengths"])[:-1])
            compared.append(data["compared"])
            commands.append(str(data["command"]))
    return each, np.concatenate(compared), commands


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--shard", type=part_of, default=(1, 1), metavar="I/N")
    parser.add_argument("--seconds", type=float, help="begin no more runs of the shard after this time")
    parser.add_argument("--raw", type=Path, help="write the shard's runs to this file and fit nothing")
    parser.add_argument("--join", type=Path, nargs="+", help="files of shards to fit")
    args = parse(parser)
    if args.raw is not None:
        write_shard(args)
        return
    if args.join is not None:
        each, compared, commands = joined(args.join)
    else:
        found = run_shard(args)
        each, compared = [rows[0] for rows in found], np.concatenate([rows[1] for rows in found])
        commands = []
    text, results = fitted(each, compared)
    remark = "Shards: " + "; ".join(f"`{command}`" for command in commands) + "." if commands else ""
    publish(__file__, args, text, dict(commands=commands, results=results), remark)


def fitted(each, compared):
    """Return the tables of the fits to the scans of each run and to all comparisons, and their coefficients."""
    rows = np.concatenate(each)
    wrong, (agree, close, through, short, nothing) = rows[:, 0] > 0, rows[:, 1:6].T
    informative_count = agree + through + short
    features = [
        np.log((one + 0.5) / (other + 0.5))
        for one, other in ((through, agree), (agree - close, close), (nothing, informative_count), (short, agree))
    ]
    weight = informative_count / (informative_count + FEW)
    design = weight[:, None] * np.column_stack([np.ones(len(rows)), *features])
    chosen = regression(design[:, :4], wrong)
    with_short, through_only = regression(design, wrong), regression(design[:, :2], wrong)
    ratio = design[:, :4] @ chosen
    counts = []
    for low, high in itertools.pairwise(EDGES):
        inside = (ratio >= low) & (ratio < high)
        right, off = int((inside & ~wrong).sum()), int((inside & wrong).sum())
        counted = math.log((off + 0.5) / wrong.sum()) - math.log((right + 0.5) / (~wrong).sum())
        counts.append((f"{low} to {high}", right, off, f"{counted:.2f}"))
    of_places, searched = comparisons(compared)
    text = "\n\n".join([
        f"BIAS, SLOPE, BLUNT, NOTHING {_listed(chosen)}; SLOPE alone {_listed(through_only)}; with the short beams "
        f"{_listed(with_short)}",
        f"OF_LEAD, BY_CHANCE, IS_FOUND {_listed(of_places)}, of {searched} searches",
        f"{len(rows)} scans of {len(each)} runs, {100 * wrong.mean():.0f} % at wrong poses",
        table(("fitted ratio", "right", "wrong", "ratio of the counts"), counts),
        table(("way between scans [m]", "pairs", "correlation of ratios at right poses"),
              correlations(each, np.split(ratio, np.cumsum([len(one) for one in each])[:-1]))),
    ])  # fmt: skip
    results = dict(coefficients=chosen.tolist(), with_short=with_short.tolist(), scans=len(rows),
                   comparisons=of_places.tolist(), searches=searched)  # fmt: skip
    return text, results


def comparisons(rows):
    """Return weight of the lead, what it gains by chance and the evidence of a pose that is found, by a regression."""
    rows = rows[np.isfinite(rows[:, 2]) & ~np.isnan(rows[:, 3]) & (rows[:, 4] > 0) & (rows[:, 2] > DOUBTFUL)]
    wrong, other, ratio, lead, beams, walls, is_found = rows.T
    wrong = wrong > 0
    weight = np.zeros(len(rows))
    for chosen, share in ((~wrong, 0.5), (wrong & (other > 0), 0.25), (wrong & (other == 0), 0.25)):
        weight[chosen] = share / max(chosen.sum(), 1)
    information = beams / (beams + HALF)
    design = np.column_stack([np.clip(lead, NEAREST, FARTHEST), -information, -information * is_found])
    possible = 1 / (1 + np.exp(walls))

    def loss(coefficients):
        plain = design @ coefficients
        z = ratio + np.where(plain > 0, np.log1p(possible * np.expm1(np.maximum(plain, 0))), plain)
        return float(weight @ np.logaddexp(0, np.where(wrong, -z, z)))

    return minimize(loss, (OF_LEAD, BY_CHANCE, IS_FOUND), method="Nelder-Mead").x, len(rows)


def _listed(values):
    return ", ".join(f"{value:.2f}" for value in values)


def correlations(each, ratios):
    """Return the rows of a table: correlation of the ratios of right poses by the distance between them."""
    pairs = []
    for rows, ratio in zip(each, ratios, strict=True):
        right = rows[:, 0] == 0
        place, value = rows[right, 6:8], ratio[right]
        for lag in (1, 2, 4, 8, 16):
            if len(value) > lag:
                way = np.hypot(*(place[lag:] - place[:-lag]).T)
                pairs.append(np.column_stack([way, value[:-lag], value[lag:]]))
    way, one, two = np.concatenate(pairs).T
    mean, lines = float(np.mean(one)), []
    for low, high in itertools.pairwise(WAYS):
        chosen = (way >= low) & (way < high)
        if chosen.sum() > 10:
            a, b = one[chosen] - mean, two[chosen] - mean
            rho = float((a * b).mean() / math.sqrt((a * a).mean() * (b * b).mean()))
            lines.append((f"{low} to {high}", int(chosen.sum()), f"{rho:.2f}"))
    return lines


if __name__ == "__main__":
    main()
