"""Measure errors of the beam densities against 60 digits, beside those of the textbook's formulas.

    python bench/accuracy/stiff_density.py --page docs/numerics.md   # docs/img/stiff_*, and the tables of the page
    python bench/accuracy/stiff_density.py --figures DIRECTORY --backend numpy --backend opencl
    python bench/accuracy/stiff_density.py --figures DIRECTORY --backend numpy --step 4     # a quick look

stiff_worst.svg shows the largest error of each family of quantities on every backend in both precisions, as a share of
its bound. --page writes the tables between the page's marks, with the command and the commit, and refuses a checkout
with uncommitted changes.

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
from gpusense.evaluation.tolerances import TOLERANCES, Check
from gpusense.reference.mixture import log_density

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from accuracy.extreme_tables import write_tables
from common import FIGURES, command_line, make_parser, parse, publish, stated_commit, table
from support.textbook import textbook_log_hit, textbook_log_short, textbook_of

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
    """Find the worst errors of gpusense's and the textbook's formula: for sigma / Z, or lambda z* with z* = Z / 4."""
    real, ours, textbook = np.dtype(precision), [], []
    hit = weights[0] > 0
    for share in shares:
        shape = float(real.type(share * RANGE_MAX if hit else share / (RANGE_MAX / 4)))
        p = gs.BeamParameters(*weights, *((shape, 0.0) if hit else (1.0, shape)))
        grid, scanner = gs.OccupancyGrid([[0]], 1.0), gs.Scanner([0.0], RANGE_MAX)
        model = gs.BeamModel(grid, scanner, p, backend="numpy", precision=precision)
        z, expected = (a.astype(real) for a in places(shape))
        exact, naive = (exact_hit, textbook_log_hit) if hit else (exact_short, textbook_log_short)
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


def family_rows(precision: str, checks: list[Check]) -> list[dict[str, Any]]:
    """Return the check with the largest share of its bound of each quantity, over all cases."""
    families: dict[str, list[Check]] = {}
    for check in checks:
        families.setdefault(check.quantity.partition("; ")[0].removeprefix(f"{precision} "), []).append(check)
    found = []
    for family, group in sorted(families.items()):
        worst = max(group, key=_share)
        lost = sum(math.isinf(check.difference) for check in group)
        found.append({
            "backend": worst.left, "precision": precision, "family": family, "worst": worst.difference,
            "share": _share(worst), "not_finite": lost, "case": worst.quantity.partition("; ")[2],
        })  # fmt: skip
    return found


def _share(check: Check) -> float:
    """Return an error as a share of its bound; for a bound of 0 return 0 or 2."""
    return check.difference / check.tolerance.value if check.tolerance.value else 2.0 * (check.difference > 0)


def picture(families: list[dict[str, Any]]) -> str:
    """Draw the largest error of each family, a column for each backend and precision, darker towards the bound."""
    columns = list(dict.fromkeys((row["backend"], row["precision"]) for row in families))
    names = list(dict.fromkeys(row["family"] for row in families))
    width, height, left, top = 108, 26, 170, 44
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {left + width * len(columns) + 10} '
        f'{top + height * len(names) + 34}" font-family="sans-serif" font-size="12">',
        f'<rect width="{left + width * len(columns) + 10}" height="{top + height * len(names) + 34}" fill="white"/>',
    ]
    for i, (backend, precision) in enumerate(columns):
        x = left + width * i + width / 2
        for line, text in enumerate((backend, precision)):
            parts.append(f'<text x="{x:.0f}" y="{16 + 16 * line}" text-anchor="middle">{text}</text>')
    for j, name in enumerate(names):
        y = top + height * j
        parts.append(f'<text x="{left - 8}" y="{y + 17}" text-anchor="end">{name}</text>')
        for i, column in enumerate(columns):
            row = next((r for r in families if (r["backend"], r["precision"], r["family"]) == (*column, name)), None)
            if row is None:
                continue
            bad, share = row["not_finite"] or row["share"] > 1, min(row["share"], 1.0)
            fill = "#d55e00" if bad else f"rgb({round(255 - 150 * share)},{round(255 - 90 * share)},255)"
            x, text = left + width * i, "not finite" if row["not_finite"] else f"{100 * row['share']:.2g} %"
            parts.append(f'<rect x="{x + 1}" y="{y + 1}" width="{width - 2}" height="{height - 2}" fill="{fill}">'
                         f'<title>{row["worst"]:.3g}, {row["case"].replace("<", "")}</title></rect>')  # fmt: skip
            parts.append(f'<text x="{x + width / 2:.0f}" y="{y + 17}" text-anchor="middle">{text}</text>')
    note = "Largest error as a share of its bound, over all stiff and extreme cases; more than 100 % would be orange."
    parts.append(f'<text x="10" y="{top + height * len(names) + 22}" fill="#4a5568">{note}</text>')
    return "\n".join([*parts, "</svg>", ""])


def grid_rows(backends: list[str], families: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Judge the density grid and the catalogue of scenes on every backend; add the worst of each family."""
    found = []
    for backend in backends:
        for precision in PRECISIONS[: 1 + get_backend(backend).info.float64]:
            checks, grid = stiff.run(backend, precision), stiff.density_grid(backend, precision)
            families += family_rows(precision, checks)
            densities = checks[0]
            bound, naive = densities.tolerance.value, stiff.error_in_eps(textbook_of(grid), grid.truth(), precision)
            found.append({
                "backend": backend, "precision": precision, "worst": densities.difference,
                "not_finite": int(np.isinf(stiff.error_in_eps(grid.log_p, grid.truth(), precision)).sum()),
                "bound": bound, "kept": sum(check.passed for check in checks), "rows": len(checks),
                "naive_worst": float(np.mean(naive > bound)), "naive_not_finite": int(np.isinf(naive).sum()),
                "readings": len(grid.z),
            })  # fmt: skip
    return found


def bilinear_rows() -> list[list[Any]]:
    """Measure the float32 error of the interpolated field next to a cliff, from rounding a position."""
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
    parser.add_argument("--page", type=Path, help="page whose tables are written, such as docs/numerics.md")
    parser.add_argument("--step", type=float, default=0.25, help="of the plots [decades of sigma] (default: 0.25)")
    arguments = parse(parser)
    stated = stated_commit(parser, arguments) if arguments.page else ""
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
    families: list[dict[str, Any]] = []
    rows = grid_rows(arguments.backend, families)
    (arguments.figures / "stiff_worst.svg").write_text(picture(families), encoding="utf-8")
    columns = (
        "backend", "precision", "worst", "not finite", "bound", "rows kept", "textbook: above 16 eps", "not finite",
    )  # fmt: skip
    grid = table(columns, (
        [r["backend"], r["precision"], f"{r['worst']:.1f}", r["not_finite"], f"{r['bound']:.0f}",
         f"{r['kept']} of {r['rows']}", f"{100 * r['naive_worst']:.0f} %",
         f"{r['naive_not_finite']} of {r['readings']}"]
        for r in rows
    ))  # fmt: skip
    if arguments.page:
        made = f"Made by `{command_line('bench/accuracy/stiff_density.py')}` of commit {stated}."
        write_tables(arguments.page, {"density grid": f"{made}\n\n{grid}", "sweeps": worst, "cliff": cliff})
    publish(
        __file__, arguments, f"{worst}\n\n{cliff}\n\n{grid}", {"bilinear": bilinear, "rows": rows, "families": families}
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
