"""Readings far from all particles: particles reach them without collapsing to one, or the estimate reports it."""

from __future__ import annotations

import numpy as np

import gpusense as gs
from gpusense.interface import constants as c
from gpusense.localization.cloud_state import is_starved, summary_of


def follow(backend, prior, sigma, far, corrections, **options):
    """Return estimates of a robot at x = far, y = 0 by a filter with a normal start around the origin."""
    model = gs.PositionModel(gs.PositionParameters(sigma=sigma), backend=backend)
    pf = gs.ParticleFilter(model, particles=2000, seed=1, **options)
    pf.initialize(mean=(0, 0, 0), covariance=np.diag([prior**2, prior**2, 1.0]))
    found, distinct = [], []
    for _ in range(corrections):
        pf.correct(np.array([far, 0.0]))
        found.append(pf.estimate())
        distinct.append(len(np.unique(pf.host_particles(), axis=0)))
    return distinct, found


def test_a_plain_filter_says_that_one_particle_has_all_the_weight():
    _, found = follow("numpy", 10.0, 0.1, 40.0, 1, stages=1)
    assert found[0].effective_sample_size < 3


def test_copies_of_few_parents_are_not_counted_as_particles():
    state = np.zeros(c.STATE)
    for stage, (size, left) in enumerate(((2.0, 0.5), (900.0, 0.0))):
        own = state[stage * c.STAGE : (stage + 1) * c.STAGE]
        own[c.SAMPLE_SIZE], own[c.LEFT], own[c.RUNG] = size, left, 0.5
    summary = summary_of(state)
    assert summary.effective_sample_size == 8 and summary.temperature == 1.0


def test_a_stage_is_starved_on_its_last_rung_only():
    settings, state = np.zeros(c.SETTINGS), np.zeros(c.STATE)
    settings[c.SHARE], settings[c.DEPTH] = 0.1, 1.0
    state[c.RUNG], state[c.SAMPLE_SIZE] = c.LOWEST, 9.0
    assert is_starved(state, settings, 0, 1000) and not is_starved(state, settings, 0, 80)
    state[c.SAMPLE_SIZE] = 11.0
    assert not is_starved(state, settings, 0, 1000)
    state[c.SAMPLE_SIZE] = 9.0
    state[c.RUNG] = 2 * c.LOWEST
    assert not is_starved(state, settings, 0, 1000)
    state[c.RUNG], state[c.DEGENERATE] = c.LOWEST, 1.0
    assert not is_starved(state, settings, 0, 1000)
