"""Confidence of a particle filter by number of beams: plain product, tempering, thinning, cubes.

For each log, number of beams (bad readings are dropped first, the others thinned evenly) and kind of weights: coverage
of the 50, 80 and 95 % regions, width of the 95 % interval of the position, median NEES (2.37 is right) and the rank
histogram of the true poses, which is flat where the weights are right.

    python bench/studies/coverage.py --logs intel csail fr079 --beams 10 30 90 180 --output coverage_cpu
    python bench/studies/coverage.py --logs intel olin --models beam --beams 60 --weights "plain product" auto
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import recordings
from common import make_parser, note, parse, publish, table

import gpusense as gs

# Description: temperature, weights of a peer.
WEIGHTS = {
    "plain product": (1.0, None), "temperature 0.1": (0.1, None), "auto": ("auto", None),
    "sum of cubes (nav2)": (1.0, gs.compat.Amcl()),
}  # fmt: skip


def maker(kind, backend, beams, peer):
    """Return ``make(grid, scanner)``: a model of a kind, or nav2's field with the command's parameters."""
    if peer is None:
        return recordings.makers(kind, backend, beams)
    weights = gs.LikelihoodFieldParameters.tracking().replace(interpolation="nearest")
    return lambda grid, scanner: gs.LikelihoodFieldModel(
        grid, scanner, weights, compat=peer, beams=beams, backend=backend
    )


COLUMNS = (
    "log", "model", "beams", "weights", "temperature", "median, 95 % error [cm]", "coverage 50, 80, 95 %",
    "width of 95 % [cm]", "median NEES", "share of ranks in the outer fifth (0.2 is right)",
)  # fmt: skip


def cells(r):
    """Format the cells of a row."""
    outer = r["rank_histogram"][0] + r["rank_histogram"][-1]
    return (
        r["log"], r["model"], r["beams"], r["weights"], f"{r['temperature']:.3f}", recordings.error_cell(r),
        recordings.coverage_cell(r), f"{100 * r['width_95']:.0f}", f"{r['nees_median']:.2f}", f"{outer:.2f}",
    )  # fmt: skip


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--logs", nargs="+", default=["intel", "csail", "fr079"], choices=recordings.NAMES)
    parser.add_argument("--models", nargs="+", default=["field"], choices=("field", "beam", "discrete"))
    parser.add_argument(
        "--weights", nargs="+", default=list(WEIGHTS), help='names of weights, or "temperature T" for a fixed one'
    )
    parser.add_argument("--beams", nargs="+", type=int, default=[10, 30, 90, 180])
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--limit", type=int, default=600, help="scans of each log")
    args = parse(parser)
    results = []
    for name in args.logs:
        recording = recordings.load(name)
        for kind, beams, words in itertools.product(args.models, args.beams, args.weights):
            temperature, peer = WEIGHTS.get(words) or (float(words.removeprefix("temperature ")), None)
            models = recording.models(maker(kind, args.backend, beams, peer))
            options = dict(limit=args.limit, particles=args.particles, temperature=temperature)
            runs = [recordings.follow(recording, models, seed=seed, **options) for seed in range(args.seeds)]
            results.append(dict(log=name, model=kind, beams=beams, weights=words) | recordings.figures(runs))
            note(str(cells(results[-1])))
    publish(__file__, args, table(COLUMNS, map(cells, results)), dict(results=results))


if __name__ == "__main__":
    main()
