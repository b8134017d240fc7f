"""Single densities against mpmath at 60 digits and against quadrature, for any expected range."""

from __future__ import annotations

import itertools
import math

import mpmath as mp
import numpy as np
import pytest
from hypothesis import strategies as st
from support.textbook import textbook_log_hit, textbook_log_short

import gpusense as gs
from gpusense.models.scan.densities import log_hit, log_mixture, log_short

PRECISIONS = ("float64", "float32")


def exact_hit(z: float, expected: float, sigma: float, range_max: float) -> mp.mpf:
    """Return the truncated normal at 90 digits; the normaliser is the difference of the tails beyond z*."""
    with mp.workdps(90):
        z, expected, sigma, range_max = (mp.mpf(float(v)) for v in (z, expected, sigma, range_max))
        root = sigma * mp.sqrt(2)
        low, high = -expected / root, (range_max - expected) / root
        if low > 0:
            mass = (mp.erfc(low) - mp.erfc(high)) / 2
        elif high < 0:
            mass = (mp.erfc(-high) - mp.erfc(-low)) / 2
        else:
            mass = (mp.erf(high) - mp.erf(low)) / 2
        return -(((z - expected) / sigma) ** 2) / 2 - mp.log(sigma * mp.sqrt(2 * mp.pi)) - mp.log(mass)


def exact_short(z: float, expected: float, rate: float) -> mp.mpf:
    z, expected, rate = (mp.mpf(float(v)) for v in (z, expected, rate))
    return mp.log(rate / -mp.expm1(-rate * expected)) - rate * z if rate else -mp.log(expected)


def eps_off(found: float, truth: mp.mpf, precision: str) -> float:
    if not math.isfinite(found):
        return math.inf
    return float(abs(mp.mpf(float(found)) - truth) / (1 + abs(truth))) / float(np.finfo(precision).eps)


def worst_of(cases, ours, naive, exact, precision):
    """Return the worst error, and the shares of cases where the textbook's formula is not finite or wrong."""
    real, worst, lost, wrong = np.dtype(precision).type, (0.0, ()), 0, 0
    for case in cases:
        case = tuple(real(v) for v in case)
        truth = exact(*case)
        found = ours(*case)
        assert found.dtype == precision
        worst = max(worst, (eps_off(found, truth, precision), case))
        textbook = eps_off(naive(*case), truth, precision)
        lost += math.isinf(textbook)
        wrong += textbook > 1000
    return worst, lost / len(cases), wrong / len(cases)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_hit_for_any_expected_range(precision):
    cases = [
        (z * top, expected * top, sigma * top, top)
        for top, sigma, expected, z in itertools.product(
            (1.0, 80.0, 1e4),
            10.0 ** np.arange(-8, 7, 2),
            (-100.0, -1.0, -1e-3, -1e-9, 0.0, 1e-6, 0.3, 1.0, 1.0001, 2.0, 100.0),
            (0.0, 1e-9, 0.3, 0.999, 1.0),
        )
    ]
    worst, lost, wrong = worst_of(cases, log_hit, textbook_log_hit, exact_hit, precision)
    assert worst[0] <= 4, worst
    assert lost > 0.3
    assert wrong > 0.4


@pytest.mark.parametrize("precision", PRECISIONS)
def test_short_for_any_rate(precision):
    cases = [
        (share * expected, expected, rate)
        for expected, rate, share in itertools.product(
            (1e-30, 1e-6, 0.1, 3.0, 80.0), (0.0, 1e-30, 1e-12, 1e-3, 0.2, 1.0, 30.0, 1e6), (0.0, 0.1, 0.5, 1.0)
        )
    ]
    worst, lost, wrong = worst_of(cases, log_short, textbook_log_short, exact_short, precision)
    assert worst[0] <= 4, worst
    assert lost > 0.2
    assert wrong > 0.25


finite = st.floats(-3, 3)


@pytest.mark.parametrize("expected", [-20.0, -1.0, 0.0, 1e-6, 2.4, 7.992, 8.0, 9.0, 30.0])
@pytest.mark.parametrize("sigma", [1e-3, 0.1, 5.0, 1e5])
@pytest.mark.parametrize("rate", [0.0, 1e-9, 0.5, 200.0])
def test_continuous_part_and_atom_sum_to_one(expected, sigma, rate):
    """Gauss-Legendre quadrature in panels around the peak; p_short has no mass where z* <= 0, as in the book."""
    top = 8.0
    p = gs.BeamParameters(0.5, 0.2, 0.1, 0.2, sigma_hit=sigma, lambda_short=rate)
    steps = np.geomspace(1e-9, top, 60)
    bends = np.concatenate([expected + sigma * np.linspace(-12, 12, 25), [expected], steps, top - steps])
    edges = np.unique(np.clip(np.concatenate([[0, top], bends]), 0, top))
    nodes, weights = np.polynomial.legendre.leggauss(20)
    half = np.diff(edges)[:, None] / 2
    z = edges[:-1, None] + half * (1 + nodes)
    z = np.minimum(z, np.nextafter(top, 0))
    continuous = (np.exp(log_mixture(z, expected, range_max=top, **p.to_dict())) * half * weights).sum()
    atom = np.exp(log_mixture(top, expected, range_max=top, **p.to_dict()))
    lost = p.z_short if expected <= 0 else 0.0
    assert continuous + atom == pytest.approx(1 - lost, abs=1e-9)
