"""Compare backends on real maps and logs, and measure both models' ranks of the logged poses.

    python bench/accuracy/real_scores.py --data DATA --output bench/results/real           # everything; tens of minutes
    python bench/accuracy/real_scores.py --data DATA --scans 20 --log intel --map intel_even_05cm

Writes Markdown and JSON with devices, sizes, differences, scores and the command. Differences are those of
``gpusense selftest`` on a scene in each map, NumPy and every other device pairwise and with the float64 truth. Scores
are those of ``gpusense score`` with the parameters below: the odd scans of a log in a map of its even ones, on every
device but NumPy, and the first scans also on NumPy.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation import selftest
from gpusense.evaluation.scoring import ParticleSampler, score_log, summary

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import make_parser, note, odd_scans, parse, present, publish, table

MAPS = {
    Path(name).stem: name
    for name in (
        "carmen_logs/derived_maps/intel_even_05cm.yaml",
        "carmen_logs/derived_maps/csail_even_05cm.yaml",
        "carmen_logs/derived_maps/freiburg-079_even_05cm.yaml",
        "ros_maps/Spielberg_map.yaml",
        "ros_maps/basement_hallways_5cm.yaml",
        "ros_maps/columbia.yaml",
        "ros_maps/stata_basement.yaml",
        "ros_maps/willow-full.yaml",
        "wean_hall/wean_10cm.yaml",
    )
}
# Chosen on some of the Intel scans; end points lie within a cell or two of a wall, except for one reading in five.
BEAM_PARAMETERS = gs.BeamParameters(z_hit=0.75, z_short=0.1, z_max=0.05, z_rand=0.1, sigma_hit=0.1)
FIELD_PARAMETERS = gs.LikelihoodFieldParameters(sigma_hit=0.1, max_distance=1.0)
LOGS = ("intel", "csail", "freiburg-079", "aces", "belgioioso")
# Quantities of the self-test for the columns, and their units.
COLUMNS = {
    "float32 ranges": "float32 ranges, other bits",
    "float64 ranges": "float64 ranges, relative",
    "float32 beam model, scans": "beam model float32, nats",
    "float32 field, nearest, scans": "field nearest float32, nats",
    "float32 field, bilinear, scans": "field bilinear float32, nats",
    "float64 beam model, scans": "beam model float64, 1 + abs(log p)",
}


def differences(data: Path, name: str) -> list[dict[str, Any]]:
    """Return the rows of one map, each a pair of backends or a backend with the truth."""
    grid = gs.read_map(data / MAPS[name])
    scanner = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.025, count=161, range_max=20.0)
    scene = selftest.scene_in(grid, scanner)
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for check in selftest.run(selftest.chosen_backends(), scene):
        if check.right in ("SciPy", "specialize=False", "per_beam=True", "float64"):
            continue
        shape = f"{grid.shape[0]} x {grid.shape[1]}"
        row = rows.setdefault((check.left, check.right), {
            "map": name, "cells": shape, "particles": len(scene.poses), "beams": scanner.count, "left": check.left,
            "right": check.right, "differences": {}, "breaches": 0,
        })  # fmt: skip
        row["differences"][check.quantity] = check.difference
        row["breaches"] += not check.passed
    return list(rows.values())


def scores(data: Path, name: str, kind: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Score many scans on the fast devices, and some on every device."""
    grid, odd = odd_scans(data, name)
    some = odd[:: max(-(-len(odd) // arguments.scans), 1)] if arguments.scans else odd
    scanner = some[0][1].scanner
    make, parameters = {
        "beam": (gs.BeamModel, BEAM_PARAMETERS), "field": (gs.LikelihoodFieldModel, FIELD_PARAMETERS),
    }[kind]  # fmt: skip
    names = present()
    fast = [backend for backend in names if backend != "numpy"]
    cloud = ParticleSampler(arguments.particles)

    def score(backends: list[str], scans: list) -> tuple[list, list]:
        models = [make(grid, scanner, parameters, backend=b, temperature=arguments.temperature) for b in backends]
        return score_log(models, scans, cloud, lambda text: note(f"{name} {kind} {text}"))

    many, agreement = score(fast or names, some)
    few, every = score(names, some[: arguments.numpy_scans]) if fast and arguments.numpy_scans else ([], [])
    return {
        "log": name, "model": kind, "particles": arguments.particles, "parameters": parameters.to_dict(),
        "range_max": scanner.range_max, "temperature": arguments.temperature,
        "backends": [
            {"device": asdict(score.device), **summary(score)} for score in [*many, *(s for s in few if s not in many)]
        ],
        "agreement": [asdict(a) | {"same_ranking": a.same} for a in [*agreement, *every]],
    }  # fmt: skip


def to_markdown(maps: list[dict[str, Any]], logs: list[dict[str, Any]]) -> str:
    """Format three tables: differences, scores, agreement of rankings."""
    lines = []
    for row in maps:
        numbers = [row["differences"].get(quantity) for quantity in COLUMNS]
        cells = ["-" if number is None else f"{number:.2g}" for number in numbers]
        lines.append([row["map"], row["cells"], f"{row['left']}, {row['right']}", *cells])
    text = "### Largest differences between backends on real maps\n\n"
    text += table(("map", "cells", "pair", *COLUMNS.values()), lines)
    columns = (
        "log", "model", "device", "scans x particles", "percentile median (least)", "rank median",
        "error median / 90 % [m]", "[rad]", "effective", "M particle-beams/s",
    )  # fmt: skip
    lines = [
        [
            log["log"], log["model"], f"{s['device']['selection']} ({s['device']['name']})",
            f"{s['scans']} x {log['particles']}", f"{s['percentile_median']:.3f} ({s['percentile_min']:.3f})",
            f"{s['rank_median']:g}", f"{s['error_position_median']:.3f} / {s['error_position_90']:.3f}",
            f"{s['error_heading_median']:.4f} / {s['error_heading_90']:.4f}", f"{s['effective_median']:.1f}",
            f"{s['particle_beams_per_second'] / 1e6:.1f}",
        ]
        for log in logs
        for s in log["backends"]
    ]  # fmt: skip
    text += "\n\n### Rank of the logged pose and error of the weighted mean of the other particles\n\n"
    text += table(columns, lines)
    columns = (
        "log", "model", "pair", "scans", "same rank of the logged pose", "no particles swapped", "least Spearman",
        "largest difference [nats]", "gap of swapped particles [nats]", "same ranking",
    )  # fmt: skip
    lines = [
        [
            log["log"], log["model"], f"{a['left']}, {a['right']}", a["scans"], a["same_rank"], a["same_order"],
            f"{a['spearman']:.9f}", f"{a['difference']:.2g}", f"{a['gap']:.2g}", "yes" if a["same_ranking"] else "NO",
        ]
        for log in logs
        for a in log["agreement"]
    ]  # fmt: skip
    return f"{text}\n\n### Agreement of rankings\n\n{table(columns, lines)}"


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__, backend="", data=True)
    parser.add_argument("--map", action="append", choices=(*MAPS, "none"), help="default: all")
    parser.add_argument("--log", action="append", choices=(*LOGS, "none"), help="default: all")
    parser.add_argument("--model", action="append", choices=("beam", "field"), help="default: both")
    parser.add_argument("--scans", type=int, default=0, help="least number of odd scans of each log; 0: all")
    parser.add_argument("--numpy-scans", type=int, default=3, help="of these on NumPy too")
    parser.add_argument("--particles", type=int, default=20_000)
    parser.add_argument("--temperature", type=float, default=1.0)
    arguments = parse(parser)
    begin = time.perf_counter()
    maps = [row for name in arguments.map or MAPS if name != "none" for row in differences(arguments.data, name)]
    logs = [
        scores(arguments.data, name, kind, arguments)
        for name in arguments.log or LOGS
        if name != "none"
        for kind in arguments.model or ("beam", "field")
    ]
    devices = [asdict(get_backend(selection).info) for selection in present()]
    report = {"devices": devices, "seconds": time.perf_counter() - begin, "maps": maps, "logs": logs}
    publish(__file__, arguments, to_markdown(maps, logs), report)
    breached = any(row["breaches"] for row in maps)
    return 1 if breached or not all(a["same_ranking"] for log in logs for a in log["agreement"]) else 0


if __name__ == "__main__":
    sys.exit(main())
