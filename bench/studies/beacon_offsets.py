"""Fit offsets of ranges to beacons on one half of a recorded run, and test positions on the other half.

    python bench/studies/beacon_offsets.py --data DATA --output bench/results/beacon_offsets

Ranges of recorded features are taken as ranges to beacons. On alternate windows of 10 s, ``fit_beacon_parameters``
learns deviation and weights with no offset, with a common one, or with one for each beacon. In the other windows all
poses are shifted together until the ranges fit best (least squares). The normalised squared error of this shift, e'
C^-1 e (NEES) with C of the fitted deviation, has a mean of 2 for independent errors, and is larger where ranges of a
window share an error. Ranges beyond 4 deviations of the model without offsets are outliers for all models, and are left
out of positions. "simulated" is a radio among 6 beacons with known offsets of 0.1 to 0.5 m and independent noise of
0.15 m.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.evaluation import landmark_runs as lr

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import make_parser, note, parse, publish, table
from studies.landmark_sets import repaired, run_of

SETS = ("simulated", "mrclam_1", "mrclam_2", "mrclam_3", "beacons", "lego")
WINDOW = 10.0
LEAST = 2
KINDS: tuple[Any, ...] = ("none", "common", "each")


@dataclasses.dataclass(frozen=True)
class Ranges:
    """Poses (F, 3), ranges (F,), beacons (F,), windows (F,) and positions (M, 2)."""

    poses: np.ndarray
    ranges: np.ndarray
    ids: np.ndarray
    windows: np.ndarray
    xy: np.ndarray
    range_max: float


def simulated(seed: int) -> Ranges:
    """Draw ranges to 6 beacons with offsets."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 30, (6, 2))
    poses, ids = rng.uniform((0, 0, -3), (30, 30, 3), (6000, 3)), rng.integers(0, 6, 6000)
    offsets = np.linspace(0.1, 0.5, 6)
    z = np.hypot(*(poses[:, :2] - xy[ids]).T) + offsets[ids] + rng.normal(0, 0.15, 6000)
    return Ranges(poses, z, ids, np.arange(6000) // 10, xy, 60.0)


def recorded(data: Path, name: str) -> Ranges:
    """Read the ranges of a run, with its exchanged landmarks repaired."""
    run = run_of(data, name)
    run = repaired(run, lr.suspicions(run, lr.fit_run(run)))
    known = np.flatnonzero(run.ids >= 0)
    scan = run.scan[known]
    windows = (run.time[scan] // WINDOW).astype(int)
    return Ranges(run.truth[scan], run.features[known, 0], run.ids[known], windows, run.landmarks.xy, run.range_max)


def nees(data: Ranges, parameters: gs.BeaconParameters, kept: np.ndarray) -> list[float]:
    """Return e' C^-1 e of each window with at least 2 beacons whose directions differ."""
    offsets = np.broadcast_to(np.array(parameters.bias), (len(data.xy),))
    found = []
    for window in np.unique(data.windows[kept]):
        k = np.flatnonzero(kept & (data.windows == window))
        if len(np.unique(data.ids[k])) < LEAST:
            continue
        moved, z = np.zeros(2), data.ranges[k] - offsets[data.ids[k]]
        for _ in range(20):
            away = data.poses[k, :2] + moved - data.xy[data.ids[k]]
            d = np.hypot(*away.T)
            slopes = away / d[:, None]
            moved = moved + np.linalg.lstsq(slopes, z - d, rcond=None)[0]
        information = slopes.T @ slopes / parameters.sigma_range**2
        if np.linalg.cond(information) < 100:
            found.append(float(moved @ information @ moved))
    return found


def measure(data: Ranges, name: str) -> dict[str, Any]:
    """Return the figures of one run."""
    learn = data.windows % 2 == 0
    fits = {
        bias: gs.fit_beacon_parameters(
            data.poses[learn], data.ranges[learn], data.xy, ids=data.ids[learn], range_max=data.range_max, bias=bias,
            blocks=data.windows[learn],
        )
        for bias in KINDS
    }  # fmt: skip
    distances = np.hypot(*(data.poses[:, :2] - data.xy[data.ids]).T)
    limit = 4 * fits["none"].parameters.sigma_range
    kept = ~learn & (np.abs(data.ranges - distances) < limit)
    rows = []
    for bias, fit in fits.items():
        squares = nees(data, fit.parameters, kept)
        raw = nees(data, fit.parameters.replace(bias=0.0), kept)
        rows.append({"bias": bias, "fit": fit.to_dict(), "windows": len(squares), "nees": mean_of(squares),
                     "median": float(np.median(squares)) if squares else None, "raw": mean_of(raw),
                     "held_out": held_out(data, fit.parameters, ~learn)})  # fmt: skip
    note(name)
    return {"set": name, "ranges": len(data.ranges), "outliers": int((~learn).sum() - kept.sum()), "rows": rows}


def mean_of(values: list[float]) -> float | None:
    """Return the mean; None for no values."""
    return float(np.mean(values)) if values else None


def held_out(data: Ranges, parameters: gs.BeaconParameters, test: np.ndarray) -> float:
    """Return the mean log p of the held-out ranges."""
    model = gs.BeaconModel(data.xy, parameters, backend="numpy", precision="float64")
    each = [model.log_likelihood(data.poses[k][None], [data.ranges[k]], [data.ids[k]])[0]
            for k in np.flatnonzero(test) if 0 <= data.ranges[k] <= parameters.range_max]  # fmt: skip
    return float(np.mean(each))


def to_markdown(sets: list[dict[str, Any]]) -> str:
    """Format the table of all runs."""
    rows = []
    for one in sets:
        for row in one["rows"]:
            fit = row["fit"]
            offsets = np.atleast_1d(fit["parameters"]["bias"])
            shown = f"{offsets.min():+.3f}" + (f" to {offsets.max():+.3f}" if len(offsets) > 1 else "")
            rows.append([
                f"{one['set']} ({one['ranges']})", row["bias"], f"{fit['parameters']['sigma_range']:.4f}", shown,
                f"{row['held_out']:.3f}", row["windows"], *(_number(row[key]) for key in ("raw", "nees", "median")),
            ])  # fmt: skip
    columns = ("run (ranges)", "offset", "sigma_range [m]", "offsets [m]", "held-out log p per range", "windows",
               "NEES, offsets ignored", "NEES", "median NEES")  # fmt: skip
    return table(columns, rows)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__, backend="", data=True)
    parser.add_argument("--set", action="append", choices=SETS, help="default: all")
    arguments: argparse.Namespace = parse(parser)
    names = arguments.set or SETS
    sets = [
        measure(simulated(arguments.seed) if name == "simulated" else recorded(arguments.data, name), name)
        for name in names
    ]
    publish(__file__, arguments, to_markdown(sets), {"sets": sets})
    return 0


if __name__ == "__main__":
    sys.exit(main())
