"""Localise with fitted parameters and with other programs' defaults: rank of the true pose and error of the mean.

    python bench/studies/fit_localisation.py --data DATA --output bench/results/fit_localisation      # some minutes

Maps are made of the even scans of a log, and odd scans are grouped in blocks of --block neighbours. Parameters of the
beam model are fitted to alternate blocks. Evenly chosen scans of the other blocks are scored with these parameters,
with the defaults of nav2_amcl and Beluga in the book's mixture, and with gpusense's defaults. Particles are drawn as by
``gpusense score``: the logged pose, and of the rest one half around it and one half uniform over the free cells.

Logged poses come from SLAM of the whole log. A product of 180 beams has about one effective particle, so the error of
the mean is also given at temperature 0.1.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.evaluation import held_out
from gpusense.evaluation import range_data as fitting
from gpusense.evaluation.scoring import ParticleSampler, score_log

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import LOGS, make_parser, note, odd_scans, parse, publish, table

TEMPERATURES = (1.0, 0.1)
HAND_TUNED = gs.BeamParameters(z_hit=0.75, z_short=0.1, z_max=0.05, z_rand=0.1, sigma_hit=0.1)


def measure(data: Path, name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Fit alternate blocks of the odd scans, and score scans of the other blocks."""
    grid, scans = odd_scans(data, name)
    block = np.arange(len(scans)) // arguments.block
    known = [scan for scan, odd in zip(scans, block % 2, strict=True) if not odd]
    rest = [scan for scan, odd in zip(scans, block % 2, strict=True) if odd]
    chosen = [rest[i] for i in np.unique(np.linspace(0, len(rest) - 1, arguments.scans).round().astype(int))]
    pairs = fitting.data_of_log(grid, known, backend=arguments.backend)
    fit = gs.fit_beam_parameters(pairs.ranges, pairs.expected, pairs.range_max, backend=arguments.backend)
    candidates = {
        "fitted": held_out.softened(fit.parameters, fit.hits + fit.max_readings), **held_out.peer_parameters(),
        "gpusense's defaults": gs.BeamParameters(), "hand-tuned on intel": HAND_TUNED,
    }  # fmt: skip
    cloud, rows = ParticleSampler(arguments.particles), []
    for origin, parameters in candidates.items():
        row: dict[str, Any] = {"parameters_of": origin, "parameters": parameters.to_dict()}
        for temperature in TEMPERATURES:
            model = gs.BeamModel(
                grid, chosen[0][1].scanner, parameters, backend=arguments.backend, temperature=temperature
            )
            scores = score_log([model], chosen, cloud)[0][0].scans
            row[f"error_m_at_{temperature:g}"] = summary(
                [np.nan if s.error_position is None else s.error_position for s in scores]
            )
            if temperature == 1:
                row["rank"] = summary([s.rank for s in scores])
                row["first"] = float(np.mean([s.rank == 1 for s in scores]))
                row["percentile"] = summary([s.percentile for s in scores])
        rows.append(row)
        note(f"{name}: {origin}")
    return {"log": name, "fitted_scans": len(known), "scored_scans": len(chosen), "rows": rows}


def summary(values: list[float]) -> dict[str, float]:
    """Return median, 90 % and mean."""
    some = np.array(values)
    return {"median": float(np.median(some)), "p90": float(np.quantile(some, 0.9)), "mean": float(some.mean())}


def to_markdown(logs: list[dict[str, Any]]) -> str:
    """Format a table of all logs."""
    columns = (
        "log (scans)", "parameters", "rank of the logged pose, median / mean", "first",
        "error of the mean [m], median / 90 %", "at temperature 0.1",
    )  # fmt: skip
    lines = []
    for log in logs:
        for row in log["rows"]:
            errors = [f"{e['median']:.3f} / {e['p90']:.3f}" for e in (row["error_m_at_1"], row["error_m_at_0.1"])]
            rank = f"{row['rank']['median']:g} / {row['rank']['mean']:.3g}"
            name = f"{log['log']} ({log['scored_scans']})"
            lines.append([name, row["parameters_of"], rank, f"{100 * row['first']:.0f} %", *errors])
    return table(columns, lines)


def main() -> int:
    """Fit, score and write."""
    parser = make_parser(__doc__, backend="auto", data=True)
    parser.add_argument("--log", action="append", choices=LOGS, help="default: all")
    parser.add_argument("--scans", type=int, default=60, help="scored of each log")
    parser.add_argument("--block", type=int, default=10, help="neighbouring odd scans of a block")
    parser.add_argument("--particles", type=int, default=20_000)
    arguments = parse(parser)
    logs = [measure(arguments.data, name, arguments) for name in arguments.log or LOGS]
    note, report = f"{arguments.particles} particles.", {"particles": arguments.particles, "logs": logs}
    publish(__file__, arguments, to_markdown(logs), report, note)
    return 0


if __name__ == "__main__":
    sys.exit(main())
