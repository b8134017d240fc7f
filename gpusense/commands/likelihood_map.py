"""Run ``gpusense likelihood-map``: P(z | x, m) of one scan over all positions and headings of a map."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np

import gpusense as gs
from gpusense.commands import output
from gpusense.commands.arguments import Options, picture, positive_number, scan_model, whole_number
from gpusense.commands.output import grouped
from gpusense.commands.scans import add_log, read_scan
from gpusense.commands.signals import working
from gpusense.matching import pose_likelihood

FIRST = ("map", "log", "scan", "out", "model")
SHARED = ("range", "field", "backend", "verbose")

# Number of printed modes.
_MODES = 5
# Differences of log-likelihoods that count as equal, and above which a grid is too coarse [nats].
_EQUAL, _COARSE = 3.0, 3.0

EPILOG = """\
The darker a position in the picture, the larger P(z | x, m) at its best heading. The table lists the best poses that
are not near a better one, refined between the positions and headings of the grid. A refined pose that is much likelier
than the grid's best one shows that the grid is too coarse for the model. The entropy belongs to a uniform prior.

Ctrl-C ends the run; the picture then shows the positions so far.

examples:
  gpusense likelihood-map --map map.yaml --log run.log.gz --scan 101 \\
      --out likelihood.png
  gpusense likelihood-map --map map.yaml --log run.log.gz --model beam \\
      --temperature 0.1 --out beam.pdf"""


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("--map YAML", "a map_server map", Path, required=True)
    add_log(add, "a log with scans")
    add("--scan I", "index of the scan", whole_number(low=0), 0)
    add("--out FILE", "the picture", picture, required=True)
    add("--resolution M", "distance between neighbouring positions, at least a cell [m]", positive_number, 0.1)
    add("--headings A", "headings", whole_number(low=1), 72)
    add("--temperature T", "factor of log-likelihoods in (0, 1]; 1 is the plain product over beams",
        positive_number, 1.0)  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Compute and draw the likelihoods; after Ctrl-C, the tiles so far."""
    grid = gs.read_map(args.map)
    scan = read_scan(args)
    model = scan_model(args, grid, scan.scanner, temperature=args.temperature)
    result, tiles = pose_likelihood.prepare_tiles(
        model, scan.ranges, resolution=args.resolution, headings=args.headings, positions="free"
    )
    done = 0.0
    with working((result,), 100) as step:
        for done in tiles:
            step(f"{100 * done:.0f}%")
    result.plot(args.out)
    poses, log_p, gain = pose_likelihood.refine_modes(model, scan.ranges, result, _MODES)
    if args.json:
        output.report({
            "picture": str(args.out), "done": done, "rows": result.log_p.shape[0], "cols": result.log_p.shape[1],
            "headings": result.log_p.shape[2], "resolution": result.resolution, "entropy": result.entropy,
            "log_evidence": result.log_evidence, "gain_of_refinement": gain, "modes": [
                {"pose": pose, "log_likelihood": value} for pose, value in zip(poses.tolist(), log_p, strict=True)
            ],
        })  # fmt: skip
    else:
        _print(args, poses, log_p, gain)
        output.interrupted(round(100 * done), 100, "per cent of the positions")
        output.details(args, f"{grouped(result.log_p.size)} poses, entropy {result.entropy:.2f} nats; refinement gains "
                       f"{gain:.2g} nats")  # fmt: skip
    return 0


def _print(args: argparse.Namespace, poses: np.ndarray, log_p: np.ndarray, gain: float) -> None:
    """Print the likeliest pose with its lead over others, and the table of poses."""
    if not len(poses):
        output.result("NO PLACE: the scan is impossible everywhere")
    else:
        best = f"{poses[0, 0]:.2f} m, {poses[0, 1]:.2f} m, {math.degrees(poses[0, 2]):.1f} degrees"
        near = int((log_p > log_p[0] - _EQUAL).sum())
        lead = f", {log_p[0] - log_p[1]:.3g} nats above the next" if len(poses) > 1 else ""
        output.result(f"ONE PLACE: {best}{lead}" if near == 1 else
                      f"{near} PLACES within {_EQUAL:g} nats of the best: {best}")  # fmt: skip
        if gain > _COARSE:
            output.fact("grid", f"too coarse for the model: the refined pose is {gain:.3g} nats likelier than the "
                        f"grid's best, so peaks may be missed; try --resolution {args.resolution / 2:g} --headings "
                        f"{2 * args.headings}, or a --temperature below {args.temperature:g}")  # fmt: skip
        columns = ("x [m]", "y [m]", "heading [degrees]", "below the best [nats]")
        rows = [
            (f"{x:.2f}", f"{y:.2f}", f"{math.degrees(theta):.1f}", f"{log_p[0] - value:.1f}")
            for (x, y, theta), value in zip(poses, log_p, strict=True)
        ]
        print()
        output.table(columns, rows, right=columns)
        print()
    output.files(args.out)
