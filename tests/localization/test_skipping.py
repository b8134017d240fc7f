"""Skipped beams: beams on people, never a whole scan, none while the particles are spread out."""

from __future__ import annotations

import numpy as np
import pytest
from support.tracking_scene import FINE, GRID, scan_at
from support.tracking_scene import TRUTH as POSE

import gpusense as gs
from gpusense.localization.filter_core import without_skipped
from gpusense.localization.sensors import Sensor

WALLS = scan_at(POSE, FINE)
BLOCKED = np.arange(20, 32)
RNG = np.random.default_rng(0)
NEAR = POSE + RNG.normal(0, (0.03, 0.03, 0.01), (50, 3))
ANYWHERE = np.column_stack([RNG.uniform((0.5, 0.5), (8, 6), (64, 2)), RNG.uniform(-np.pi, np.pi, 64)])


def sensor(beams=None):
    parameters = gs.LikelihoodFieldParameters(sigma_hit=0.1)
    return Sensor(gs.LikelihoodFieldModel(GRID, FINE, parameters, beams=beams, backend="numpy"))


def skipped(ranges, beams=None):
    return without_skipped(sensor(beams), (ranges,), NEAR, np.full(50, 0.02), ANYWHERE, 0.3)[0]


@pytest.mark.parametrize("beams", [None, 30])
def test_beams_of_a_person_are_left_out(beams):
    ranges = WALLS.copy()
    ranges[BLOCKED], ranges[5] = 0.5, np.nan
    found = skipped(ranges, beams)
    missing = np.isnan(found)
    assert missing[BLOCKED].all() and missing[5]
    assert np.array_equal(found[~missing], ranges[~missing]) and ranges[20] == 0.5
    # Thinned scans get no other beams.
    assert np.count_nonzero(~missing) == pytest.approx((beams or 60) * (60 - 13) / 60, abs=3)


def test_a_scan_that_no_particle_explains_is_used_whole():
    ranges = np.full(60, 0.5)
    assert skipped(ranges) is ranges
    assert skipped(np.full(60, np.nan)) is not None


def test_particles_that_lie_apart_skip_nothing():
    field = gs.LikelihoodFieldModel(GRID, FINE, backend="numpy")
    ranges, found = WALLS.copy(), []
    ranges[BLOCKED] = 0.5
    for share in (0.3, None):
        pf = gs.ParticleFilter(field, particles=300, seed=3, beam_skip=share)
        pf.initialize_uniform()
        pf.correct(ranges)
        found.append(pf.host_particles())
    assert np.array_equal(*found)


def test_a_filter_skips(backend):
    field = gs.LikelihoodFieldModel(GRID, FINE, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend=backend)
    compass = gs.HeadingModel(gs.HeadingParameters(sigma=0.1), backend=backend)
    ranges = WALLS.copy()
    ranges[BLOCKED] = 0.5
    poses = []
    for readings in (ranges, np.where(np.isin(np.arange(60), BLOCKED), np.nan, ranges)):
        pf = gs.ParticleFilter([field, compass], particles=200, seed=3, beam_skip=0.3)
        pf.initialize(mean=POSE, covariance=np.diag([1e-3, 1e-3, 1e-4]))
        pf.correct({field: readings, compass: float(POSE[2])})
        found = pf.estimate()
        poses.append(pf.host_particles())
    assert np.array_equal(*poses)
    assert found.explained == 1 and np.hypot(*(found.pose - POSE)[:2]) < 0.05
    with pytest.raises(ValueError, match="beam_skip: must be"):
        gs.ParticleFilter(field, beam_skip=1.0)
