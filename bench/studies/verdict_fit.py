"""Fit the log-likelihood ratio of a scan (``gpusense/localization/ratio.py``) to simulated runs of filters.

Each run has people, moved and new furniture, glass, another building or a jump at random, and 16 to 360 beams. The
beams of each scan are judged at the estimate, unless its covariance is wide. A logistic regression with half of the
weight on wrong poses gives the coefficients. The tables compare fitted ratios with the counts in bins, and show the
correlation of ratios by the distance between their scans. Poses with errors of 0.5 to 1 m are left out.

    python bench/studies/verdict_fit.py --runs 200 --output verdict_fit
"""

from __future__ import annotations

import itertools
import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
import verdict_runs as runs
from common import make_parser, parse, publish, table
from scipy.optimize import minimize

import gpusense as gs
from gpusense._util.progress import progress
from gpusense.localization.passages import counts_of, passages
from gpusense.localization.ratio import FEW
from gpusense.localization.spread import deviations, is_wide

EDGES = (-math.inf, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, math.inf)
WAYS = (0.0, 0.1, 0.3, 0.6, 1.0, 1.5, 2.5, 4.0)


def follow(seed, args):
    """Return a row for each scan with a narrow covariance: whether the pose is wrong, ``Counts``, x, y."""
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
    rows = []
    for event in recordings.play(pf, models, events):
        pose, covariance = pf.mean_and_covariance()
        position, heading = recordings.errors(pose, event.truth)
        wrong = case == "wrong" or position > 1 or heading > 0.5
        if is_wide(covariance) or (not wrong and (position > 0.5 or heading > 0.25)):
            continue
        found = passages(grid, scanner, pose, event.ranges, deviations(covariance))
        rows.append((wrong, *counts_of([found]), *pose[:2]))
    return np.array(rows, np.float64).reshape(-1, 8)


def regression(design, wrong):
    """Return the coefficients of a logistic regression with equal weights of both classes."""
    weight = np.where(wrong, 0.5 / wrong.mean(), 0.5 / (1 - wrong.mean()))

    def loss(coefficients):
        z = design @ coefficients
        p = 1 / (1 + np.exp(-z))
        value = float((weight * np.logaddexp(0, np.where(wrong, -z, z))).mean())
        return value, design.T @ (weight * (p - wrong)) / len(z)

    return minimize(loss, np.zeros(design.shape[1]), jac=True, method="BFGS").x


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--runs", type=int, default=200)
    args = parse(parser)
    with progress(args.runs) as step:
        each = []
        for seed in range(args.runs):
            step(f"run {seed}")
            each.append(follow(seed, args))
    rows = np.concatenate(each)
    wrong, (agree, close, through, short, nothing) = rows[:, 0] > 0, rows[:, 1:6].T
    telling = agree + through + short
    features = [
        np.log((one + 0.5) / (other + 0.5))
        for one, other in ((through, agree), (agree - close, close), (nothing, telling), (short, agree))
    ]
    weight = telling / (telling + FEW)
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
    text = "\n\n".join([
        f"BIAS, SLOPE, BLUNT, NOTHING {_listed(chosen)}; SLOPE alone {_listed(through_only)}; with the short beams "
        f"{_listed(with_short)}",
        f"{len(rows)} scans of {args.runs} runs, {100 * wrong.mean():.0f} % at wrong poses",
        table(("fitted ratio", "right", "wrong", "ratio of the counts"), counts),
        table(("way between scans [m]", "pairs", "correlation of ratios at right poses"),
              correlations(each, np.split(ratio, np.cumsum([len(one) for one in each])[:-1]))),
    ])  # fmt: skip
    results = dict(coefficients=chosen.tolist(), with_short=with_short.tolist(), scans=len(rows))
    publish(__file__, args, text, dict(results=results))


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
