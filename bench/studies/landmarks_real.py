"""Fit the noise of real robots among landmarks, associate and localise.

    python bench/studies/landmarks_real.py --data DATA --output bench/results/landmarks_real      # some minutes

For each run: parameters fitted at the logged poses with known and with unknown landmarks; landmarks whose readings lie
at another landmark; how often the likeliest landmark of a feature is the recorded one, at logged poses and at randomly
moved ones; and the error of a particle filter (odometry, ``LandmarkModel``) with known and with unknown landmarks and
the parameters of the corresponding fit. It starts 0.5 m and 0.3 rad (one deviation) around the first logged pose. Two
landmarks of the UTIAS data are exchanged in the published positions: results are for these positions, and for
comparison for the corrected ones ("repaired"). Fits and filters use the same run.

freiburg is simulated without a true path but with nearly exact odometry, which is taken as the path; the filter gets it
with added noise. The LEGO robot's headings are computed from the features themselves.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.evaluation import landmark_runs as lr
from gpusense.logs.records import LandmarkRun

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import make_parser, note, parse, publish, table
from studies.landmark_sets import repaired, run_of

SETS = ("mrclam_1", "mrclam_2", "mrclam_3", "beacons", "lego", "freiburg")
MOVED = ((0.0, 0.0), (0.1, 0.05), (0.3, 0.15))


def measure(data: Path, name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of one run."""
    run = lr.first_scans(run_of(data, name), arguments.scans)
    fit = lr.fit_run(run)
    found = lr.suspicions(run, fit)
    variants = {"as recorded": run}
    if found.exchanged:
        variants["repaired"] = repaired(run, found)
    rows = []
    for variant, own in variants.items():
        for known in (True, False):
            learned = lr.fit_run(own, known=known)
            model = gs.LandmarkModel(own.landmarks, lr.usable(learned.parameters), backend=arguments.backend)
            row: dict[str, Any] = {"map": variant, "known": known, "fit": learned.to_dict()}
            if not known:
                row["association"] = [
                    {"sigma_position": m, "sigma_heading": h, **lr.association(own, model, moved(own, m, h))}
                    for m, h in MOVED
                ]  # fmt: skip
            track = lr.localise(own, model, known=known, particles=arguments.particles, seed=arguments.seed)
            row["filter"] = track.summary()
            rows.append(row)
            note(f"{name}: {variant}, {'known' if known else 'unknown'}")
    label = run.labels.tolist()
    return {
        "set": name, "scans": len(run.time), "features": len(run.ids), "landmarks": len(run.landmarks),
        "range_max": run.range_max, "field_of_view": run.field_of_view, "left_out": run.left_out, "rows": rows,
        "exchanged": [
            {"landmarks": [label[e.first], label[e.second]], "gain": e.gain, "before": e.before, "after": e.after}
            for e in found.exchanged
        ],
        "misplaced": [{"landmark": label[m.landmark], "agree": m.agree} for m in found.misplaced],
    }  # fmt: skip


def moved(run: LandmarkRun, position: float, heading: float) -> np.ndarray:
    """Return the logged poses with normal errors of these deviations [m, rad]."""
    rng = np.random.default_rng(0)
    return run.truth + rng.normal(size=run.truth.shape) * (position, position, heading)


def to_markdown(sets: list[dict[str, Any]]) -> str:
    """Format the tables of all runs, and the list of suspicious landmarks."""
    fits, errors, associations = [], [], []
    for one in sets:
        for row in one["rows"]:
            p, e, fit, f = row["fit"]["parameters"], row["fit"]["standard_errors"], row["fit"], row["filter"]
            which = "known" if row["known"] else "unknown"
            fits.append([
                f"{one['set']} ({one['scans']}, {one['features']})", row["map"], which,
                f"{p['sigma_range']:.4f} +- {_number(e['sigma_range'])}",
                f"{p['sigma_bearing']:.4f} +- {_number(e['sigma_bearing'])}", f"{p['z_false']:.4f}",
                f"{p['p_detect']:.2f}", f"{fit['range_bias']:+.4f}", f"{fit['bearing_bias']:+.4f}",
            ])  # fmt: skip
            errors.append([
                one["set"], row["map"], which,
                f"{f['error_median']:.3f} / {f['error_90']:.3f} / {f['error_max']:.2f}",
                f"{f['heading_median']:.3f} / {f['heading_90']:.3f}",
            ])  # fmt: skip
            if "association" in row:
                shares = [[f"{100 * a[key]:.1f}" for key in ("right", "none", "wrong")] for a in row["association"]]
                associations.append([one["set"], row["map"], *(" / ".join(share) for share in shares)])
    fit_columns = (
        "run (scans, features)", "map", "landmarks", "sigma_range [m]", "sigma_bearing [rad]", "z_false", "p_detect",
        "range bias [m]", "bearing bias [rad]",
    )  # fmt: skip
    error_columns = ("run", "map", "landmarks", "error [m], median / 90 % / largest", "heading [rad], median / 90 %")
    moved = (f"moved {m:g} m, {h:g} rad" for m, h in MOVED)
    association_columns = ("association right / none / wrong [%]", "map", *moved)
    tables = [table(fit_columns, fits), table(error_columns, errors), table(association_columns, associations)]
    lines = []
    for one in sets:
        for e in one["exchanged"]:
            lines.append(
                f"- {one['set']}: landmarks {e['landmarks'][0]} and {e['landmarks'][1]} are exchanged: "
                f"{100 * e['before'][0]:.0f} and {100 * e['before'][1]:.0f} % of their readings agree, "
                f"{100 * e['after'][0]:.0f} and {100 * e['after'][1]:.0f} % the other way round ({e['gain']:.0f} nats)"
            )
        lines += [
            f"- {one['set']}: {100 * m['agree']:.0f} % of the readings of landmark {m['landmark']} agree with its place"
            for m in one["misplaced"]
        ]
    return "\n\n".join([*tables, "\n".join(lines)]).rstrip()


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1g}"


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__, backend="auto", data=True)
    parser.add_argument("--set", action="append", choices=SETS, help="default: all")
    parser.add_argument("--scans", type=int, help="most scans of each run")
    parser.add_argument("--particles", type=int, default=2000)
    arguments = parse(parser)
    sets = [measure(arguments.data, name, arguments) for name in arguments.set or SETS]
    note, report = f"{arguments.particles} particles.", {"particles": arguments.particles, "sets": sets}
    publish(__file__, arguments, to_markdown(sets), report, note)
    return 0


if __name__ == "__main__":
    sys.exit(main())
