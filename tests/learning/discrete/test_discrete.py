"""The discrete model: probabilities of steps against exact arithmetic and simulated causes, and its limits."""

from __future__ import annotations

import functools
import itertools
import math
from fractions import Fraction

import mpmath as mp
import numpy as np
import pytest
from support.oracles import Mixture

import gpusense as gs
from gpusense.learning.discrete.probabilities import bins_of, log_spread

RANGE = 6.0
CAUSES = {
    "laser": gs.DiscreteCauses(0.05, 0.01, 0.95, 0.05),
    "sonar": gs.DiscreteCauses(0.2, 0.05, 0.8, 0.6),
    "certain": gs.DiscreteCauses(0.0, 0.0, 1.0, 0.4),
    "crowd": gs.DiscreteCauses(40.0, 3.0, 0.5, 0.2),
    "wide": gs.DiscreteCauses(0.1, 0.0, 1.0, 1e6),
    "sharp": gs.DiscreteCauses(0.1, 1e-12, 1.0, 1e-8),
    "no noise": gs.DiscreteCauses(0.1, 0.05, 0.7, 0.0),
}
MIXTURES = {
    "all": gs.BeamParameters(0.7, 0.1, 0.1, 0.1, sigma_hit=0.3, lambda_short=0.4),
    "no max": gs.BeamParameters(0.6, 0.3, 0.0, 0.1, sigma_hit=1.0, lambda_short=0.0),
    "hit": gs.BeamParameters(1.0, 0.0, 0.0, 0.0, sigma_hit=0.5),
    "hit, max": gs.BeamParameters(0.8, 0.0, 0.2, 0.0, sigma_hit=1e-8 * RANGE),
    "short": gs.BeamParameters(0.0, 0.9, 0.1, 0.0, lambda_short=1e6),
    "rand": gs.BeamParameters(0.0, 0.0, 0.0, 1.0),
    "max": gs.BeamParameters(0.0, 0.0, 1.0, 0.0),
}


def exact(number) -> Fraction:
    """Return a number of mpmath as a fraction, to its last digit; 0 if it has thousands of leading zeros."""
    if abs(number) < mp.mpf(10) ** -2000:
        return Fraction(0)
    sign, man, exponent, _ = mp.mpf(number)._mpf_
    return (-1) ** sign * Fraction(man) * Fraction(2) ** exponent


@functools.cache
def spread_exactly(d: int, s: float):
    """Return the share of readings d steps from the obstacle: the integral of a triangle times a normal density."""
    if s == math.inf:
        return mp.mpf(d == 0)
    # The integral is split at a narrow peak, so that nodes sample it.
    points = sorted({d - 1, d, d + 1, *(mp.mpf(u) / s for u in (-40, -6, 6, 40) if d - 1 < u / s < d + 1)})
    return mp.quad(lambda v: s * (1 - abs(v - d)) * mp.npdf(v * s), points)


def walk(causes: list[list[Fraction]]) -> list[Fraction]:
    """Return P of each step and of no return, from each cause's probability of triggering at a reached step."""
    reached, row = Fraction(1), []
    for probabilities in zip(*causes, strict=True):
        none = math.prod((1 - p for p in probabilities), start=Fraction(1))
        row.append(reached * (1 - none))
        reached *= none
    return [*row, reached]


def separate_exactly(c: gs.DiscreteCauses, bins: int, j: int) -> list[Fraction]:
    w = mp.mpf(RANGE) / bins
    unknown, random = (exact(1 - mp.exp(-mp.mpf(rate) * w)) for rate in (c.lambda_short, c.lambda_rand))
    shares = [Fraction(0)] * bins
    if j < bins:
        s = float(w) / c.sigma_hit if c.sigma_hit else math.inf
        mass = [exact(spread_exactly(abs(i - j), s)) for i in range(bins)]
        shares = [Fraction(c.p_detect) * m / sum(mass) for m in mass]
    seen, detected = Fraction(0), []
    for share in shares:
        detected.append(share / (1 - seen) if seen < 1 else Fraction(0))
        seen += share
    return walk([[unknown if i <= j else Fraction(0) for i in range(bins)], [random] * bins, detected])


def shared_exactly(p: gs.BeamParameters, bins: int, j: int) -> list[Fraction]:
    w, last = mp.mpf(RANGE) / bins, min(j + 1, bins)
    mass = [spread_exactly(abs(i - j), float(w) / p.sigma_hit) for i in range(bins)]
    if sum(mass) == 0:  # All mass is beyond, infinitely far for 60 digits: the nearest step gets it.
        mass[-1] = mp.mpf(1)
    hit = [exact(m / sum(mass)) for m in mass]
    decay = [mp.exp(-mp.mpf(p.lambda_short) * w * i) if i < last else mp.mpf(0) for i in range(bins)]
    short = [exact(m / sum(decay)) for m in decay]
    weights = [Fraction(v) for v in (p.z_hit, p.z_short, p.z_rand)]
    total = sum(weights) + Fraction(p.z_max)
    parts = [
        [v / total * m for m in own] for v, own in zip(weights, (hit, short, [Fraction(1, bins)] * bins), strict=True)
    ]
    left = [1 - sum(sum(own[:i]) for own in parts) for i in range(bins)]
    return walk([[m / rest if rest else Fraction(0) for m, rest in zip(own, left, strict=True)] for own in parts])


def assert_close(log_p: np.ndarray, truth: list[Fraction]) -> None:
    """Check a sum of a dozen logarithms, each exact to some relative eps, within 64 eps."""
    for found, wanted in zip(log_p, truth, strict=True):
        if wanted < Fraction(10) ** -50:  # 60 digits do not distinguish it from 0.
            assert found < -110
            continue
        log = float(mp.log(mp.mpf(wanted.numerator) / wanted.denominator))
        assert abs(found - log) <= 64 * 2.2e-16 * (1 + abs(log)), (found, log)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("bins", [1, 2, 7])
@pytest.mark.parametrize("name", [*CAUSES, *MIXTURES])
def test_causes_are_those_of_exact_arithmetic(name, bins):
    """A mixture's causes are shared, others act separately."""
    causes, exactly = (CAUSES[name], separate_exactly) if name in CAUSES else (MIXTURES[name], shared_exactly)
    table = gs.DiscreteBeamModel(causes, RANGE, bins)
    for j in range(bins + 1):
        truth = exactly(causes, bins, j)
        assert sum(truth) == 1
        assert_close(table.log_probabilities[j], truth)


@pytest.mark.parametrize("s", [1e-8, 1e-3, 0.1, 0.49, 0.5, 0.51, 2.0, 40.0, 1e6])
def test_the_spread_of_a_detection_keeps_its_digits_everywhere(s):
    """The truth is second differences, with compensating digits."""

    def tail(x):
        return mp.npdf(x) - x * mp.erfc(x / mp.sqrt(2)) / 2

    found = log_spread(4096, s, 1.0)
    for d in (0, 1, 2, 3, 17, 59, 60, 61, 100, 1000, 4096):
        with mp.workdps(120):
            x, step = mp.mpf(d) * mp.mpf(s), mp.mpf(s)
            if x > 1e5:
                continue
            truth = float(mp.log((tail(x - step) - 2 * tail(x) + tail(x + step)) / step))
        assert abs(found[d] - truth) <= 8 * 2.2e-16 * (1 + abs(truth)), d


def simulate(c: gs.DiscreteCauses, bins: int, j: int, count: int, random: np.random.Generator) -> np.ndarray:
    """Return steps of readings: draw where each cause would trigger, and take the first."""
    width = RANGE / bins
    first = np.full(count, bins)
    unknown = random.exponential(1 / c.lambda_short, count) // width
    first = np.minimum(first, np.where(unknown <= j, unknown, bins))
    first = np.minimum(first, random.exponential(1 / c.lambda_rand, count) // width)
    if j < bins:
        at = np.full(count, np.nan)
        while (again := ~((at >= 0) & (at < RANGE))).any():
            at[again] = (j + random.random(again.sum())) * width + c.sigma_hit * random.normal(size=again.sum())
        first = np.minimum(first, np.where(random.random(count) < c.p_detect, at // width, bins))
    return np.minimum(first, bins).astype(int)


@pytest.mark.parametrize("name", ["laser", "sonar", "crowd"])
def test_simulated_causes_have_the_frequencies_of_the_table(name):
    """Counts are binomial: one of 100 is 6 deviations off once in 5 million tests; rare steps are allowed 6 more."""
    bins, count, random = 12, 200_000, np.random.default_rng(3)
    table = gs.DiscreteBeamModel(CAUSES[name], RANGE, bins).probabilities
    for j in (0, 3, 8, 11, 12):
        found = np.bincount(simulate(CAUSES[name], bins, j, count, random), minlength=bins + 1)
        assert (np.abs(found - count * table[j]) <= 6 + 6 * np.sqrt(count * table[j] * (1 - table[j]))).all()


EXTREMES = [
    *(gs.DiscreteCauses(short, rand, p, sigma) for short, rand in ((0, 0), (1e-12, 1e6), (1e6, 0), (0.3, 1e-300))
      for p in (0.0, 0.5, 1.0) for sigma in (0.0, 1e-8 * RANGE, 0.1, 1e6 * RANGE)),
    *(gs.BeamParameters(*weights, sigma_hit=sigma, lambda_short=rate)
      for weights in ((1, 0, 0, 0), (0, 1, 0, 0), (0.5, 0.5, 0, 0), (0.7, 0.1, 0.1, 0.1))
      for rate in (0.0, 1e-12, 1e6) for sigma in (1e-8 * RANGE, 0.1, 1e6 * RANGE)),
]  # fmt: skip


@pytest.mark.sampled(1)
@pytest.mark.parametrize("bins", [1, 100, 1000])
def test_rows_sum_to_1_and_no_logarithm_is_nan(bins):
    for causes in EXTREMES if bins <= 100 else EXTREMES[::7]:
        table = gs.DiscreteBeamModel(causes, RANGE, bins)
        assert not np.isnan(table.log_probabilities).any() and table.log_probabilities.max() < 1e-12, causes
        assert np.abs(table.probabilities.sum(axis=1) - 1).max() <= 1e-12, causes
        assert table.probabilities.shape == (bins + 1, bins + 1)


def test_a_reading_is_impossible_only_where_it_is():
    """Logarithms do not underflow: even without random triggers, a reading 300 deviations away is possible."""
    far = gs.DiscreteBeamModel(gs.DiscreteCauses(0.0, 0.0, 0.9, 0.01), RANGE, 100).log_probabilities
    assert np.isfinite(far[:-1]).all() and far.min() < -1e4
    # A beam that no cause triggers has no return.
    assert (far[-1] == [*[-math.inf] * 100, 0]).all()


def test_without_noise_and_other_causes_one_step_has_it_all():
    table = gs.DiscreteBeamModel(gs.DiscreteCauses(0.0, 0.0, 1.0, 0.0), RANGE, 50)
    np.testing.assert_array_equal(table.probabilities, np.eye(51))
    nothing = gs.DiscreteBeamModel(gs.DiscreteCauses(0.0, 0.0, 0.0, 0.1), RANGE, 50)
    np.testing.assert_array_equal(nothing.probabilities[:, -1], 1)
    mixture = gs.DiscreteBeamModel(gs.BeamParameters(0, 0, 1, 0), RANGE, 50)
    np.testing.assert_array_equal(mixture.probabilities[:, -1], 1)


def test_causes_that_trigger_earlier_hide_later_ones():
    """The share of beams that continue falls along the beam, and falls everywhere with more unknown obstacles."""

    def survival(rate: float) -> np.ndarray:
        p = gs.DiscreteBeamModel(gs.DiscreteCauses(rate, 0.02, 0.9, 0.2), RANGE, 60).probabilities
        return np.cumsum(p[:, ::-1], axis=1)[:, ::-1]

    rates = [survival(rate) for rate in (0.0, 0.1, 0.5, 2.0)]
    for each in rates:
        assert (np.diff(each, axis=1) <= 0).all()
    for fewer, more in itertools.pairwise(rates):
        assert (more <= fewer + 1e-14).all() and (more[:, 1] < fewer[:, 1]).all()
    # Independent causes would detect far obstacles as often as near ones.
    p = gs.DiscreteBeamModel(gs.DiscreteCauses(0.5, 0.0, 1.0, 0.0), RANGE, 60).probabilities
    np.testing.assert_allclose(np.diagonal(p)[:-1], np.exp(-0.5 * 0.1 * np.arange(60)), rtol=1e-13)


def densities(causes: object, bins: int, z: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return densities at readings, and probabilities of no return."""
    table = gs.DiscreteBeamModel(causes, RANGE, bins)
    none = table.log_likelihood(np.full(len(expected), math.inf), expected)
    each = np.broadcast_arrays(z, expected[:, None])
    return np.exp(table.log_likelihood(*each)), np.exp(none)


BINS = (64, 128, 256, 512, 1024)


def assert_first_order(errors: list[float]) -> None:
    """Check that halving the width halves the mean error; 1.6 allows for the places within a bin."""
    assert (np.array(errors[:-1]) / errors[1:] > 1.6).all(), errors


@pytest.mark.parametrize("name", ["all", "no max", "hit"])
def test_the_mixture_is_the_limit_of_shared_causes(name):
    """At every z except near p_short's jump at z*, as long as some mass is beyond."""
    p, expected = MIXTURES[name].replace(lambda_short=0.4), np.append(np.linspace(0.41, 5.83, 37), RANGE)
    z = np.linspace(0.01, RANGE - 1.0, 173)
    each = np.broadcast_arrays(z, expected[:, None])
    truth = np.exp(Mixture.of(p, RANGE).log_densities(*each).astype(float))
    sure = np.abs(z - expected[:, None]) > RANGE / BINS[0]
    errors, atoms = [], []
    for bins in BINS:
        found, none = densities(p, bins, z, expected)
        errors.append(np.abs(found - truth)[sure].mean())
        atoms.append(np.abs(none - p.z_max).mean())
    assert_first_order(errors)
    if name == "all":
        assert_first_order(atoms)
    if name == "hit":  # One cause never meets another.
        assert max(atoms) < 1e-12


def test_the_limit_of_separate_causes_is_that_of_the_first_of_three_waits():
    """``S(z) (lambda_short [z < z*] + lambda_rand + p f / (1 - p F))``, f and F the truncated normal's."""
    from scipy.stats import truncnorm

    c, expected = CAUSES["sonar"], np.linspace(0.41, 5.83, 37)
    z = np.linspace(0.01, RANGE - 0.01, 173)
    ends = (0 - expected[:, None]) / c.sigma_hit, (RANGE - expected[:, None]) / c.sigma_hit
    normal = truncnorm(*ends, loc=expected[:, None], scale=c.sigma_hit)
    missed = 1 - c.p_detect * normal.cdf(z)
    survival = np.exp(-c.lambda_short * np.minimum(z, expected[:, None]) - c.lambda_rand * z) * missed
    rate = c.lambda_short * (z < expected[:, None]) + c.lambda_rand + c.p_detect * normal.pdf(z) / missed
    sure = np.abs(z - expected[:, None]) > RANGE / BINS[0]
    atom = np.exp(-c.lambda_short * expected - c.lambda_rand * RANGE) * (1 - c.p_detect)
    errors, atoms = [], []
    for bins in BINS:
        found, none = densities(c, bins, z, expected)
        errors.append(np.abs(found - survival * rate)[sure].mean())
        atoms.append(np.abs(none - atom).mean())
    assert_first_order(errors)
    assert_first_order(atoms)


def test_readings_are_classed_as_everywhere_and_looked_up():
    table = gs.DiscreteBeamModel(CAUSES["laser"], 8.183, 81)
    top = np.float32(8.183)
    z = np.array([math.nan, -math.inf, -1, 0, 1.5, np.nextafter(top, np.float32(0)), top, math.inf, 9], np.float32)
    found = table.log_likelihood(z, np.full(9, 1.52))
    row = table.log_probabilities[15]
    log_width = math.log(8.183 / 81)
    assert found[:3].tolist() == [0, 0, 0]
    assert found[3:6].tolist() == [row[0] - log_width, row[14] - log_width, row[80] - log_width]
    assert found[6:].tolist() == [row[81]] * 3
    # Nothing is expected at a float32 range_max.
    assert table.log_likelihood(np.array([1.5]), np.array([top]))[0] == table.log_probabilities[81, 14] - log_width
    assert bins_of(np.array([0.0, 1.0, 6.0 - 1e-15, math.inf, math.nan]), RANGE, 6).tolist() == [0, 1, 5, 6, -1]


def test_a_model_is_a_value():
    table = gs.DiscreteBeamModel(CAUSES["laser"], RANGE, 20)
    assert table == gs.DiscreteBeamModel.from_dict(table.to_dict()) and table.bins == 20 and table.width == 0.3
    mixture = gs.DiscreteBeamModel(MIXTURES["all"], RANGE)
    assert gs.DiscreteBeamModel.from_dict(mixture.to_dict()) == mixture != table
    with pytest.raises(ValueError, match="read-only"):
        table.probabilities[0, 0] = 1
    with pytest.raises(AttributeError):
        table.bins = 3
