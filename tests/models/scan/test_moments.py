"""The offset of correct ranges and the growth of their deviation: densities, models on every backend, the fit."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from mpmath import mp

import gpusense as gs
from gpusense.evaluation.tolerances import per_beam
from gpusense.models.scan.densities import log_mixture

RANGE = 8.0
SHAPES = {
    "offset": dict(range_bias=0.07),
    "offset before the wall": dict(range_bias=-0.6),
    "offset beyond the range": dict(range_bias=9.5),
    "growth": dict(sigma_growth=0.03),
    "both": dict(range_bias=0.03, sigma_growth=0.01),
}
MIXTURES = {
    "book": gs.BeamParameters(),
    "no rand": gs.BeamParameters(0.9, 0.05, 0.05, 0.0, 0.1, 0.3),
    "hit alone": gs.BeamParameters(1.0, 0.0, 0.0, 0.0, 0.2),
    "sharp": gs.BeamParameters(0.7, 0.1, 0.1, 0.1, 1e-3),
    "sharp without rand": gs.BeamParameters(1.0, 0.0, 0.0, 0.0, 1e-4),
}


def exact_log_mixture(z: float, expected: float, p: gs.BeamParameters) -> mp.mpf:
    """Return log p by equations 6.4 to 6.12 with 60 digits."""
    with mp.workdps(60):
        z, e, top = mp.mpf(z), mp.mpf(expected), mp.mpf(RANGE)
        mean = min(max(e + mp.mpf(p.range_bias), 0), top)
        sigma = mp.mpf(p.sigma_hit) + mp.mpf(p.sigma_growth) * e
        mass = mp.ncdf((top - mean) / sigma) - mp.ncdf(-mean / sigma)
        density = p.z_hit * mp.npdf(z, mean, sigma) / mass + p.z_rand / top
        if p.z_short and z <= e and e > 0:
            rate = mp.mpf(p.lambda_short)
            density += p.z_short * rate * mp.exp(-rate * z) / (1 - mp.exp(-rate * e))
        return mp.log(density)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", MIXTURES)
def test_densities_are_those_of_60_digits(name, shape):
    p = MIXTURES[name].replace(**SHAPES[shape])
    for expected in (0.0, 0.4, 3.0, 7.9, 8.0):
        mean, sigma = np.clip(expected + p.range_bias, 0, RANGE), p.sigma_hit + p.sigma_growth * expected
        for z in np.clip(mean + sigma * np.array([-30, -3, -1, 0, 0.5, 4]), 0, RANGE - 1e-9):
            truth = exact_log_mixture(z, expected, p)
            found = log_mixture(z, expected, range_max=RANGE, **p.to_dict())
            # The mean is a float64.
            rounding = abs(z - mean) / sigma**2 * np.spacing(max(mean, expected))
            assert abs(found - truth) <= 1e-11 * (1 + abs(truth)) + rounding


def scene(real):
    """Return a map, a scanner, poses, and readings around their expected ranges."""
    rng = np.random.default_rng(3)
    grid = gs.OccupancyGrid(np.where(rng.random((80, 90)) < 0.02, 100, 0), 0.1)
    scanner = gs.Scanner.uniform(angle_min=-2, angle_increment=0.1, count=40, range_max=RANGE)
    poses = rng.uniform((1, 1, -3), (8, 7, 3), (33, 3))
    expected = gs.RayCaster(grid, RANGE, backend="numpy", precision=real).cast(poses, scanner.bearings)
    return grid, scanner, poses, expected


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("real", ["float32", "float64"])
@pytest.mark.parametrize("shape", SHAPES)
def test_models_have_the_densities_on_every_backend(shape, real, backend):
    grid, scanner, poses, expected = scene(real)
    names = list(MIXTURES)
    if backend.startswith("warp"):
        names = ["book" if real == "float32" else "sharp without rand"]
    elif backend != "numpy":
        names = names[real == "float64" :: 2]
    cases = list(itertools.product(names, (False, True)))
    if backend != "numpy":
        # With and without code for causes of weight 0, in turn.
        cases = [(name, (number + (real == "float64")) % 2 == 0) for number, name in enumerate(names)]
    for name, wide in cases:
        p = MIXTURES[name].replace(**SHAPES[shape])
        # Readings at several deviations around the expected ranges of one pose.
        sigma = p.sigma_hit + p.sigma_growth * expected[5]
        around = np.clip(expected[5] + p.range_bias, 0, RANGE)
        z = np.clip(around + sigma * np.resize([0, -0.5, 1, 2.5, -3.5, 0.01], 40), 0, np.nextafter(RANGE, 0))
        z = np.minimum(z.astype(real), np.nextafter(np.dtype(real).type(RANGE), 0))
        model = gs.BeamModel(grid, scanner, p, backend=backend, precision=real, specialize=not wide)
        log_p, parts = model.log_likelihood(poses, z, per_beam=True)
        truth = log_mixture(z.astype(float), expected.astype(float), range_max=RANGE, **p.to_dict())
        with np.errstate(invalid="ignore"):
            error = np.where(parts == truth, 0, np.abs(parts - truth))
        assert (error <= 2 * per_beam(truth, np.dtype(real).type)).all()
        assert (log_p == model.log_likelihood(poses, z)).all() or backend.startswith("warp:cuda")


@pytest.mark.long
@pytest.mark.parametrize("growth", [0.0, 0.1])
def test_small_offsets_of_narrow_densities_keep_all_digits(growth, backend):
    """The offset has digits beyond the last digit of z - z*, of equal size."""
    grid, scanner, poses, expected = scene("float32")
    rng = np.random.default_rng(8)
    for sigma, bias in ((1e-4, -1.5e-3), (1e-4, 2.3e-4), (2e-3, 0.7), (3e-3, -0.0123), (0.02, 3.1)):
        p = gs.BeamParameters(0.9, 0.05, 0.0, 0.05, sigma, range_bias=bias, sigma_growth=growth * sigma)
        z = np.abs(expected[5] + bias + sigma * rng.uniform(-4, 4, 40)).astype(np.float32)
        model = gs.BeamModel(grid, scanner, p, backend=backend)
        _, parts = model.log_likelihood(poses[5:6], z, per_beam=True)
        within = z < RANGE
        truth = log_mixture(z.astype(float), expected[5].astype(float), range_max=RANGE, **p.to_dict())
        assert within.sum() > 5
        assert (np.abs(parts[0] - truth) <= per_beam(truth, np.float32))[within].all()


@pytest.mark.long
@pytest.mark.parametrize("shape", ["normal", "student"])
def test_a_mean_that_rounds_to_the_longest_range_has_half_of_its_mass(shape, backend):
    """The sum of z* and the bias exceeds range_max by less than half of its last bit, many sigma."""
    grid, scanner, poses, expected = scene("float32")
    start = float(expected[5, 0])
    bias = RANGE - start + 2e-7
    assert np.float32(start) + np.float32(bias) == RANGE < start + bias
    z = np.full(expected.shape[1], np.nan, np.float32)
    z[0] = np.nextafter(np.float32(RANGE), np.float32(0))
    for sigma in (1e-7, 1e-6, 1e-5):
        p = gs.BeamParameters(0.9, 0.0, 0.0, 0.1, sigma, range_bias=bias, hit=shape)
        log_p = gs.BeamModel(grid, scanner, p, backend=backend).log_likelihood(poses[5:6], z)
        # The mean moves by half of its last bit, and half of the density is below it.
        offset, moved = RANGE - z[0], RANGE - z[0] + 2.4e-7
        near, far = (
            log_mixture(RANGE - by, RANGE, range_max=RANGE, **p.replace(range_bias=0.0).to_dict())
            for by in (offset, moved)
        )
        assert far - 1e-3 <= log_p[0] <= near + 1e-3, (sigma, far, near)


@pytest.mark.parametrize("peer", ["amcl", "beluga"])
def test_other_programs_have_neither(peer):
    grid, scanner, *_ = scene("float32")
    for p in (gs.BeamParameters(range_bias=0.1), gs.BeamParameters(sigma_growth=0.1)):
        with pytest.raises(ValueError, match="parameters: range_bias and sigma_growth must be 0 with compat"):
            gs.BeamModel(grid, scanner, p, backend="numpy", compat=peer)


def test_a_start_that_grows_with_range_is_refused():
    with pytest.raises(ValueError, match="initial: sigma_growth must be 0"):
        gs.fit_beam_parameters([1.0], [1.0], RANGE, initial=gs.BeamParameters(sigma_growth=0.1), backend="numpy")
