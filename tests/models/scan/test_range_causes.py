"""Densities of short, max and random readings are those of SciPy, and have one home on the host.

Where lambda_short counts twice, every user must give the results of a doubled parameter without the change.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats
from support.learning_data import point

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.learning.beam import growth, optimum, report
from gpusense.learning.beam.device_sums import DeviceSums, make_bounds
from gpusense.learning.beam.pairs import make_pairs
from gpusense.learning.beam.problem import NO_PRIOR, Problem
from gpusense.models.scan.densities import log_mixture
from gpusense.models.scan.mixture import learning_terms, mixture_of
from gpusense.world.range_causes import NoReturn, RandomDensity, ShortDensity

RANGE = 8.0
RNG = np.random.default_rng(5)
ROOM = gs.OccupancyGrid(np.pad(np.zeros((60, 70), int), 1, constant_values=100), 0.1)
SCANNER = gs.Scanner.uniform(angle_min=-2, angle_increment=0.2, count=20, range_max=RANGE)
POSES = RNG.uniform((1, 1, -3), (6, 5, 3), (5, 3))
Z = RNG.uniform(0.2, 7.9, 20)
WITH_MAX = np.where(np.arange(20) % 5 == 0, RANGE, Z)
EXPECTED = np.maximum(Z * RNG.uniform(0.9, 1.6, 20), 0.3).clip(max=RANGE)
BASE = gs.BeamParameters(0.6, 0.2, 0.1, 0.1, 0.3, 0.4)
HOST = dict(backend="numpy", precision="float64")


def test_densities_are_those_of_scipy():
    z, expected = np.linspace(0, 5, 30), 5.0
    for rate in (0.4, 30.0):
        law, short = stats.truncexpon(rate * expected, scale=1 / rate), ShortDensity(rate)
        np.testing.assert_allclose(short.log_pdf(z, np.full(30, expected)), law.logpdf(z), rtol=1e-12, atol=1e-13)
        assert short.mean(np.array(expected)) == pytest.approx(rate * law.mean())
        np.testing.assert_allclose(short.drawn(law.cdf(z[:4]), np.array(expected)), z[:4], rtol=1e-9, atol=1e-12)
        mass = short.log_mass(z[:-1], z[1] - z[0], np.array(expected))
        # Differences of SciPy's distribution function lose digits.
        np.testing.assert_allclose(np.exp(mass), np.diff(law.cdf(z)), rtol=0, atol=1e-13)
        step = (ShortDensity(rate * 1.001).log_pdf(z, np.array(expected)) - short.log_pdf(z, np.array(expected))) / 1e-3
        np.testing.assert_allclose(short.by_log_rate(z, np.array(expected)), step, atol=0.01 * rate)
    flat = ShortDensity(0.0)
    assert flat.log_pdf(np.array([2.0, 6.0]), np.array([5.0, 5.0])).tolist() == [-math.log(5), -np.inf]
    assert flat.log_mass(np.array([1.0, 5.0]), 1.0, np.array([5.0, 5.0])).tolist() == [-math.log(5), -np.inf]
    assert flat.drawn(0.5, np.array(5.0)) == pytest.approx(2.5)
    assert RandomDensity(5.0).log_pdf(np.array([0.0, 5.0])).tolist() == [-math.log(5), -np.inf]
    assert RandomDensity(5.0).peak(0.5) == pytest.approx(math.exp(RandomDensity(5.0).log_peak(0.5))) == 0.1
    assert NoReturn(0.0).number == NoReturn(np.zeros(1)).log_mass[0] == -np.inf


def models(p):
    """Return log-likelihoods of each beam, one row for each model, and their readings."""
    # Without random readings a kernel sums logarithms.
    logs = p.replace(z_hit=p.z_hit + p.z_rand, z_rand=0.0)
    bins = gs.IncidenceParameters((0, 0.7, np.pi / 2), (p, p.replace(z_hit=p.z_hit + p.z_max, z_max=0.0)))
    made = {
        "beam": gs.BeamModel(ROOM, SCANNER, p, **HOST),
        "sum of logarithms": gs.BeamModel(ROOM, SCANNER, logs, **HOST),
        "incidence": gs.BeamModel(ROOM, SCANNER, incidence=bins, **HOST),
        "everything kept": gs.BeamModel(ROOM, SCANNER, p, specialize=False, **HOST),
        "table": gs.BeamModel(ROOM, SCANNER, p, sensor_table=0.2, **HOST),
    }
    return {name: model.log_likelihood(POSES, WITH_MAX, per_beam=True)[1] for name, model in made.items()}


def learned(at):
    """Return quantities of fits by parameters: numbers of kernels, terms of starts, growth and blocks."""
    pairs = make_pairs(WITH_MAX, EXPECTED, RANGE)
    device = DeviceSums(get_backend("numpy"), np.dtype(np.float64), pairs)
    sample = optimum.Sample.of(pairs)
    z, expected = sample.reading[:, None], sample.expected[:, None]
    parts = optimum._log_components(sample, z, expected, *(np.array([each]) for each in (at.sigma, at.rate, 0.0)))
    bounds, shares = make_bounds(pairs), np.linspace(0.1, 1, len(z))[:, None]
    hit, short, top, rand = at.weights
    joint = growth._Growing(
        np.where(WITH_MAX < RANGE, WITH_MAX, 0.0), EXPECTED, WITH_MAX >= RANGE, RANGE, bounds, BASE, False, 4.0,
        growth.SHAPES["normal"],
    )  # fmt: skip
    rest = 1 - top
    theta = np.array([top, rand / rest, short / (hit + short), math.log(at.sigma), 0.01, math.log(at.rate)])
    log_p, gradient = joint.log_p(theta)
    return {
        "terms": np.array(learning_terms(at.parameters(), RANGE, device.real)[0]), "components": parts[..., 0],
        "density": log_p, "derivatives": gradient[:, 3:],
        "rate": optimum._next_rate(shares, z, expected, np.array([at.rate]), bounds),
        "blocks": report._terms(pairs.reading, pairs.expected, device.causes(at)[:, 1:], at, RANGE)[5],
        "objective": np.array(Problem(device, pairs, bounds, NO_PRIOR, False).value(at).log_likelihood),
    }  # fmt: skip


def numbers(p, real=np.float32):
    """Return the numbers of kernels that depend on the density; logarithms if it is far below the peak."""
    settings = dict(specialize=True, max_depends=False)
    # The other densities' peak decides whether a kernel sums densities; a steep one has a last range.
    far = p.replace(z_hit=p.z_hit + p.z_rand - 1e-7, z_rand=1e-7, lambda_short=1e23 * p.lambda_short)
    steep = p.replace(lambda_short=50 * p.lambda_short)
    flags, terms, _ = mixture_of((far,), RANGE, np.dtype(real), **settings)
    return {
        "sum of densities": np.array("LINEAR" in flags),
        "terms of logarithms": np.array([*terms.lambda_short, *terms.rand_density], float),
        "last range": mixture_of((steep,), RANGE, np.dtype(np.float64), **settings)[1].last_least[0],
    }  # fmt: skip


def drawn(p):
    """Return readings drawn by a model and by the simulation of worlds."""
    model = gs.BeamModel(ROOM, SCANNER, p, **HOST)
    worlds = gs.worlds.sample_readings(EXPECTED, RANGE, p, np.random.default_rng(1))
    return {"model": model.sample(POSES, seed=5), "worlds": np.nan_to_num(worlds, posinf=RANGE)}


def table(p):
    """Return the discrete model's table."""
    return {"discrete": np.array(gs.DiscreteBeamModel(p, range_max=RANGE, bins=20).sensor_table(np.float64))}


def mixture(weights, rate=BASE.lambda_short):
    """Return log densities of the host's mixture; weights need not be normalised."""
    hit, short, top, rand = weights
    shape = dict(sigma_hit=0.3, lambda_short=rate, range_max=RANGE)
    return {"mixture": log_mixture(WITH_MAX, EXPECTED, z_hit=hit, z_short=short, z_max=top, z_rand=rand, **shape)}


def compare(found, wanted, plain):
    assert found.keys() == wanted.keys() == plain.keys()
    for name, values in wanted.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-9, atol=1e-12, err_msg=name)
        assert not np.allclose(plain[name], values, rtol=1e-9, atol=1e-12), f"{name} does not depend on the density"


def test_a_made_up_short_density_is_followed(monkeypatch):
    def users(factor):
        p = BASE.replace(lambda_short=factor * BASE.lambda_short)
        found = models(p)
        peer = gs.BeamModel(ROOM, SCANNER, p, compat="beluga", **HOST).log_likelihood(POSES, Z)
        at = point(0.6, 0.2, 0.1, 0.1, sigma=0.3, rate=p.lambda_short)
        found |= learned(at) | numbers(p) | drawn(p) | table(p) | {"peer": peer}
        return found | mixture(at.weights, p.lambda_short)

    plain, wanted = users(1), users(2)
    monkeypatch.setattr(ShortDensity, "__init__", lambda self, rate: setattr(self, "rate", 2 * rate))
    compare(users(1), wanted, plain)
