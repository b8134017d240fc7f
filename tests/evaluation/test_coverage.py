"""Coverage, widths, NEES and ranks of estimates with errors of a known density; integrity: classes and alerts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2, norm

import gpusense as gs
from gpusense.evaluation import tracking


def drawn(factor, count=4000):
    """Return errors of a known covariance, that covariance times ``factor``, and ranks among 200 particles."""
    rng = np.random.default_rng(0)
    root = np.array([[0.1, 0, 0], [0.04, 0.05, 0], [0.01, 0, 0.02]])
    errors, clouds = rng.normal(size=(count, 3)) @ root.T, rng.normal(size=(200, 3)) @ root.T * np.sqrt(factor)
    ranks = np.array([tracking.rank_of(clouds, np.full(200, 1 / 200), -error) for error in errors])
    return errors, np.tile(factor * root @ root.T, (count, 1, 1)), ranks, root


@pytest.mark.parametrize("factor", [1.0, 0.25, 4.0])
def test_coverage_follows_the_covariance(factor):
    errors, covariances, ranks, root = drawn(factor)
    found = tracking.coverage_report(errors, covariances, ranks)
    for name, limit in tracking.REGIONS.items():
        # Four deviations of a share of 4000.
        assert found[f"coverage_{name}"] == pytest.approx(chi2.cdf(factor * limit, 3), abs=0.032)
        assert chi2.cdf(limit, 3) == pytest.approx(int(name) / 100, abs=1e-4)
    assert found["nees_median"] == pytest.approx(chi2.median(3) / factor, rel=0.06)
    largest = np.linalg.eigvalsh((root @ root.T)[:2, :2])[-1]
    assert found["width_95"] == pytest.approx(2 * norm.ppf(0.975) * np.sqrt(factor * largest), rel=1e-3)
    outer = found["rank_histogram"][0] + found["rank_histogram"][-1]
    # Directions of a rotated frame mix the deviations; the cloud of 200 has its own error.
    wanted = 2 * norm.cdf(norm.ppf(0.1) * np.sqrt(factor))
    assert outer == pytest.approx(wanted, abs=0.06) and sum(found["rank_histogram"]) == pytest.approx(1, abs=1e-3)


def test_ranks_are_in_the_frame_of_the_true_pose():
    particles = np.array([[0.0, 0, 0], [1, 1, 0.2], [0, 2, 3.1]])
    # Facing +y at (0.5, 1.5): ahead is +y, left is -x.
    found = tracking.rank_of(particles, np.array([0.5, 0.3, 0.2]), np.array([0.5, 1.5, np.pi / 2]))
    np.testing.assert_allclose(found, [0.8, 0.3, 0.8])
    np.testing.assert_allclose(tracking.rank_of(particles[:1], np.ones(1), particles[0]), [0.5] * 3)


def test_ranks_of_poses_beyond_all_particles_are_in_the_histogram():
    rng = np.random.default_rng(0)
    ranks = []
    for count in rng.integers(1, 9000, 20):
        weights, ahead = rng.random(count), rng.uniform(0.1, 0.2, (count, 3))
        weights /= weights.sum()
        ranks += [tracking.rank_of(side * ahead, weights, np.zeros(3)) for side in (1, -1)]
    ranks = np.array(ranks)
    # Sums of weights are rounded, and a histogram ignores values beyond its ends.
    assert ranks.min() >= 0 and ranks.max() <= 1
    found = tracking.coverage_report(np.zeros(ranks.shape), np.tile(np.eye(3), (len(ranks), 1, 1)), ranks)
    assert found["rank_histogram"] == [0.5, *[0.0] * 8, 0.5]


def test_each_pose_has_one_class():
    rng = np.random.default_rng(0)
    errors, radii = rng.uniform(0, 2, 4000), rng.uniform(0, 2, 4000)
    found = gs.integrity(errors, radii, alert_limit=1.0)
    fine = np.mean((errors <= radii) & (radii <= 1.0))
    assert found.hazardous == pytest.approx(0.25, abs=0.03) and found.misleading == pytest.approx(0.125, abs=0.03)
    assert fine + found.hazardous + found.misleading == pytest.approx(found.available)
    assert found.exceeded == pytest.approx(0.5, abs=0.03)


def test_limits_belong_to_the_safe_side():
    found = gs.integrity([1.0, 0.5, 1.0], [1.0, 0.5, 0.9], alert_limit=1.0)
    assert (found.hazardous, found.available) == (0.0, 1.0) and found.misleading == pytest.approx(1 / 3)


def test_times_to_alert():
    none = math.inf
    errors = [0, 3, 3, 3, 0, 3, 3, 0, 3]
    radii = [0.1, 0.1, 0.1, none, none, 0.1, 0.1, 0.1, 4]
    found = gs.integrity(errors, radii, alert_limit=1.0, times=np.arange(9) * 0.5)
    assert found.times_to_alert.tolist() == [1.0, math.inf, 0.0]
    assert gs.integrity([0.1], [0.2], alert_limit=1.0).times_to_alert.shape == (0,)
