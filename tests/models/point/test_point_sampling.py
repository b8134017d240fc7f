"""Readings that point and landmark models draw: distributions by SciPy, equal bits, limits and bad input."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import gpusense as gs

# Every statistical test may fail by chance with this probability; seeds are fixed.
FALSE_ALARM = 1e-5
GRID = gs.OccupancyGrid(np.pad(np.zeros((40, 60), int), 1, constant_values=100), resolution=0.1)
POSE = (2.0, 1.5, 0.4)
MANY = np.tile(POSE, (20_000, 1))
MAP = gs.LandmarkMap([(1.0, 1.0), (4.0, 2.0), (2.0, 4.0)], signatures=[1.0, 2.0, 3.0])


def models(backend="numpy", precision="float32"):
    options = dict(backend=backend, precision=precision)
    return {
        "fix": gs.PositionModel(gs.PositionParameters(sigma=0.5, mount=(0.3, 0.1)), **options),
        "heading": gs.HeadingModel(gs.HeadingParameters(sigma=0.3), **options),
        "von Mises": gs.HeadingModel(gs.HeadingParameters(kind="von_mises", kappa=3.0), **options),
        "beacons": gs.BeaconModel([(0.0, 0.0), (8.0, 0.0)], gs.BeaconParameters(range_max=9.0), **options),
        "bumper": gs.BumperModel(GRID, [(-0.3, -0.2), (0.3, -0.2), (0.3, 0.2), (-0.3, 0.2)],
                                 segments=[0, 1, 0, -1], **options),
        "landmarks": gs.LandmarkModel(MAP, gs.LandmarkParameters(sigma_signature=0.3), **options),
        "lines": gs.LineModel(gs.LineMap([(0, 5, 6, 5), (7, 0, 7, 5)]), **options),
    }  # fmt: skip


SHAPES = {
    "fix": (2,),
    "heading": (),
    "von Mises": (),
    "beacons": (2,),
    "bumper": (2,),
    "landmarks": (3, 3),
    "lines": (2, 4),
}


@pytest.mark.parametrize("name", SHAPES)
def test_readings_are_the_same_on_every_backend_and_in_both_precisions(name, needs):
    poses = np.random.default_rng(3).uniform((0, 0, -9), (6, 4, 9), (200, 3))
    poses[0, 2] = 1e6
    expected = models()[name].sample(poses, seed=2**33 + 1, step=4)
    assert expected.shape == (200, *SHAPES[name])
    for backend in ("opencl", "warp"):
        for precision in ("float32", "float64"):
            found = models(needs(backend), precision)[name].sample(poses, seed=2**33 + 1, step=4)
            np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("name", SHAPES)
def test_a_reading_depends_on_seed_step_and_pose_alone(name):
    model, poses = models()[name], np.random.default_rng(3).uniform((0, 0, -9), (6, 4, 9), (60, 3))
    z = model.sample(poses, seed=1, step=3)
    np.testing.assert_array_equal(model.sample(poses[:7], seed=1, step=3), z[:7])
    several = model.sample(np.stack([poses, poses]), seed=1, step=2)
    assert several.shape == (2, 60, *SHAPES[name])
    np.testing.assert_array_equal(several[1], z)
    assert not np.array_equal(model.sample(poses, seed=2, step=3), z, equal_nan=z.dtype == float)
    assert model.sample(np.zeros((0, 3))).shape == (0, *SHAPES[name])
    for arguments, kind, message in (
        (dict(seed=-1), ValueError, "seed: must be >= 0"), (dict(seed=0.5), TypeError, "seed: must be an integer"),
        (dict(step=2**31), ValueError, "step: must be >= 0 and <="),
        (dict(poses=np.zeros((2, 2))), ValueError, "poses: shape must be"),
        (dict(poses=[(0, 0, np.inf)]), ValueError, "poses: every value must be finite"),
    ):  # fmt: skip
        with pytest.raises(kind, match=message):
            model.sample(**(dict(poses=poses) | arguments))


def test_a_fix_is_normal_around_the_antenna():
    matrix = ((0.5, 0.3), (0.3, 1.5))
    model = gs.PositionModel(gs.PositionParameters(mount=(0.5, -0.2)), backend="numpy")
    z = model.sample(MANY, seed=1, covariance=matrix)
    c, s = np.cos(POSE[2]), np.sin(POSE[2])
    antenna = (POSE[0] + c * 0.5 + s * 0.2, POSE[1] + s * 0.5 - c * 0.2)
    white = np.linalg.solve(np.linalg.cholesky(matrix), (z - antenna).T)
    for component in white:
        assert stats.kstest(component, "norm").pvalue > FALSE_ALARM
    assert abs(np.corrcoef(white)[0, 1]) < 5 / np.sqrt(len(z))
    with pytest.raises(ValueError, match="covariance: must be given where the parameters have none"):
        model.sample(MANY)


@pytest.mark.parametrize("kappa", [0.0, 1e-9, 0.5, 30.0, 1e5, 1e16])
def test_headings_are_von_mises(kappa):
    z = gs.HeadingModel(gs.HeadingParameters(kind="von_mises", kappa=kappa), backend="numpy").sample(
        MANY - (0, 0, POSE[2]), seed=1
    )
    if kappa < 1e-6:
        assert stats.kstest(z / np.pi, "uniform", args=(-1, 2)).pvalue > FALSE_ALARM
    elif kappa > 1e3:
        assert stats.kstest(z * np.sqrt(kappa), "norm").pvalue > FALSE_ALARM
    else:
        assert stats.kstest(z, stats.vonmises(kappa).cdf).pvalue > FALSE_ALARM


@pytest.mark.parametrize("sigma", [1e-8, 0.3, 1e3, 1e9])
@pytest.mark.parametrize("kind", ["normal", "student_t", "mixture"])
def test_ranges_of_beacons_are_truncated(kind, sigma):
    p = gs.BeaconParameters(kind=kind, sigma_range=sigma, sigma_heavy=2 * sigma, nu=3, z_hit=1.0, z_rand=0.0,
                            range_max=4.0)  # fmt: skip
    z = gs.BeaconModel([(2.0, 2.0)], p, backend="numpy").sample(MANY, seed=1)[:, 0]
    assert (z >= 0).all() and (z <= 4.0).all()

    def cdf(x, scale):
        one = stats.t(3, 0.5, scale) if kind == "student_t" else stats.norm(0.5, scale)
        return (one.cdf(x) - one.cdf(0.0)) / (one.cdf(4.0) - one.cdf(0.0))

    if sigma >= 1e3:
        assert stats.kstest(z / 4.0, "uniform").pvalue > FALSE_ALARM
        return
    share = 0.1 if kind == "mixture" else 0.0
    assert stats.kstest(z, lambda x: (1 - share) * cdf(x, sigma) + share * cdf(x, 2 * sigma)).pvalue > FALSE_ALARM


def test_what_a_radio_cannot_report_is_missing():
    p = gs.BeaconParameters(sigma_range=0.5, z_hit=1.0, z_rand=0.0, range_max=4.0)
    at = np.tile((5.0, 0.0, 0.0), (20_000, 1))
    z = gs.BeaconModel([(0.0, 0.0)], p, backend="numpy").sample(at, seed=1)[:, 0]
    # Mass of the normal around 5 m below 4 m, over the same mass for a mean at 4 m.
    seen = (stats.norm(5, 0.5).cdf(4) - stats.norm(5, 0.5).cdf(0)) / (0.5 - stats.norm(4, 0.5).cdf(0))
    assert stats.binomtest(int(np.isfinite(z).sum()), len(z), seen).pvalue > FALSE_ALARM
    assert np.nanmax(z) <= 4.0


def test_a_bumper_is_pressed_as_often_as_the_model_says():
    poses = [(0.35, 2.0, 0.0), (0.45, 2.0, 0.0), (3.0, 2.0, 0.0)]
    model = gs.BumperModel(GRID, 0.3, gs.BumperParameters(sigma=0.1, p_false=0.02), temperature=0.5, backend="numpy")
    pressed = model.sample(np.repeat(poses, 10_000, axis=0), seed=3).reshape(3, -1)
    chance = np.exp(model.log_likelihood(poses, True) / 0.5)
    for count, p in zip(pressed.sum(axis=1), chance, strict=True):
        assert stats.binomtest(int(count), 10_000, min(float(p), 1.0)).pvalue > FALSE_ALARM


def test_landmarks_in_view_are_detected_and_others_are_not():
    p = gs.LandmarkParameters(sigma_range=0.1, sigma_bearing=0.02, p_detect=0.7, z_detect=1.0, z_false=0.0,
                              range_max=3.0, field_of_view=2.0)  # fmt: skip
    model = gs.LandmarkModel(gs.LandmarkMap([(2.0, 0.0), (5.0, 0.0), (-2.0, 0.0)]), p, backend="numpy")
    z = model.sample(np.zeros((20_000, 3)), seed=1)
    seen = np.isfinite(z).all(axis=2)
    assert z.shape == (20_000, 3, 2) and not seen[:, 1:].any()
    assert stats.binomtest(int(seen[:, 0].sum()), len(z), 0.7).pvalue > FALSE_ALARM
    found = z[seen[:, 0], 0]
    assert stats.kstest((found[:, 0] - 2.0) / 0.1, "norm").pvalue > FALSE_ALARM
    assert stats.kstest(found[:, 1] / 0.02, "norm").pvalue > FALSE_ALARM


@pytest.mark.sampled(0.4)
@pytest.mark.parametrize("field", [1.5, 4.0, 2 * np.pi])
@pytest.mark.parametrize("sigma", [1e-6, 0.4, 3.0, 1e9])
def test_bearings_have_the_density_of_the_model(field, sigma):
    p = gs.LandmarkParameters(sigma_range=None, sigma_bearing=sigma, z_detect=1.0, z_false=0.0, field_of_view=field)
    landmarks = gs.LandmarkMap([(-1.0, 0.7)])
    model = gs.LandmarkModel(landmarks, p, backend="numpy", precision="float64")
    for heading in (2.4, 0.0):  # In the field of view, or outside a narrow one.
        z = model.sample(np.tile((0.0, 0.0, heading), (20_000, 1)), seed=1, correspondence=[0])[:, 0, 1]
        fine = (np.arange(4000) + 0.5) / 4000 * field - field / 2
        density = np.exp([model.log_likelihood([(0, 0, heading)], [(np.nan, b)], [0])[0] for b in fine[::20]])
        mass = density.sum() * field / len(density)
        seen = np.isfinite(z)
        if sigma > 1e-3:
            assert stats.binomtest(int(seen.sum()), len(z), min(mass, 1.0)).pvalue > 1e-9 or abs(mass - 1) < 0.01
            counts = np.histogram(z[seen], 20, (-field / 2, field / 2))[0]
            share = density.reshape(20, -1).sum(axis=1) / density.sum()
            kept = share * seen.sum() > 20
            apart = np.abs(counts - share * seen.sum())[kept]
            assert (apart < 5.5 * np.sqrt(share * seen.sum())[kept] + 0.02 * counts[kept]).all()
        elif seen.any():
            truth = gs.wrap_angle(np.arctan2(0.7, -1.0) - heading)
            assert np.abs(z[seen] - truth).max() < 6 * sigma


def test_false_positives_fill_the_limits():
    p = gs.LandmarkParameters(sigma_signature=0.3, z_detect=0.0, z_false=1.0, range_max=6.0, field_of_view=3.0)
    z = gs.LandmarkModel(MAP, p, backend="numpy").sample(MANY, seed=1, correspondence=[0, -1])
    for feature in (z[:, 0], z[:, 1]):
        for part, low, length in zip(feature.T, (0.0, -1.5, 1 - 1.2), (6.0, 3.0, 2 + 2.4), strict=True):
            assert stats.kstest(part, "uniform", args=(low, length)).pvalue > FALSE_ALARM
    with pytest.raises(ValueError, match=r"correspondence: every index must be in \[-1, 3\), got 3"):
        gs.LandmarkModel(MAP, p, backend="numpy").sample([POSE], correspondence=[3])


def test_parts_without_a_deviation_are_not_measured():
    p = gs.LandmarkParameters(sigma_range=None, sigma_bearing=0.1, p_detect=1.0)
    z = gs.LandmarkModel(MAP, p, backend="numpy").sample([POSE], seed=1)
    assert z.shape == (1, 3, 2) and np.isnan(z[..., 0]).all() and np.isfinite(z[..., 1]).all()


def test_beacons_by_index_and_their_errors():
    model = models()["beacons"]
    assert model.sample([POSE], ids=[1, 1, 0]).shape == (1, 3) and model.sample([POSE], ids=[]).shape == (1, 0)
    with pytest.raises(ValueError, match=r"ids: every index must be in \[0, 2\), got 2"):
        model.sample([POSE], ids=[2])
