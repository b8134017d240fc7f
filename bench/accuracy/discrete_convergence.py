"""Draw rows of the discrete model, and measure its convergence to continuous densities as bins shrink.

    python bench/accuracy/discrete_convergence.py           # docs/img/discrete_*.png, and the table of bench/RESULTS.md
    python bench/accuracy/discrete_convergence.py --figures DIRECTORY --most 512

*Convergence*: the largest difference of densities (probability over width) from the continuous model, over readings and
    expected ranges except next to p_short's jump at z*, for the causes of a mixture (limit: the mixture) and for
    separate
causes (limit: the first of three waits), and of the probability of no return. *Rows*: for a laser and a sonar, the
densities at one distance with dependent causes and with those of a mixture of the same size, whose causes are
independent.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from scipy.stats import truncnorm

import gpusense as gs
from gpusense.models.scan.densities import log_mixture
from gpusense.plots.drawing import new_figure, save

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import FIGURES, make_parser, parse, publish, table

mpl.use("Agg")
RANGE = 6.0
MIXTURE = gs.BeamParameters(z_hit=0.7, z_short=0.1, z_max=0.1, z_rand=0.1, sigma_hit=0.3, lambda_short=0.4)
CAUSES = gs.DiscreteCauses(lambda_short=0.2, lambda_rand=0.05, p_detect=0.8, sigma_hit=0.6)
EXPECTED = np.array([0.7, 2.3, 4.1, 5.6])
READINGS = np.linspace(0.01, RANGE - 0.01, 401)
SENSORS = {
    "laser": gs.DiscreteCauses(lambda_short=0.05, lambda_rand=0.01, p_detect=0.97, sigma_hit=0.1),
    "sonar": gs.DiscreteCauses(lambda_short=0.3, lambda_rand=0.05, p_detect=0.8, sigma_hit=0.4),
}


def mixture_limit() -> tuple[np.ndarray, np.ndarray]:
    """Return the densities of the mixture, and its probability of no return."""
    log_p = log_mixture(READINGS, EXPECTED[:, None], range_max=RANGE, **MIXTURE.to_dict())
    return np.exp(log_p), np.full(len(EXPECTED), MIXTURE.z_max)


def waiting_limit() -> tuple[np.ndarray, np.ndarray]:
    """Return the densities of the first of three waits, and the probability that none ends."""
    z, c, ahead = READINGS, CAUSES, EXPECTED[:, None]
    normal = truncnorm(-ahead / c.sigma_hit, (RANGE - ahead) / c.sigma_hit, loc=ahead, scale=c.sigma_hit)
    missed = 1 - c.p_detect * normal.cdf(z)
    survival = np.exp(-c.lambda_short * np.minimum(z, ahead) - c.lambda_rand * z) * missed
    rate = c.lambda_short * (z < ahead) + c.lambda_rand + c.p_detect * normal.pdf(z) / missed
    none = np.exp(-c.lambda_short * EXPECTED - c.lambda_rand * RANGE) * (1 - c.p_detect)
    return survival * rate, none


def errors(causes: object, limit: tuple[np.ndarray, np.ndarray], bins: int, away: float) -> tuple[float, float]:
    """Return the largest errors of density [1/m] and of the probability of no return."""
    model = gs.DiscreteBeamModel(causes, RANGE, bins)
    found = np.exp(model.log_likelihood(*np.broadcast_arrays(READINGS, EXPECTED[:, None])))
    none = np.exp(model.log_likelihood(np.full(len(EXPECTED), np.inf), EXPECTED))
    sure = np.abs(READINGS - EXPECTED[:, None]) > away
    return float(np.abs(found - limit[0])[sure].max()), float(np.abs(none - limit[1]).max())


def draw_convergence(path: Path, bins: list[int]) -> list[tuple[float, ...]]:
    """Plot errors over the width of bins, and return the rows of the table."""
    figure = new_figure(6.4, 4.6)
    ax = figure.subplots()
    width = RANGE / np.array(bins)
    columns: list[list[float]] = []
    cases = (("a mixture's causes", MIXTURE, mixture_limit()), ("separate causes", CAUSES, waiting_limit()))
    for colour, (label, causes, limit) in zip(("#1b6ca8", "#c8553d"), cases, strict=True):
        found = np.array([errors(causes, limit, count, float(width[0])) for count in bins]).T
        for style, what, values in zip(("o-", "s--"), ("density [1/m]", "no return"), found, strict=True):
            ax.loglog(width, values, style, color=colour, label=f"{label}: {what}", ms=4)
            columns.append(values.tolist())
    ax.loglog(width, 0.3 * width, ":", color="black", label="first order")
    ax.set(xlabel="width of a bin [m]", ylabel="largest error", title="The discrete model and its limits")
    ax.legend(fontsize="small")
    save(figure, path)
    return list(zip(width.tolist(), *columns, strict=True))


def independent(c: gs.DiscreteCauses, expected: float) -> gs.BeamParameters:
    """Make a mixture whose components have the causes' shares without occlusion by each other."""
    short, rand = 1 - np.exp(-c.lambda_short * expected), 1 - np.exp(-c.lambda_rand * RANGE)
    none = 1 - c.p_detect
    total = c.p_detect + short + rand + none
    values = dict(z_hit=c.p_detect / total, z_short=short / total, z_max=none / total, z_rand=rand / total)
    return gs.BeamParameters(**values, sigma_hit=c.sigma_hit, lambda_short=c.lambda_short)


def draw_rows(path: Path) -> None:
    """Draw rows of the tables of two sensors at two distances."""
    figure = new_figure(11.0, 6.4)
    axes = figure.subplots(2, 2, sharey="row")
    for row, (name, causes) in zip(axes, SENSORS.items(), strict=True):
        for ax, distance in zip(row, (1.5, 4.5), strict=True):
            edges = np.linspace(0, RANGE, 61)
            index = int(distance * 10)
            kinds = (("dependent causes", causes), ("independent causes", independent(causes, distance)))
            for colour, (label, own) in zip(("#c8553d", "#1b6ca8"), kinds, strict=True):
                p = gs.DiscreteBeamModel(own, RANGE, 60).probabilities[index]
                ax.stairs(p[:-1], edges, color=colour, label=f"{label}, no return {p[-1]:.3f}", lw=1.4)
            ax.set(yscale="log", ylim=(3e-4, None), title=f"{name}, obstacle expected at {distance} m",
                   xlabel="reading [m]")  # fmt: skip
            ax.legend(fontsize="small")
        row[0].set_ylabel("probability of a bin of 0.1 m")
    save(figure, path)


def main() -> int:
    """Draw the plots and write the table."""
    parser = make_parser(__doc__, backend="")
    parser.add_argument("--figures", type=Path, default=FIGURES, help="folder for the drawings (default: docs/img)")
    parser.add_argument("--most", type=int, default=2048, help="most bins")
    arguments = parse(parser)
    arguments.figures.mkdir(parents=True, exist_ok=True)
    bins = [2**k for k in range(5, 13) if 2**k <= arguments.most]
    rows = draw_convergence(arguments.figures / "discrete_convergence.png", bins)
    draw_rows(arguments.figures / "discrete_rows.png")
    columns = (
        "bins", "width [m]", "a mixture's causes: density [1/m]", "no return", "separate causes: density", "no return",
    )  # fmt: skip
    lines = (
        [count, f"{width:.4f}", *(f"{value:.1e}" for value in values)]
        for count, (width, *values) in zip(bins, rows, strict=True)
    )
    publish(__file__, arguments, table(columns, lines), {"bins": bins, "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
