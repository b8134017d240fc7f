"""States, copies and pickles of filters continue with the bits of the original."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from support.filter_scene import COVARIANCE, FILTERS, START, begun, everything, odometry, readings
from support.tracking_scene import field

import gpusense as gs


def continued(pf, first=3, steps=4):
    """Continue a filter, and return all outputs and its state."""
    shown = []
    for step in range(first, first + steps):
        pf.predict(*odometry(step))
        pf.correct(readings(pf, step))
        shown.append((repr(pf.estimate()), repr(pf.estimate("cluster").pose), pf.temperatures, everything(pf)))
    return shown


def restored(pf, make):
    """Return a new filter that restores the state of a filter ``pf`` from a pickle."""
    state = pickle.loads(pickle.dumps(pf.state()))
    made = make()
    made.restore(state)
    return made


COPIES = {
    "restore": restored, "copy": lambda pf, _: copy.copy(pf), "deepcopy": lambda pf, _: copy.deepcopy(pf),
    "pickle": lambda pf, _: pickle.loads(pickle.dumps(pf)),
}  # fmt: skip


@pytest.mark.sampled(0.2)
@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("name", FILTERS)
def test_a_copy_continues_with_the_same_bits(name, how, backend):
    pf = begun(FILTERS[name](backend), everywhere=name == "sensors, resetting")
    # A pending motion is part of the state.
    pf.predict(*odometry(2))
    made = COPIES[how](pf, lambda: FILTERS[name](backend))
    assert everything(made) == everything(pf) and repr(made) == repr(pf)
    assert (made.models == pf.models) == (how == "copy")
    before = everything(pf)
    expected = continued(made)
    # The original is unchanged, and continues in the same way.
    assert everything(pf) == before
    assert continued(pf) == expected


@pytest.mark.parametrize("steps", [0, 1])
def test_a_state_before_the_first_correction(steps, backend):
    pf = gs.ParticleFilter(field(backend), particles=(40, 100), seed=7)
    empty = copy.copy(pf)
    with pytest.raises(RuntimeError, match="initialised"):
        empty.estimate()
    pf.initialize(mean=START, covariance=COVARIANCE, particles=60)
    for step in range(steps):
        pf.predict(*odometry(step))
        pf.flush()
    assert continued(copy.copy(pf)) == continued(pf)


def test_a_long_run_is_repeated_from_the_middle(needs):
    """Learned temperature and verdict memory matter: after 12 scans they have changed."""
    pf = begun(gs.ParticleFilter(field(needs("opencl")), particles=300, seed=8), 8)
    assert pf.temperatures[0] != gs.ParticleFilter(field("opencl"), particles=300).temperatures[0]
    other = restored(pf, lambda: gs.ParticleFilter(field("numpy"), **pf.state().options))
    # On another device temperatures and weights agree up to rounding of log-likelihoods.
    assert everything(other) == everything(pf)
    assert continued(restored(pf, lambda: gs.ParticleFilter(field("opencl"), **pf.state().options)), 8) == continued(
        pf, 8
    )


def test_a_state_has_no_device_and_tells_its_options():
    pf = begun(gs.ParticleFilter(field("numpy"), particles=(50, 100), seed=3, temperature=0.5))
    state = pf.state()
    assert (
        repr(state) == f"FilterState({len(state.particles)} particles, step={state.step}, models=LikelihoodFieldModel)"
    )
    assert np.array_equal(state.particles, pf.host_particles()) and np.array_equal(state.weights, pf.host_weights())
    assert state.options["particles"] == (50, 100) and state.options["temperature"] == 0.5
    assert len(pickle.dumps(state)) < 40_000
    # A copy, independent of the filter's particles.
    state.particles[:] = 7
    assert not np.any(pf.host_particles() == 7)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(seed=4), "state: seed must be 4 as in the filter, got 3"),
        (dict(particles=51), "state: particles must be 51 as in the filter, got 50"),
    ],
)
def test_states_of_other_filters_are_refused(options, message):
    state = begun(gs.ParticleFilter(field("numpy"), particles=50, seed=3)).state()
    pf = begun(gs.ParticleFilter(field("numpy"), **dict(particles=50, seed=3) | options))
    before = everything(pf)
    with pytest.raises(ValueError, match=message):
        pf.restore(state)
    heading = gs.HeadingModel(backend="numpy")
    with pytest.raises(ValueError, match="must be of a filter of HeadingModel, got one of LikelihoodFieldModel"):
        gs.ParticleFilter(heading, particles=50, seed=3).restore(state)
    with pytest.raises(TypeError, match="state: must be a FilterState"):
        pf.restore({"particles": 3})
    assert everything(pf) == before
