"""Fit the weights of the probability that a match is right: ``gpusense/matching/verdicts.py``.

    GPUSENSE_DATA=DATA python bench/derive/match_evidence.py --backend opencl

Matches of half A of the recordings and of simulations (``bench/verdict_pairs.py``), with equal weight for right and
wrong ones in both. Logistic regression by Newton's method with a small quadratic penalty. Half B is held out.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from gpusense.matching.result import STATUSES
from gpusense.matching.verdicts import features_of

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import make_parser, parse
from verdict_pairs import HALF_A, recorded_pairs, simulated_pairs

# Statuses of matches whose scans agree; only these have a probability.
AGREE = ("converged", "unobservable", "ambiguous", "doubtful")
_PENALTY = 1e-3
assert set(AGREE) < set(STATUSES)


def logistic(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the constant and the weights of a logistic regression of labels (N,) on numbers (N, F)."""
    mean, scale = x.mean(axis=0), x.std(axis=0) + 1e-9
    z = np.column_stack([np.ones(len(x)), (x - mean) / scale])
    b, penalty = np.zeros(z.shape[1]), _PENALTY * weight.sum() * np.eye(z.shape[1])
    penalty[0, 0] = 0
    for _ in range(60):
        p = 1 / (1 + np.exp(-(z @ b)))
        step = np.linalg.solve(
            (z * (weight * p * (1 - p))[:, None]).T @ z + penalty, z.T @ (weight * (y - p)) - penalty @ b
        )
        b += step
        if np.abs(step).max() < 1e-9:
            break
    return float(b[0] - (b[1:] * mean / scale).sum()), b[1:] / scale


def main(argv: list[str] | None = None) -> None:
    """Fit, and print the constant and the weights."""
    parser = make_parser(__doc__, backend="auto")
    parser.add_argument("--count", type=int, default=200, help="matches of a kind and recording (default: %(default)s)")
    arguments = parse(parser, argv)
    backend, count, seed = arguments.backend, arguments.count, arguments.seed
    sets = [pairs for name in HALF_A for pairs in recorded_pairs(name, count, seed)]
    sets += list(simulated_pairs(backend, count // 4, seed))
    x, y, half = [], [], []
    for pairs in sets:
        match = pairs.match(backend)
        some = np.isin(match.status, AGREE)
        x.append(np.stack(features_of(match.evidence[some]), axis=1))
        y.append(pairs.right(match)[some])
        half.append(np.full(some.sum(), pairs.half))
    numbers, labels, halves = np.concatenate(x), np.concatenate(y), np.concatenate(half)
    weight = np.ones(len(labels))
    for which in "AS":
        for value in (False, True):
            some = (halves == which) & (labels == value)
            weight[some] = 1000 / max(some.sum(), 1)
    constant, weights = logistic(numbers, labels.astype(float), weight)
    print(f"{len(labels)} matches, {labels.mean():.3f} right")
    print(f"_CONSTANT = {constant:.3f}\n_WEIGHTS = ({', '.join(f'{value:.3f}' for value in weights)})")


if __name__ == "__main__":
    main()
