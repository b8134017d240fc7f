"""A filter over several devices has the bits of one on a single device."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from support.split_scene import field, field_and_compass, states

import gpusense as gs
from gpusense.interface import constants as c
from gpusense.localization.distributed.parts import parts_of
from gpusense.reference.drawing import draw_particles
from gpusense.reference.motion import move_particles
from gpusense.sweep import ProcessExecutor, SplitParticleFilter

OPTIONS = [
    {},
    dict(stages=1),
    dict(stages=1, resampling="stratified", threshold=1.0),
    dict(particles=(200, 600), stages=2),
    dict(particles=(300, 9000), stages=2),
    dict(recovery="augmented", particles=401),
    dict(resampling="residual"),
    dict(particles=(200, 600), stages=1, resampling="residual", threshold=1.0),
]


FEW = dict(particles=(20, 200), seed=1, threshold=0.4)


class TwoPlaces:
    """A likelihood of poses at two places that are far apart."""

    log_p = np.zeros(200)
    positions = np.repeat([(0.0, 0.0, 0.0), (50.0, 0.0, 0.0)], (120, 80), axis=0)


def gps(device):
    return gs.PositionModel(gs.PositionParameters(sigma=0.3, z_rand=0.0), backend=device)


def equal(one, two):
    return all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("options", OPTIONS)
def test_particles_weights_and_estimates_have_the_bits_of_one_device(backend, options):
    options = {"particles": 400, "seed": 5, **options}
    expected = states(gs.ParticleFilter(field(backend), **options))
    for count in (1, 2, 3):
        pf = SplitParticleFilter(field, devices=[backend] * count, **options)
        assert equal(states(pf), expected)
        assert (pf.exchanged > 0) == (count > 1) and "split: " in repr(pf)


def test_several_sensors_and_a_start_anywhere(needs):
    device = needs("opencl")
    options = dict(particles=3000, seed=2, recovery="sensor")
    one = gs.ParticleFilter(field_and_compass(device), **options)
    expected = states(one, everywhere=True)
    pf = SplitParticleFilter(field_and_compass, devices=[device] * 2, **options)
    assert equal(states(pf, everywhere=True), expected)
    assert np.array_equal(pf.particles, pf.host_particles()) and abs(pf.weights.sum() - 1) < 1e-12
    # A filter that begins again forgets its state.
    assert equal(states(pf), states(one))


def test_moments_follow_a_prediction():
    pf = SplitParticleFilter(field, devices=["numpy"] * 2, particles=100, seed=1)
    with pytest.raises(RuntimeError, match="must be initialised first"):
        pf.moments  # noqa: B018
    pf.initialize(mean=(1, 1, 0), covariance=np.eye(3) * 1e-6)
    pf.predict((0, 0, 0), (0.5, 0, 0))
    assert abs(pf.moments[0] - 1.5) < 0.05


def test_a_fix_at_particles_without_weight_has_the_bits_of_one_device(backend):
    """The weights stay, and draws that change the number of particles use them."""
    found = []
    for make in (gs.ParticleFilter(gps(backend), **FEW), SplitParticleFilter(gps, devices=[backend] * 3, **FEW)):
        make.initialize_from(TwoPlaces())
        for x in (0.0, 50.0, 0.0):
            make.correct(np.array([x, 0.0]))
            found.append((make.host_particles(), make.host_weights(), make.estimate().pose))
    assert len(found[0][0]) != len(found[2][0])
    assert all(equal(one, two) for one, two in zip(found[:3], found[3:], strict=True))


@pytest.mark.parametrize("split", [False, True], ids=["one", "split"])
def test_the_motion_shows_where_the_second_of_two_readings_is_refused(backend, split):
    def make(device):
        return [gps(device), gs.HeadingModel(gs.HeadingParameters(sigma=0.1), backend=device)]

    options = dict(particles=100, seed=1)
    pf = SplitParticleFilter(make, devices=[backend] * 2, **options) if split else (
        gs.ParticleFilter(make(backend), **options)
    )  # fmt: skip
    position, heading = pf.models
    pf.initialize(mean=(0, 0, 0), covariance=np.eye(3) * 1e-6)
    pf.correct({position: np.zeros(2)})
    pf.predict((0, 0, 0), (1.0, 0, 0))
    with pytest.raises(TypeError, match="heading: must hold real numbers"):
        pf.correct({position: np.array([1.0, 0.0]), heading: "north"})
    assert abs(pf.estimate().pose[0] - 1.0) < 0.1 and abs(pf.host_particles()[:, 0].mean() - 1.0) < 0.1


def test_few_particles_leave_a_device_idle():
    expected = states(gs.ParticleFilter(field("numpy"), particles=20, seed=1))
    pf = SplitParticleFilter(field, devices=["numpy"] * 4, particles=20, seed=1)
    assert equal(states(pf), expected) and pf.explain() == "split: 0 on numpy, 16 on numpy, 0 on numpy, 4 on numpy"


# At a low temperature some steps do not resample.
@pytest.mark.parametrize(
    "options",
    [dict(stages=1), dict(stages=3), dict(stages=3, temperature=0.05), dict(stages=2, resampling="residual")],
    ids=["1", "3", "without draws", "residual"],
)
def test_gpus_have_the_particles_of_one(warp_as_gpu, options):
    expected = states(gs.ParticleFilter(field("warp:cpu"), particles=400, seed=5, **options))
    pf = SplitParticleFilter(field, devices=["warp:cpu"] * 2, particles=400, seed=5, **options)
    found = states(pf)
    # Particles went from device to device, and none through the host.
    assert pf._cloud._team.direct and pf.exchanged % (400 * 32) == 0 < pf.exchanged
    assert equal(found, expected)


def test_gpus_weigh_by_several_sensors(warp_as_gpu):
    """Readings that cannot be recorded are scored by calls."""
    expected = states(gs.ParticleFilter(field_and_compass("warp:cpu"), particles=300, seed=5), 2)
    pf = SplitParticleFilter(field_and_compass, devices=["warp:cpu"] * 2, particles=300, seed=5)
    assert equal(states(pf, 2), expected)


def test_shares_are_whole_blocks():
    for count in (1, 16, 17, 1000, 12345):
        for shards in (1, 2, 3, 8):
            parts = parts_of(count, shards)
            assert sum(part.size for part in parts) == count and parts[0].first == 0
            assert all(one.first + one.size == two.first for one, two in itertools.pairwise(parts))
            assert all(part.first % part.block == 0 or not part.size for part in parts)


def test_kernels_count_particles_from_the_first(device):
    """Each half of the particles moves and is drawn as in the whole, on every backend."""
    from gpusense.interface.launches import launch

    settings = np.zeros(c.SETTINGS)
    settings[c.SEED], settings[c.STEP], settings[c.SCALE], settings[c.JITTER] = 5, 3, 2.0**30, 0.2
    settings[c.FARTHEST_X : c.FARTHEST_THETA + 1] = 1.0
    settings[c.DEVIATION : c.DEVIATION + 4], settings[c.REVERSE], settings[c.STRATIFIED] = 0.1, 0.3, 1.0
    rng, plain = np.random.default_rng(0), frozenset[str]()
    source, ends = rng.normal(size=600), np.cumsum(np.floor(rng.exponential(size=200) * 2.0**30))
    state = np.zeros(c.STATE)
    state[c.TOTAL], state[c.RESAMPLED], state[c.LEFT] = ends[-1], 1.0, 0.5
    moved, drawn, after = np.zeros(600), np.zeros(600), np.zeros(200)
    move_particles(plain, source, settings, moved, 200, c.STRAIGHT)
    draw_particles(plain, source, ends, ends, ends, settings, state, np.zeros(3), drawn, after, 200, 200, 0)
    for first in (0, 100):
        settings[c.FIRST], settings[c.WHOLE], settings[c.DRAWN] = first, 200, 200
        up, target = device.upload, device.empty(300, np.dtype(float))
        half = source[3 * first : 3 * first + 300].copy()
        device.run((launch("move_particles", plain, (100,), source=up(half), settings=up(settings), target=target,
                           particles=100, kind=c.STRAIGHT),))  # fmt: skip
        assert np.array_equal(device.download(target, np.empty(300)), moved[3 * first : 3 * first + 300])
        device.run((launch("draw_particles", plain, (100,), source=up(source), weight=up(ends), ends=up(ends),
                           copies=up(ends), settings=up(settings), state=up(state), pool=up(np.zeros(3)), target=target,
                           after=up(np.zeros(100)), particles=200, drawn=100, stage=0),))  # fmt: skip
        assert np.array_equal(device.download(target, np.empty(300)), drawn[3 * first : 3 * first + 300])


def test_other_processes_have_the_same_particles():
    expected = states(gs.ParticleFilter(field("numpy"), particles=300, seed=3), 3)
    executors = [ProcessExecutor(["numpy"]) for _ in range(2)]
    try:
        pf = SplitParticleFilter(field, devices=["numpy", "numpy"], executors=executors, particles=300, seed=3)
        assert equal(states(pf, 3), expected)
        pf.close()
    finally:
        for one in executors:
            one.shutdown()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(devices="numpy"), "devices: must be a list of selection strings"),
        (dict(devices=[]), "devices: must be a list of selection strings"),
        (dict(devices=["numpy"], make=3), "make: must be a function"),
        (dict(devices=["numpy"], executors=[]), "executors: must be one for each of 1 devices, got 0"),
        (dict(devices=["numpy"], stages=9), "stages: must be"),
    ],
)
def test_bad_input(options, message):
    with pytest.raises((TypeError, ValueError), match=message):
        SplitParticleFilter(options.pop("make", field), **options)


def far_fix(device):
    return gs.PositionModel(gs.PositionParameters(sigma=0.1), backend=device)


def test_a_split_filter_reaches_a_fix_that_is_far_from_all_particles():
    whole = gs.ParticleFilter(far_fix("numpy"), particles=400, seed=1)
    split = SplitParticleFilter(far_fix, devices=["numpy"] * 2, particles=400, seed=1)
    for pf in (whole, split):
        pf.initialize(mean=(0, 0, 0), covariance=np.diag([100.0, 100.0, 1.0]))
        for _ in range(3):
            pf.correct(np.array([40.0, 0.0]))
    assert np.array_equal(split.host_particles(), whole.host_particles())
    assert np.hypot(*(split.estimate().pose[:2] - (40.0, 0.0))) < 0.5
