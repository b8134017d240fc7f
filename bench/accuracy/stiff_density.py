"""Measure errors of the beam densities against 60 digits, ours beside the textbook's formulas.

    python bench/accuracy/stiff_density.py              # docs/img/stiff_*.png, and the tables of docs/numerics.md
    python bench/accuracy/stiff_density.py --figures DIRECTORY --backend numpy --backend opencl
    python bench/accuracy/stiff_density.py --figures DIRECTORY --backend numpy --step 4     # a quick look

Truth is mpmath (60 digits) on the same rounded numbers. The unit is eps (1 + |log p|) with the eps of the precision.
"""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import mpmath as mp
import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation import stiff
from gpusense.evaluation.tolerances import TOLERANCES
from gpusense.models.scan.densities import naive_log_hit, naive_log_short
from gpusense.reference.mixture import log_density

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import FIGURES, make_parser, parse, publish, table

mpl.use("Agg")
mp.mp.dps = 60
PRECISIONS = ("float32", "float64")
RANGE_MAX = 16.0
OURS, TEXTBOOK = "#1b6ca8", "#c8553d"
CEILING = 1e20  # failures are drawn here


@functools.cache
def exact_hit(z: float, expected: float, sigma: float) -> mp.mpf:
    """Compute log p_hit."""
    z, e, s, top = (mp.mpf(v) for v in (z, expected, sigma, RANGE_MAX))
    root = s * mp.sqrt(2)
    return -(((z - e) / s) ** 2) / 2 - mp.log(s * mp.sqrt(mp.pi / 2) * (mp.erf((top - e) / root) + mp.erf(e / root)))


@functools.cache
def exact_short(z: float, expected: float, rate: float) -> mp.mpf:
    """Compute log p_short."""
    if not 0 <= z <= expected or expected == 0:
        return -mp.inf
    z, e, rate = (mp.mpf(v) for v in (z, expected, rate))
    return mp.log(rate / -mp.expm1(-rate * e)) - rate * z if rate else -mp.log(e)


def in_eps(found: np.ndarray, truth: list[mp.mpf], precision: str) -> np.ndarray:
    """Return errors against mpmath without rounding the truth first."""
    eps = float(np.finfo(precision).eps)
    errors = [
        float(abs(mp.mpf(float(f)) - t) / (1 + abs(t))) / eps if math.isfinite(f) else math.inf
        for f, t in zip(found, truth, strict=True)
    ]
    return np.array(errors)


Sweep = tuple[np.ndarray, np.ndarray, np.ndarray]
Places = Callable[[float], tuple[np.ndarray, np.ndarray]]


def sweep(precision: str, shares: np.ndarray, weights: tuple[float, ...], places: Places) -> Sweep:
    """Find the worst errors of ours and of the textbook's formula: for sigma / Z, or lambda z* with z* = Z / 4."""
    real, ours, textbook = np.dtype(precision), [], []
    hit = weights[0] > 0
    for share in shares:
        shape = float(real.type(share * RANGE_MAX if hit else share / (RANGE_MAX / 4)))
        p = gs.BeamParameters(*weights, *((shape, 0.0) if hit else (1.0, shape)))
        grid, scanner = gs.OccupancyGrid([[0]], 1.0), gs.Scanner([0.0], RANGE_MAX)
        model = gs.BeamModel(grid, scanner, p, backend="numpy", precision=precision)
        z, expected = (a.astype(real) for a in places(shape))
        exact, naive = (exact_hit, naive_log_hit) if hit else (exact_short, naive_log_short)
        truth = [exact(float(a), float(b), shape) for a, b in zip(z, expected, strict=True)]
        with np.errstate(all="ignore"):
            found = log_density(model._pipeline.mixture.flags, z, expected, model._pipeline.mixture.terms)
        ours.append(in_eps(found, truth, precision).max())
        top = (real.type(RANGE_MAX),) if hit else ()
        textbook.append(in_eps(naive(z, expected, real.type(shape), *top), truth, precision).max())
    return shares, np.array(ours), np.array(textbook)


def around(sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return readings from both ends to z* and some deviations away, for five expected ranges."""
    pairs = []
    for expected in (0.0, 1e-6, 0.3, 0.5, 1.0):
        e = expected * RANGE_MAX
        z = np.array([0, 0.2 * RANGE_MAX, 0.999 * RANGE_MAX, e, e - 0.5 * sigma, e + 0.5 * sigma])
        pairs += [(one, e) for one in np.clip(z, 0, RANGE_MAX * (1 - 1e-7))]
    return tuple(np.array(pairs).T)


def along(rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return readings from 0 to z* = Z / 4."""
    z = np.array([0.0, 0.1, 0.5, 1.0]) * RANGE_MAX / 4
    return z, np.full(4, RANGE_MAX / 4)


def plot(path: Path, sweeps: dict[str, Sweep], label: str, title: str) -> None:
    """Draw a panel for each precision, with values that are not finite at the top."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for axis, (precision, (x, ours, textbook)) in zip(axes, sweeps.items(), strict=True):
        for values, colour, marker, name in (
            (textbook, TEXTBOOK, "s", "textbook's formula"), (ours, OURS, "o", "gpusense"),
        ):  # fmt: skip
            lost = ~np.isfinite(values)
            shown = np.where(lost, np.nan, np.clip(values, 0.05, CEILING / 30))
            axis.loglog(x, shown, marker, color=colour, markersize=4, label=name)
            if lost.any():
                axis.loglog(x[lost], np.full(lost.sum(), CEILING), "x", color=colour, label=f"{name}: not finite")
        bound = TOLERANCES["float32 beam"].value
        axis.axhline(bound, color="0.4", linewidth=0.8, linestyle="--")
        axis.text(x[-1], bound * 1.6, f"{bound:g} eps", ha="right", color="0.3", fontsize=8)
        axis.set(xlabel=label, title=precision, ylim=(0.03, CEILING * 30))
        axis.grid(True, color="0.9")
        axis.set_axisbelow(True)
    axes[0].set_ylabel("worst error [eps (1 + |log p|)]")
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(title)
    figure.savefig(path, dpi=110)


def grid_rows(backends: list[str]) -> list[dict[str, Any]]:
    """Judge the density grid and the catalogue of scenes on every backend."""
    found = []
    for backend in backends:
        for precision in PRECISIONS[: 1 + get_backend(backend).info.float64]:
            rows = stiff.run(backend, precision)
            own, naive, *_ = rows
            found.append({
                "backend": backend, "precision": precision, "worst": own.worst, "not_finite": own.nonfinite,
                "bound": own.bound, "kept": sum(row.ok for row in rows), "rows": len(rows), "naive_worst": naive.worst,
                "naive_not_finite": naive.nonfinite, "readings": own.case.split()[0],
            })  # fmt: skip
    return found


def bilinear_rows() -> list[list[Any]]:
    """Measure the error of the interpolated field in float32 that rounding a position makes beside a cliff."""
    from gpusense.evaluation.replay import Recorder, replay
    from gpusense.evaluation.tolerances import beam_tolerance

    case = next(case for case in stiff.cases() if case.name.startswith("in walls"))
    poses = np.random.default_rng(1).uniform((-2, -2, -4), (6, 5, 4), (2000, 3))
    rows = []
    for ratio in (10, 20, 40, 80, 160, 1000, 1_000_000):
        p = gs.LikelihoodFieldParameters(sigma_hit=5.0 / ratio, max_distance=5.0, interpolation="bilinear")
        recorder = Recorder(get_backend("numpy"))
        model = gs.LikelihoodFieldModel(case.grid, case.scanner, p, backend=recorder, precision="float32")
        model.log_likelihood(poses, replace(case, readings=(3.0, 7.7, 12.1)).ranges, per_beam=True)
        (launch,) = recorder.launches
        rows.append([ratio, float(beam_tolerance("float32").difference(launch.parts, replay(launch)[1]))])
    return rows


def sweep_lines(name: str, sweeps: dict[str, Sweep]) -> list[list[str]]:
    """Format the rows of the plots' table."""
    lines = []
    for precision, (_, ours, textbook) in sweeps.items():
        finite = textbook[np.isfinite(textbook)]
        lost = f"{np.isinf(textbook).sum()} of {len(ours)}"
        lines.append([name, precision, f"{ours.max():.1f}", lost, f"{finite.max(initial=0):.1g}"])
    return lines


def main() -> int:
    """Draw the plots and write the tables."""
    parser = make_parser(__doc__)
    parser.add_argument("--figures", type=Path, default=FIGURES, help="folder for the drawings (default: docs/img)")
    parser.add_argument("--step", type=float, default=0.25, help="of the plots [decades of sigma] (default: 0.25)")
    arguments = parse(parser)
    arguments.figures.mkdir(parents=True, exist_ok=True)
    sigmas, rates = 10.0 ** np.arange(-8, 6.01, arguments.step), 10.0 ** np.arange(-20, 6.01, 2 * arguments.step)
    hits = {precision: sweep(precision, sigmas, (1.0, 0.0, 0.0, 0.0), around) for precision in PRECISIONS}
    plot(arguments.figures / "stiff_hit.png", hits, "sigma / range_max", "p_hit: worst error over readings and z*")
    shorts = {precision: sweep(precision, rates, (0.0, 1.0, 0.0, 0.0), along) for precision in PRECISIONS}
    plot(arguments.figures / "stiff_short.png", shorts, "lambda z*", "p_short: worst error over readings")
    worst = table(
        ("errors [eps (1 + \\|log p\\|)]", "precision", "ours, worst", "textbook: not finite", "elsewhere, worst"),
        [*sweep_lines("p_hit over sigma / Z", hits), *sweep_lines("p_short over lambda z*", shorts)],
    )
    bilinear = bilinear_rows()
    cliff = table(
        ("max_distance / sigma", "worst [eps (1 + abs(log p))]"), ([ratio, f"{eps:.1f}"] for ratio, eps in bilinear)
    )
    rows = grid_rows(arguments.backend)
    columns = (
        "backend", "precision", "worst", "not finite", "bound", "rows kept", "textbook: above 16 eps", "not finite",
    )  # fmt: skip
    grid = table(columns, (
        [r["backend"], r["precision"], f"{r['worst']:.1f}", r["not_finite"], f"{r['bound']:.0f}",
         f"{r['kept']} of {r['rows']}", f"{100 * r['naive_worst']:.0f} %",
         f"{r['naive_not_finite']} of {r['readings']}"]
        for r in rows
    ))  # fmt: skip
    publish(__file__, arguments, f"{worst}\n\n{cliff}\n\n{grid}", {"bilinear": bilinear, "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
