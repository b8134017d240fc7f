"""The interface between a filter and its particles, on every backend."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.tracking_scene import field, scans

from gpusense.interface.constants import FAST, SLOW, SLOW_RATE, STRAIGHT
from gpusense.localization.cloud_state import Contents, Step
from gpusense.localization.motion import STILL, OdometryMotion
from gpusense.localization.options import checked, settings_of_step
from gpusense.localization.scoring import FilterCloud
from gpusense.localization.sensors import Sensor

COUNT = 100
POSES = np.random.default_rng(0).normal((3.0, 2.5, 0.4), (0.2, 0.2, 0.1), (COUNT, 3))


def made(backend: str, capacity: int = COUNT) -> FilterCloud:
    """Return a cloud at the poses."""
    cloud = FilterCloud([Sensor(field(backend))], capacity)
    cloud.place(POSES)
    return cloud


def host(values: Any) -> np.ndarray:
    """Return an array of any device in host memory."""
    method = getattr(values, "get", None) or getattr(values, "numpy", None)
    return np.asarray(values if method is None else method())


def settings(motion: Any = STILL, recovery: str | None = None, pool: Any = (0, (0.0, 0.0, 0.0))) -> np.ndarray:
    options = checked(particles=COUNT, seed=3, temperature=0.3, resampling="systematic", threshold=0.5, stages=2,
                      recovery=recovery, beam_skip=None)  # fmt: skip
    return settings_of_step(options, motion, 1, COUNT, pool, [(0.3, 30)], True)


def step(drawn: int = COUNT, recovery: str | None = None, pool: Any = (0, (0.0, 0.0, 0.0))) -> Step:
    return Step(settings(OdometryMotion().sampled((0, 0, 0), (0.2, 0, 0.1)), recovery, pool), STRAIGHT, 2, drawn,
                [(0, (scans(4)[1][0],))])  # fmt: skip


@pytest.fixture
def cloud(backend) -> FilterCloud:
    return made(backend)


@pytest.fixture
def other(backend) -> FilterCloud:
    """Return a cloud with more room, for the same bits."""
    return made(backend, 3 * COUNT)


def test_places_are_shown_and_weighed_alike(cloud):
    assert cloud.count == COUNT and cloud.places.shown == cloud.places.next
    assert np.array_equal(cloud.host_poses(cloud.places.shown, COUNT), POSES)
    assert np.array_equal(host(cloud.particles(COUNT)), POSES)
    assert np.array_equal(cloud.host_weights(COUNT), np.ones(COUNT))
    assert np.array_equal(host(cloud.shares(COUNT)), np.full(COUNT, 1 / COUNT))


def test_a_move_shows_moved_particles(cloud, other):
    motion = OdometryMotion(alpha=(0,) * 4, least=(0, 0), reverse=0, sideways=0).sampled((0, 0, 0), (0.3, 0, 0.1))
    for each in (cloud, other):
        each.move(settings(motion), motion.kind)
    found = host(cloud.particles(COUNT))
    assert np.array_equal(found, host(other.particles(COUNT)))
    np.testing.assert_allclose(found[:, 2], POSES[:, 2] + 0.1, atol=1e-12)
    np.testing.assert_allclose(found[:, 0], POSES[:, 0] + 0.3 * np.cos(POSES[:, 2]), atol=1e-12)


@pytest.mark.parametrize("drawn", [COUNT, 60])
def test_a_correction_has_the_bits_of_a_cloud_with_more_room(cloud, other, drawn):
    for each in (cloud, other):
        each.correct(step(drawn))
    assert cloud.count == other.count == drawn and cloud.places == other.places
    assert cloud.places.shown != cloud.places.next
    for index, count in ((cloud.places.shown, COUNT), (cloud.places.next, drawn)):
        assert np.array_equal(cloud.host_poses(index, count), other.host_poses(index, count))
    assert np.array_equal(cloud.host_weights(COUNT), other.host_weights(COUNT))
    np.testing.assert_allclose(host(cloud.shares(COUNT)), host(other.shares(COUNT)), rtol=1e-14, atol=0)
    assert abs(host(cloud.shares(COUNT)).sum() - 1) < 1e-12
    assert np.array_equal(cloud.estimate(COUNT), other.estimate(COUNT))
    # On a GPU the moments take a second pass.
    np.testing.assert_allclose(host(cloud.moments(COUNT)), cloud.estimate(COUNT)[:9], rtol=1e-9, atol=1e-15)
    one, two = cloud.summary(), other.summary()
    assert one[:4] == two[:4] and 1 <= one.effective_sample_size <= COUNT and not one.degenerate
    # Weights follow the scores: the likeliest particle is the heaviest.
    log_p = field("numpy").log_likelihood(cloud.host_poses(cloud.places.shown, COUNT), scans(4)[1][0])
    assert np.argmax(cloud.host_weights(COUNT)) == np.argmax(log_p) or one.stages > 1


def test_a_pool_is_injected(cloud, other):
    far = np.tile((7.0, 5.0, 0.0), (5, 1))
    for each in (cloud, other):
        each.set_pool(far)
        # A second stage would draw none of them.
        numbers = step(recovery="augmented", pool=(5, (0.1, 0.1, 0.1)))._replace(stages=1)
        contents = each.contents(COUNT)
        # Averages of a likelihood that has fallen.
        state = contents.state.copy()
        state[SLOW], state[FAST] = 1e6, 1.0
        each.restore(contents._replace(state=state, pool=far))
        each.correct(numbers)
        assert numbers.settings[SLOW_RATE] > 0
    drawn = cloud.host_poses(cloud.places.next, COUNT)
    assert np.array_equal(drawn, other.host_poses(other.places.next, COUNT))
    assert 5 < np.count_nonzero(drawn[:, 0] > 6.8) < 40


def test_contents_go_from_one_cloud_to_another(cloud, other):
    cloud.correct(step())
    contents = cloud.contents(COUNT)
    assert isinstance(contents, Contents) and contents.next_count == COUNT
    other.restore(contents)
    for each, found in zip(contents, other.contents(COUNT), strict=True):
        assert (each is found is None) or np.array_equal(each, found)
    for each in (cloud, other):
        each.correct(step())
    assert np.array_equal(host(cloud.particles(COUNT)), host(other.particles(COUNT)))


def test_explanations(cloud):
    assert cloud.explain() == "launches one by one"


def test_steps_leave_what_they_begin_with(cloud):
    before = cloud.contents(COUNT)
    places, count = cloud.places, cloud.count
    cloud.kept = places
    cloud.correct(step(60))
    cloud.move(settings(), STRAIGHT)
    cloud.place(POSES[:10])
    cloud.places, cloud.count = places, count
    for each, found in zip(before, cloud.contents(COUNT), strict=True):
        assert (each is found is None) or np.array_equal(each, found)
