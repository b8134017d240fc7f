"""Likelihoods and associations of features by densities in mpmath, and the bound of their errors."""

from __future__ import annotations

import itertools
from typing import Any

import mpmath as mp
import numpy as np

from gpusense.evaluation.tolerances import TOLERANCES

# (N, F, M) densities p(f | j), each with whether the feature may be of the landmark.
Densities = list[list[list[tuple[Any, bool]]]]


def log(p: Any) -> float:
    return float(mp.log(p)) if p > 0 else -np.inf


def weighted(p: Any, false: list[Any]) -> tuple[Any, list[Any]]:
    """Return the weights of landmarks, and the densities of false positives times their weight."""
    return mp.mpf(p.z_detect), [mp.mpf(p.z_false) * one for one in false]


def likelihoods(model: Any, densities: Densities, false: list[Any], correspondence: Any = None) -> np.ndarray:
    """Return (N, F) float64 log p of each feature, without joint association; ``false``: p(f) of false positives."""
    detect, misses = weighted(model.parameters, false)
    found = np.empty((len(densities), len(false)))
    for n, rows in enumerate(densities):
        for k, row in enumerate(rows):
            if correspondence is not None:
                of_landmarks = row[correspondence[k]][0] if correspondence[k] >= 0 else mp.mpf(0)
            else:
                of = [d for d, may in row if may] or [mp.mpf(0)]
                of_landmarks = mp.fsum(of) / len(row) if model.association == "sum" and row else max(of)
            found[n, k] = log(detect * of_landmarks + misses[k])
    return found


def joint(model: Any, densities: Densities, false: list[Any], apart: Any = None) -> np.ndarray:
    """Return (N,) float64 log p of the likeliest joint association by trying all.

    ``apart``: (F, F) pairs of features that may be of one landmark; None for none.
    """
    detect, misses = weighted(model.parameters, false)
    may_share = np.zeros((len(false), len(false)), bool) if apart is None else apart
    found = np.full(len(densities), -np.inf)
    for n, rows in enumerate(densities):
        options = [
            [(-1, log(none))] + [(j, log(detect * d + none)) for j, (d, may) in enumerate(row) if may]
            for row, none in zip(rows, misses, strict=True)
        ]
        for chosen in itertools.product(*options):
            pairs = itertools.combinations(range(len(chosen)), 2)
            if all(chosen[a][0] < 0 or chosen[a][0] != chosen[b][0] or may_share[a, b] for a, b in pairs):
                found[n] = max(found[n], sum(value for _, value in chosen))
    return found


def assert_within(found: np.ndarray, expected: np.ndarray, terms: int = 1) -> None:
    """Check for equal infinities, no NaN, and the table's tolerance times the number of terms of a sum."""
    eps = np.finfo(found.dtype).eps
    assert not np.isnan(found).any()
    np.testing.assert_array_equal(np.isneginf(found), np.isneginf(expected))
    finite = np.isfinite(expected)
    apart = np.abs(found[finite].astype(np.float64) - expected[finite])
    worst = np.max(apart / (eps * (terms + np.abs(expected[finite]))), initial=0.0)
    assert worst <= TOLERANCES["landmark"].value, f"{worst:.1f} eps (1 + |log p|)"
