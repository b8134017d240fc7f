"""Fit the log-likelihood ratio of a scan (``gpusense/localization/ratio.py``) to simulated runs of filters.

Each run has people, moved and new furniture, glass, another building or a jump at random, and 16 to 360 beams. The
beams of each scan are judged at the estimate, if it is not wide. A logistic regression with half of the weight for
wrong poses gives the coefficients. The tables compare fitted ratios with those of the counts in bins, and the
correlation of ratios with the way between their scans. Poses between 0.5 and 1 m off are left out.

    python bench/studies/verdict_fit.py --runs 200 --out verdict_fit.json
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
import verdict_runs as runs
from scipy.optimize import minimize

import gpusense as gs
from gpusense._util.progress import progress
from gpusense.evaluation.machine import machine, machine_line
from gpusense.localization.passages import counts_of, passages
from gpusense.localization.ratio import FEW
from gpusense.localization.spread import deviations, is_wide

EDGES = (-math.inf, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, math.inf)
WAYS = (0.0, 0.1, 0.3, 0.6, 1.0, 1.5, 2.5, 4.0)


def follow(seed, args):
    """Return a row for each scan with a narrow estimate: wrong or not, ``Counts``, x, y."""
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
    model = recordings.field(args.backend, beams=60)(grid, scanner)
    everywhere = case == "wrong" and bool(rng.integers(2))
    pf = gs.ParticleFilter(model, particles=2000 if everywhere else 500, seed=seed)
    if everywhere:
        pf.initialize_uniform()
    else:
        # On another map the truth of this one is nowhere.
        start = gs.worlds.free_pose(grid, rng, 0.2) if case == "wrong" else events[0].truth
        pf.initialize(mean=start, covariance=np.diag(np.square(runs.START)))
    rows = []
    for before, event in zip([None, *events], events, strict=False):
        if before is not None:
            pf.predict(before.odometry, event.odometry)
        pf.correct(event.ranges)
        pose, covariance = pf.mean_and_covariance()
        d = pose - event.truth
        position, heading = math.hypot(d[0], d[1]), abs(math.remainder(d[2], math.tau))
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="opencl")
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--out", type=Path, help="a .json file; the table goes to the .md file beside it")
    args = parser.parse_args()
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
    lines = [f"BIAS, SLOPE, BLUNT, NOTHING {_listed(chosen)}; SLOPE alone {_listed(through_only)}; with the short "
             f"beams {_listed(with_short)}", "",
             f"{len(rows)} scans of {args.runs} runs, {100 * wrong.mean():.0f} % at wrong poses", "",
             "| fitted ratio | right | wrong | ratio of the counts |", "| --- | --- | --- | --- |"]  # fmt: skip
    for low, high in itertools.pairwise(EDGES):
        inside = (ratio >= low) & (ratio < high)
        right, off = int((inside & ~wrong).sum()), int((inside & wrong).sum())
        counted = math.log((off + 0.5) / wrong.sum()) - math.log((right + 0.5) / (~wrong).sum())
        lines.append(f"| {low} to {high} | {right} | {off} | {counted:.2f} |")
    lines += ["", "| way between scans [m] | pairs | correlation of ratios at right poses |", "| --- | --- | --- |"]
    lines += correlations(each, np.split(ratio, np.cumsum([len(one) for one in each])[:-1]))
    print("\n".join(lines))
    if args.out is not None:
        command = " ".join(["bench/studies/verdict_fit.py", *sys.argv[1:]])
        result = dict(coefficients=chosen.tolist(), with_short=with_short.tolist(), scans=len(rows))
        args.out.write_text(json.dumps(dict(machine=machine(), command=command, results=result), indent=1))
        table = "\n".join(lines)
        args.out.with_suffix(".md").write_text(f"{machine_line()}\n\n`python {command}`\n\n{table}\n")


def _listed(values):
    return ", ".join(f"{value:.2f}" for value in values)


def correlations(each, ratios):
    """Return rows of a table: correlation of the ratios of right poses, by the way between them."""
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
            lines.append(f"| {low} to {high} | {int(chosen.sum())} | {rho:.2f} |")
    return lines


if __name__ == "__main__":
    main()
