"""Readings drawn from beam models: distribution by SciPy, equal bits on every backend, and stiff cases."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtri
from support.array_libraries import to_device
from support.kernel_scenes import PRECISIONS

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.reference.sampling import half_mass, half_quantile, normal_within

# Every statistical test may fail by chance with this probability; seeds are fixed.
FALSE_ALARM = 1e-5
LIMIT = 8.1
ROOM = gs.OccupancyGrid(np.pad(np.zeros((40, 60), int), 1, constant_values=100), resolution=0.1)
SCANNER = gs.Scanner(np.linspace(-3.0, 3.0, 9), range_max=LIMIT, mount=(0.1, 0.05, 0.3))
P = gs.BeamParameters(z_hit=0.5, z_short=0.25, z_max=0.15, z_rand=0.1, sigma_hit=0.2, lambda_short=0.4)
POSE = (2.0, 1.5, 0.4)
BY_INCIDENCE = gs.IncidenceParameters(
    (0, 0.5, 1.0, np.pi / 2),
    (P, P.replace(sigma_hit=0.5), P.replace(range_bias=-0.3)),
    P.replace(z_hit=0.3, z_max=0.35),
)
TABLE = gs.DiscreteBeamModel(gs.DiscreteCauses(p_detect=0.8), range_max=LIMIT, bins=40)
SONAR = gs.Scanner(np.linspace(-3.0, 3.0, 5), range_max=3.0, cone=0.3, cone_rays=7, critical_incidence=0.5)
KINDS = {
    "beam": (SCANNER, P.replace(range_bias=0.2, sigma_growth=0.05), {}),
    "incidence": (SCANNER, None, dict(incidence=BY_INCIDENCE)),
    "table": (SCANNER, TABLE, {}),
    "sonar": (SONAR, P, {}),
    "look-up": (SCANNER, P, dict(caster=gs.casters.Lookup(bins=48))),
    "outside": (SCANNER, P, dict(outside="occupied", unknown="occupied")),
}


def model_of(kind: str, backend: str = "numpy", precision: str = "float64") -> gs.BeamModel:
    scanner, parameters, options = KINDS[kind]
    return gs.BeamModel(ROOM, scanner, parameters, backend=backend, precision=precision, **options)


def distribution(z: np.ndarray, expected: float, p: gs.BeamParameters, limit: float) -> np.ndarray:
    """Return SciPy's distribution function of a range that is no max reading."""
    mean, sigma = np.clip(expected + p.range_bias, 0, limit), p.sigma_hit + p.sigma_growth * expected
    hit = stats.truncnorm(-mean / sigma, (limit - mean) / sigma, mean, sigma).cdf(z)
    short = np.zeros_like(z)
    if expected > 0:
        short = stats.truncexpon(p.lambda_short * expected, scale=1 / p.lambda_short).cdf(np.minimum(z, expected))
        if p.lambda_short * expected < 1e-6:
            short = np.minimum(z / expected, 1.0)
    total = p.z_hit + p.z_rand + (p.z_short if expected > 0 else 0)
    parts = p.z_hit * hit + (p.z_short * short if expected > 0 else 0) + p.z_rand * z / limit
    return parts / total


@pytest.mark.parametrize(
    "changes",
    [{}, dict(sigma_hit=5.0), dict(sigma_hit=1e-3), dict(range_bias=-0.4, sigma_growth=0.2), dict(lambda_short=3.0),
     dict(lambda_short=1e-5), dict(z_hit=0.0, z_short=0.75), dict(z_short=0.0, z_hit=0.75), dict(range_bias=9.0)],
    ids=str,
)  # fmt: skip
def test_readings_have_the_density_of_the_mixture(changes):
    p = P.replace(**changes)
    model = gs.BeamModel(ROOM, SCANNER, p, backend="numpy", precision="float64")
    count = 20_000
    z, expected = model.sample([POSE] * count, seed=3), model.expected_ranges([POSE])[0]
    for beam in range(3):
        ranges = z[z[:, beam] < LIMIT, beam]
        assert (z[:, beam] == LIMIT).sum() == count - len(ranges)
        assert stats.binomtest(count - len(ranges), count, p.z_max).pvalue > FALSE_ALARM
        found = stats.kstest(ranges, lambda x, e=expected[beam]: distribution(x, float(e), p, LIMIT))
        assert found.pvalue > FALSE_ALARM, beam


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("kind", KINDS)
def test_shares_of_bins_are_those_of_the_log_likelihood(kind):
    # Chi-square over bins of readings, by the model's density and its atom of max readings.
    model = model_of(kind)
    limit, count, beam = model.scanner.range_max, 6000, 1
    z = model.sample([POSE] * count, seed=8)[:, beam]
    edges = np.linspace(0, limit, 21)
    fine = (np.arange(800) + 0.5) * limit / 800
    scans = np.full((len(fine) + 1, model.scanner.count), np.nan)
    scans[:-1, beam], scans[-1, beam] = fine, np.inf
    log_p = model.log_likelihood(np.broadcast_to(POSE, (len(scans), 1, 3)), scans)[:, 0]
    share = np.append(np.exp(log_p[:-1]).reshape(20, -1).sum(axis=1) * limit / 800, np.exp(log_p[-1]))
    assert abs(share.sum() - 1) < 0.02
    counts = np.append(np.histogram(z[z < limit], edges)[0], np.count_nonzero(z == limit))
    share = share / share.sum()
    kept = share * count > 8
    counts = np.append(counts[kept], counts[~kept].sum())
    share = np.append(share[kept], share[~kept].sum())
    some = share > 0
    assert stats.chisquare(counts[some], share[some] * count).pvalue > FALSE_ALARM and counts[~some].sum() == 0


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("kind", KINDS)
def test_readings_have_the_same_bits_on_every_backend(kind, precision, needs):
    poses = gs.worlds.cloud_uniform(ROOM, 120, np.random.default_rng(1))
    poses[:3] = [(0.05, 0.05, 0.0), (-1.0, 2.0, 0.1), (2.0, 2.0, 1e6)]  # In a wall, off the map, with a huge heading.
    expected = model_of(kind, precision=precision).sample(poses, seed=2**40 + 5, step=7)
    assert expected.dtype == precision and expected.shape == (120, KINDS[kind][0].count)
    for name in ("opencl", "warp"):
        found = model_of(kind, needs(name), precision).sample(poses, seed=2**40 + 5, step=7)
        bits = np.uint32 if precision == "float32" else np.uint64
        np.testing.assert_array_equal(found.view(bits), expected.view(bits))


def test_float32_readings_are_those_of_float64_rounded():
    one, two = (model_of("beam", precision=precision) for precision in ("float32", "float64"))
    poses = gs.worlds.cloud_uniform(ROOM, 200, np.random.default_rng(1))
    a, b = one.sample(poses, seed=4), two.sample(poses, seed=4)
    near = np.abs(a - b) < 1e-3
    assert near.mean() > 0.999 and (a[np.float32(LIMIT) == a].size == b[b == LIMIT].size)


def test_a_reading_depends_on_seed_step_pose_and_beam_alone(monkeypatch):
    model = model_of("beam")
    poses = gs.worlds.cloud_uniform(ROOM, 50, np.random.default_rng(1))
    z = model.sample(poses, seed=1, step=2)
    np.testing.assert_array_equal(model.sample(poses[:20], seed=1, step=2), z[:20])
    several = model.sample(np.stack([poses, poses + 0.01, poses]), seed=1, step=1)
    assert several.shape == (3, 50, SCANNER.count)
    np.testing.assert_array_equal(several[1], model.sample(poses + 0.01, seed=1, step=2))
    np.testing.assert_array_equal(several[2], model.sample(poses, seed=1, step=3))
    assert (model.sample(poses, seed=2, step=2) != z).mean() > 0.8
    assert (model.sample(poses, seed=1 + 2**32, step=2) != z).mean() > 0.8
    # In pieces.
    monkeypatch.setattr("gpusense.models.scan.map_caster.chunk_of", lambda *_: 7)
    np.testing.assert_array_equal(model.sample(poses, seed=1, step=2), z)
    np.testing.assert_array_equal(model.sample(np.stack([poses, poses + 0.01, poses]), seed=1, step=1), several)


def test_random_numbers_of_beams_poses_and_steps_are_independent():
    p = gs.BeamParameters(z_hit=0.0, z_short=0.0, z_max=0.0, z_rand=1.0)
    model = gs.BeamModel(ROOM, SCANNER, p, backend="numpy", precision="float64")
    z = model.sample(np.tile(POSE, (3, 20_000, 1)), seed=1) / LIMIT
    for a, b in ((z[0, :, 0], z[0, :, 1]), (z[0, 1:, 0], z[0, :-1, 0]), (z[0, :, 0], z[1, :, 0])):
        assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(20_000)
    assert stats.kstest(z.ravel(), "uniform").pvalue > FALSE_ALARM


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("sigma", [1e-8, 1e-4, 1.0, 1e3, 1e6])
def test_stiff_deviations_fail_nowhere(sigma, precision):
    p = gs.BeamParameters(z_hit=1.0, z_short=0.0, z_max=0.0, z_rand=0.0, sigma_hit=sigma * LIMIT)
    model = gs.BeamModel(ROOM, SCANNER, p, backend="numpy", precision=np.dtype(precision).name)
    poses = [(0.05, 0.05, 0.0), (-50.0, -50.0, 2.0), POSE]  # z* = 0, z* = range_max, and between.
    z = model.sample(np.tile(poses, (3000, 1)), seed=5).reshape(3000, 3, -1)
    assert np.isfinite(z).all() and (z >= 0).all() and (z < np.dtype(precision).type(LIMIT)).all()
    expected = model.expected_ranges(poses)
    if sigma <= 1e-4:
        eps = np.finfo(precision).eps
        np.testing.assert_allclose(z, np.broadcast_to(expected, z.shape), atol=8 * sigma * LIMIT + 4 * eps * LIMIT)
    if sigma >= 1e3:
        assert stats.kstest(z.ravel() / LIMIT, "uniform").pvalue > FALSE_ALARM
    log_p = model.log_likelihood(poses, z[0, 2])
    assert np.isfinite(log_p[2])


def test_every_reading_has_a_density():
    # Drawn readings are possible, even with hits next to range_max, weights of exactly 0 and 1, and rates of 0 and 1e6.
    rng = np.random.default_rng(1)
    poses = [gs.worlds.free_pose(ROOM, rng) for _ in range(20)]
    for changes in (dict(z_hit=1.0), dict(z_short=1.0), dict(z_max=1.0), dict(z_rand=1.0),
                    dict(z_short=1.0, lambda_short=0.0), dict(z_short=1.0, lambda_short=1e6),
                    dict(z_hit=1.0, range_bias=1e3)):  # fmt: skip
        p = gs.BeamParameters(**dict(z_hit=0.0, z_short=0.0, z_max=0.0, z_rand=0.0, sigma_hit=0.3) | changes)
        for precision in ("float32", "float64"):
            model = gs.BeamModel(ROOM, SCANNER, p, backend="numpy", precision=precision)
            for pose, z in zip(poses, model.sample(poses, seed=5), strict=True):
                assert not np.isnan(z).any() and np.isfinite(model.log_likelihood([pose], z)).all(), changes


def test_a_wall_at_the_sensor_leaves_short_readings_out():
    inside = [(0.05, 0.05, 0.0)] * 4000
    half = gs.BeamParameters(z_hit=0.0, z_short=0.5, z_max=0.25, z_rand=0.25)
    z = gs.BeamModel(ROOM, gs.Scanner([0.0], range_max=2.0), half, backend="numpy").sample(inside, seed=1)
    assert stats.binomtest(int((z == 2.0).sum()), 4000, 0.5).pvalue > FALSE_ALARM
    short = half.replace(z_short=1.0, z_max=0.0, z_rand=0.0)
    assert np.isnan(gs.BeamModel(ROOM, gs.Scanner([0.0], range_max=2.0), short, backend="numpy").sample(inside)).all()


def test_impossible_bins_of_a_table_are_never_drawn():
    causes = gs.DiscreteCauses(p_detect=1.0, lambda_short=0.0, lambda_rand=0.0, sigma_hit=0.0)
    table = gs.DiscreteBeamModel(causes, range_max=LIMIT, bins=1024)
    for precision in ("float32", "float64"):
        model = gs.BeamModel(ROOM, SCANNER, table, backend="numpy", precision=precision)
        poses = gs.worlds.cloud_uniform(ROOM, 100, np.random.default_rng(2))
        for pose, z in zip(poses, model.sample(poses, seed=1), strict=True):
            assert np.isfinite(model.log_likelihood([pose], z)).all()


def test_no_poses_no_beams_and_out():
    model = model_of("beam", precision="float32")
    assert model.sample(np.zeros((0, 3))).shape == (0, 9) and model.sample(np.zeros((2, 0, 3))).shape == (2, 0, 9)
    none = gs.BeamModel(ROOM, gs.Scanner([], range_max=2.0), P, backend="numpy")
    assert none.sample([POSE] * 3).shape == (3, 0)
    out = np.empty((2, 9), np.float32)
    assert model.sample([POSE] * 2, seed=3, out=out) is out
    np.testing.assert_array_equal(out, model.sample([POSE] * 2, seed=3))


def test_device_poses_give_device_readings(needs):
    backend = needs("warp")
    model = model_of("beam", backend)
    poses = np.array([POSE] * 5)
    z = model.sample(to_device(poses), seed=3)
    assert type(z).__module__.startswith("warp")
    np.testing.assert_array_equal(z.numpy(), model.sample(poses, seed=3))
    several = model.sample(to_device(np.stack([poses, poses])), seed=3)
    np.testing.assert_array_equal(several.numpy()[0], z.numpy())


@pytest.mark.parametrize("kind", ["beam", "incidence", "table"])
def test_a_device_without_float64_draws_the_same_bits(kind, monkeypatch):
    device = get_backend("numpy")
    poses = gs.worlds.cloud_uniform(ROOM, 60, np.random.default_rng(1))
    expected = model_of(kind, precision="float32").sample(poses, seed=3)
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, float64=False))
    np.testing.assert_array_equal(model_of(kind, precision="float32").sample(poses, seed=3), expected)


def test_weights_of_other_programs_and_fields_have_no_density():
    amcl = gs.BeamModel(ROOM, SCANNER, backend="numpy", compat="amcl")
    with pytest.raises(ValueError, match="compat: must be None where readings are drawn, got 'amcl'"):
        amcl.sample([POSE])
    with pytest.raises(TypeError, match="sample: must be that of a model with a density of readings"):
        gs.LikelihoodFieldModel(ROOM, SCANNER, backend="numpy").sample([POSE])


def test_masses_and_quantiles_are_right_to_a_few_units():
    x = np.concatenate([np.logspace(-12, 0.9, 400), [0.0, 3.9999, 4.0, 8.9999, 9.0, 1e300]])
    np.testing.assert_allclose(half_mass(x), 0.5 * stats.chi2(1).cdf(np.minimum(x, 1e9) ** 2), rtol=2e-14, atol=1e-300)
    mass = np.concatenate([np.logspace(-15, -0.302, 300), 0.5 - np.logspace(-15, -1, 200), [0.425]])
    outer, central = mass[mass > 1e-3], mass[mass < 0.4]
    np.testing.assert_allclose(half_quantile(outer), -ndtri(0.5 - outer), rtol=1e-12)
    np.testing.assert_allclose(half_mass(half_quantile(central)), central, rtol=4e-15)


def test_deviates_within_an_interval_keep_their_digits():
    u = (np.arange(2001) + 0.5) / 2001
    wide = normal_within(u, np.full(2001, 3e-7), np.full(2001, 5e-7))
    np.testing.assert_allclose(wide, -3e-7 + u * 8e-7, rtol=1e-12, atol=1e-19)
    edge = normal_within(u, np.zeros(2001), np.full(2001, 1e9))
    np.testing.assert_allclose(edge, stats.halfnorm.ppf(u), rtol=1e-12)
