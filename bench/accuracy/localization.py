"""Track recorded logs with the particle filter: errors, losses, coverage and global starts.

Maps are those of the even scans, measurements the odd scans, increments the raw odometry of
``carmen_logs/odometry``. Runs begin with a normal density of variances 0.25, 0.25 m^2 and 0.0685 rad^2 around the
first logged pose. A run is lost if the median error of its last tenth is above 1 m.

    python bench/accuracy/localization.py --seeds 3 --out localization.json
"""

from __future__ import annotations

import argparse
import gzip
import json
import os
import time
from pathlib import Path

import numpy as np

import gpusense as gs
from gpusense.evaluation.coverage import REGIONS
from gpusense.evaluation.machine import machine
from gpusense.evaluation.tracking import START
from gpusense.localization.defaults import DEFAULTS

LOGS = {"intel": "intel", "csail": "csail", "fr079": "freiburg-079"}


def load(name):
    folder = Path(os.environ["GPUSENSE_DATA"]) / "carmen_logs"
    scans = list(gs.read_log(folder / f"{LOGS[name]}-corrected.log.gz"))
    grid = gs.read_map(folder / "derived_maps" / f"{LOGS[name]}_even_05cm.yaml")
    with gzip.open(folder / "odometry" / f"{name}_odom.csv.gz", "rt") as file:
        odometry = np.loadtxt(file, delimiter=",", skiprows=1)[:, 1:]
    return scans, grid, odometry


def field(grid, scanner, backend, **options):
    return gs.LikelihoodFieldModel(
        grid, scanner, gs.LikelihoodFieldParameters(**DEFAULTS.field), backend=backend, **options
    )


def track(data, model, limit, **options):
    """Return errors, squared distances and times of a run."""
    scans, _, odometry = data
    odd = list(range(1, len(scans), 2))[:limit]
    pf = gs.ParticleFilter(model, **options)
    pf.initialize(mean=scans[1].pose, covariance=np.diag(np.square(START)))
    rows, begin = [], time.perf_counter()
    for before, at in zip([None, *odd], odd, strict=False):
        if before is not None:
            pf.predict(odometry[before], odometry[at])
        pf.correct(scans[at].ranges)
        e = pf.estimate()
        d = e.pose - np.array(scans[at].pose)
        d[2] = gs.wrap_angle(d[2])
        squared = d @ np.linalg.solve(e.covariance + 1e-12 * np.eye(3), d)
        # Rank of the true x among weighted particles, for a histogram that is flat where weights are right.
        weights, x = pf.host_weights(), pf.host_particles()[:, 0]
        rank = float(weights[x < scans[at].pose[0]].sum())
        rows.append((np.hypot(d[0], d[1]), abs(d[2]), squared, e.lost, e.temperature, e.explained, rank))
    return np.array(rows, float), (time.perf_counter() - begin) / len(odd) * 1000


def row(name, runs):
    """Return the figures of several runs of one setting."""
    each = [rows for rows, _ in runs]
    late = [rows[len(rows) // 20 :] for rows in each]
    ranks = np.histogram(np.concatenate([rows[:, 6] for rows in late]), bins=10, range=(0, 1))[0]
    result = dict(
        name=name, runs=len(runs),
        median_cm=float(np.median([np.median(rows[:, 0]) for rows in each])) * 100,
        p95_cm=float(np.median([np.percentile(rows[:, 0], 95) for rows in each])) * 100,
        heading_deg=float(np.degrees(np.median([np.median(rows[:, 1]) for rows in each]))),
        lost=int(sum(np.median(rows[-max(len(rows) // 10, 1) :, 0]) > 1 for rows in each)),
        said_lost=float(np.mean([rows[:, 3].mean() for rows in each])),
        nees=float(np.median([np.median(rows[:, 2]) for rows in late])),
        temperature=float(np.median([np.median(rows[:, 4]) for rows in each])),
        explained=float(np.median([np.median(rows[:, 5]) for rows in each])),
        ms=float(np.median([ms for _, ms in runs])), ranks=(ranks / max(ranks.sum(), 1)).round(3).tolist(),
    )  # fmt: skip
    result |= {f"coverage_{k}": float(np.median([(r[:, 2] < v).mean() for r in late])) for k, v in REGIONS.items()}
    print(
        f"{name}: median {result['median_cm']:.1f}, 95 % {result['p95_cm']:.1f} cm, {result['heading_deg']:.2f} deg, "
        f"lost {result['lost']} of {len(runs)}, said lost {result['said_lost']:.3f}, coverage "
        f"{result['coverage_50']:.2f} {result['coverage_80']:.2f} {result['coverage_95']:.2f}, "
        f"NEES {result['nees']:.2f}, T {result['temperature']:.3f}, {result['ms']:.1f} ms",
        flush=True,
    )
    return result


def global_starts(data, backend, starts, particles, scans_each=15):
    """Return the share of starts anywhere on the map that have converged after some scans, and the time of a scan."""
    scans, grid, odometry = data
    model, good = field(grid, scans[0].scanner, backend), 0
    odd = list(range(1, len(scans), 2))
    begin = time.perf_counter()
    for seed in range(starts):
        first = int(np.random.default_rng(seed).integers(0, len(odd) - scans_each))
        pf = gs.ParticleFilter(model, particles=particles, seed=seed)
        pf.initialize_uniform()
        near = []
        for k, at in enumerate(odd[first : first + scans_each]):
            if k:
                pf.predict(odometry[odd[first + k - 1]], odometry[at])
            pf.correct(scans[at].ranges)
            d = pf.estimate().pose - np.array(scans[at].pose)
            near.append(np.hypot(d[0], d[1]) < 1 and abs(gs.wrap_angle(d[2])) < np.radians(20))
        good += all(near[-3:])
    ms = (time.perf_counter() - begin) / (starts * scans_each) * 1000
    print(
        f"global starts, {particles} particles: {good} of {starts} within {scans_each} scans, {ms:.1f} ms a scan",
        flush=True,
    )
    return dict(name="global starts", particles=particles, runs=starts, good=good, scans=scans_each, ms=ms)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="opencl")
    parser.add_argument("--logs", nargs="+", default=list(LOGS))
    parser.add_argument("--particles", nargs="+", type=int, default=[500, 2000])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--limit", type=int, help="scans of each log")
    parser.add_argument("--starts", type=int, default=20, help="global starts on intel")
    parser.add_argument("--start-particles", nargs="+", type=int, default=[DEFAULTS.particles_everywhere])
    parser.add_argument("--coverage", action="store_true", help="compare temperatures and thinning")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    results = []
    for name in args.logs:
        data = load(name)
        scans, grid, odometry = data
        odd = list(range(1, len(scans), 2))
        fitted = gs.fit_odometry_motion(odometry[odd], np.array([scans[i].pose for i in odd])).motion
        model = field(grid, scans[0].scanner, args.backend)
        for count in args.particles:
            for motion, words in ((None, "default noise"), (fitted, "fitted noise")):
                options = dict(particles=count, motion=motion)
                runs = [track(data, model, args.limit, seed=seed, **options) for seed in range(args.seeds)]
                if runs:
                    results.append(row(f"{name}, {count} particles, {words}", runs))
        if args.coverage:
            for words, temperature, options in (
                ("plain product", 1.0, {}), ("temperature 0.1", 0.1, {}), ("20 beams, product", 1.0, dict(beams=20)),
                ("60 beams, product", 1.0, dict(beams=60)), ("auto", "auto", {}),
                ("60 beams, auto", "auto", dict(beams=60)),
            ):  # fmt: skip
                other = field(grid, scans[0].scanner, args.backend, **options)
                run = track(data, other, args.limit, particles=2000, seed=0, temperature=temperature)
                results.append(row(f"{name}, 2000 particles, {words}", [run]))
    if "intel" in args.logs and args.starts:
        results += [global_starts(load("intel"), args.backend, args.starts, count) for count in args.start_particles]
    if args.out is not None:
        args.out.write_text(
            json.dumps(dict(machine=machine(), arguments=vars(args) | {"out": ""}, results=results), indent=1)
        )


if __name__ == "__main__":
    main()
