"""Kernels of particle filters: published vectors, exact distributions, and the same bits on every backend."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.interface import constants as c
from gpusense.interface.launches import launch
from gpusense.localization.cloud import Cloud
from gpusense.localization.cloud_state import Contents
from gpusense.localization.estimates import covariance_of
from gpusense.localization.motion import settings_of
from gpusense.localization.sensors import Sensor
from gpusense.localization.sums import Sums
from gpusense.reference.drawing import draw_particles
from gpusense.reference.elementary import angle_of, exp_of, log_of
from gpusense.reference.motion import move_particles
from gpusense.reference.philox import normal_pair, random_words, uniform_of

PLAIN = frozenset()

# Random123's known-answer tests (kat_vectors, philox4x32 10): counter, key, words.
VECTORS = [
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]


def words(text):
    return tuple(int(word, 16) for word in text.split())


@pytest.mark.parametrize(("counter", "key", "expected"), VECTORS)
def test_random_words_are_the_published_ones(counter, key, expected):
    found = random_words(tuple(np.array([word]) for word in words(counter)), *words(key))
    assert tuple(int(word[0]) for word in found) == words(expected)


def test_elementary_functions_are_right_to_a_few_units():
    x = np.concatenate([-np.logspace(-300, 2.8, 4001), [0.0]])
    np.testing.assert_allclose(exp_of(x), np.exp(x), rtol=4e-16)
    assert exp_of(np.array([-701.0, -np.inf])).tolist() == [0.0, 0.0]
    y = np.concatenate([np.logspace(-300, 300, 4001), 1 + np.linspace(-1e-3, 1e-3, 101)])
    np.testing.assert_allclose(log_of(y), np.log(y), rtol=6e-16, atol=1e-19)
    turn = np.linspace(-np.pi, np.pi, 4001)
    np.testing.assert_allclose(angle_of(np.cos(turn), np.sin(turn)), np.arctan2(np.sin(turn), np.cos(turn)), rtol=1e-15)
    assert angle_of(np.zeros(1), np.zeros(1))[0] == 0


def test_deviates_are_uniform_and_standard_normal():
    n, zero = np.arange(200_000), np.zeros(200_000)
    found = random_words((n, zero, zero, zero), 7, 9)
    assert stats.kstest(uniform_of(found[0]), "uniform").pvalue > 1e-3
    one, two = normal_pair(found[0], found[1])
    assert stats.kstest(one, "norm").pvalue > 1e-3 and stats.kstest(two, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(one, two)[0, 1]) < 0.01
    # Steps and streams are also independent.
    other = normal_pair(*random_words((n, zero + 1, zero, zero), 7, 9)[:2])[0]
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.01


def settings_of_step(**values):
    settings = np.zeros(c.SETTINGS)
    settings[c.SEED], settings[c.STEP], settings[c.SCALE] = 5, 3, 2.0**30
    settings[c.THRESHOLD], settings[c.SHARE], settings[c.DEPTH] = 0.5, 0.2, 1.0
    for name, value in values.items():
        place = getattr(c, name)
        settings[place : place + np.size(value)] = value
    return settings


def test_moves_have_the_moments_of_the_model():
    count = 200_000
    pose = np.tile([1.0, 2.0, 0.5], count)
    settings = settings_of_step(MEAN=[0.2, 1.0, 0.1, -0.3], DEVIATION=[0.0, 0.1, 0.05, 0.02])
    move_particles(PLAIN, pose, settings, pose, count, c.STRAIGHT)
    x, y, theta = pose.reshape(-1, 3).T
    along, across = (np.cos(0.7), np.sin(0.7)), (-np.sin(0.7), np.cos(0.7))
    ahead, left = (x - 1) * along[0] + (y - 2) * along[1], (x - 1) * across[0] + (y - 2) * across[1]
    for value, mean, deviation in ((ahead, 1.0, 0.1), (left, 0.1, 0.05), (theta, 0.4, 0.02)):
        assert stats.kstest((value - mean) / deviation, "norm").pvalue > 1e-3


def test_an_arc_ends_where_the_velocity_model_says():
    v, w, seconds = 1.5, 0.8, 0.7
    pose = np.array([0.0, 0.0, 0.3])
    settings = settings_of_step(MEAN=[w * seconds / 2, v * seconds, 0, 0])
    move_particles(PLAIN, pose, settings, pose, 1, c.VELOCITY_MODEL)
    end = 0.3 + w * seconds
    radius = v / w
    expected = [radius * (np.sin(end) - np.sin(0.3)), radius * (np.cos(0.3) - np.cos(end)), end]
    np.testing.assert_allclose(pose, expected, atol=1e-14)


def test_a_reverse_has_its_probability():
    count = 100_000
    pose = np.zeros(3 * count)
    move_particles(PLAIN, pose, settings_of_step(MEAN=[0, 1.0, 0, 0], REVERSE=0.1), pose, count, c.STRAIGHT)
    assert stats.binomtest(int((pose[::3] < 0).sum()), count, 0.1).pvalue > 1e-3


@pytest.mark.parametrize("stratified", [c.SYSTEMATIC, c.INDEPENDENT, c.RESIDUAL])
def test_draws_keep_the_expected_copies(stratified):
    count, repeats = 50, 400
    weight = np.floor(np.random.default_rng(0).exponential(size=count) * 2.0**30)
    weight[7] = 0
    ends, copies = np.cumsum(weight), np.zeros(count)
    source = np.zeros((count, 3))
    source[:, 0] = np.arange(count)
    state = np.zeros(c.STATE)
    state[c.TOTAL], state[c.RESAMPLED] = ends[-1], 1.0
    expected = count * weight / weight.sum()
    certain = np.cumsum(np.floor(expected))
    for step in range(repeats):
        target, after = np.zeros(3 * count), np.zeros(count)
        draw_particles(
            PLAIN, source.reshape(-1), weight, ends, certain, settings_of_step(STEP=step, STRATIFIED=stratified), state,
            np.zeros(3), target, after, count, count, 0,
        )  # fmt: skip
        found = np.bincount(target[::3].astype(int), minlength=count)
        copies += found
        if stratified == c.SYSTEMATIC:
            assert (np.abs(found - expected) < 1).all()
        elif stratified == c.RESIDUAL:
            assert (found >= np.floor(expected)).all()
    assert copies[7] == 0
    np.testing.assert_allclose(copies / repeats, expected, atol=5 * np.sqrt(expected.max() / repeats))


def run_step(selection, count, flags=PLAIN, *, lanes=True, draws=c.SYSTEMATIC, lone=False, depth=1.0):
    """Return all buffers after two motions, a correction of two stages and an estimate.

    ``lone`` makes only particles of weight 0 possible.
    """
    device, rng = get_backend(selection), np.random.default_rng(0)
    sums, block = Sums(device, count), 8
    settings = settings_of_step(
        SEED=[123456789, 4000000000], MEAN=[0.1, 1, 0.02, -0.2], DEVIATION=[0.1, 0.2, 0.05, 0.1], REVERSE=0.1,
        JITTER=0.2, FARTHEST_X=1, FARTHEST_THETA=0.5, POOL=[5, 0.1, 0.1, 3.0], SCALE=2.0**36,
        PER_BEAM_SCALE=0.01, SLOW_RATE=0.05, FAST_RATE=0.3, MOST_INJECTED=0.3, TEMPERATURE=[0.7, 0.9], STRATIFIED=draws,
        DEPTH=depth,
    )  # fmt: skip
    state = np.zeros(c.STATE)
    state[c.SLOW], state[c.FAST] = 0.9, 0.6
    real = np.float64 if "FLOAT64" in flags else np.float32
    buffers = dict(
        settings=settings, state=state, a=rng.normal(size=3 * count), b=np.zeros(3 * count), before=np.ones(count),
        first=(rng.normal(size=count) ** 2 * -30).astype(real), second=(rng.normal(size=count) ** 2 * -3).astype(real),
        score=np.zeros(count), weight=np.zeros(count), ends=np.zeros(count), copies=np.zeros(count),
        pool=rng.normal(size=15),
        estimate=np.zeros(c.ESTIMATE), share=np.zeros(count),
    )  # fmt: skip
    buffers["first"][:3] = -np.inf
    if lone:
        buffers["before"][::2], buffers["first"][::2] = 0.0, 1e7
    on = {name: device.upload(values) for name, values in buffers.items()}
    sizes, step = dict(particles=count, block=block), dict(settings=on["settings"])
    program = []
    for kind in (c.STRAIGHT, c.VELOCITY_MODEL):
        program += sums.launch(
            "move_particles", count, source=on["a"], target=on["a"], particles=count, kind=kind, **step
        )
    for stage, (source, target) in enumerate((("a", "b"), ("b", "a"))):
        for sensor, name in enumerate(("first", "second")):
            program.append(launch("add_scores", flags, (-(-count // block),), log_p=on[name], score=on["score"],
                                  sensor=sensor, largest=sums.largest, **sizes, **step))  # fmt: skip
        numbers = {name: on[name] for name in ("score", "before", "settings", "state")}
        numbers.update(sizes, blocks=-(-count // block))
        find, *scored = sums.highest(numbers["blocks"])
        program += find + sums.weigh(numbers, scored, stage)
        program += sums.set_weights(numbers, (stage, 2), (on["weight"], on["ends"]))
        if draws == c.RESIDUAL:
            given = {name: numbers[name] for name in ("state", "particles", "block", "blocks")}
            program += sums.copies(dict(given, ends=on["ends"]), on["copies"], count, stage)
        program += sums.launch("draw_particles", count, source=on[source], target=on[target], weight=on["weight"],
                               ends=on["ends"], copies=on["copies"], state=on["state"], pool=on["pool"],
                               after=on["before"], particles=count, drawn=count, stage=stage, **step)  # fmt: skip
    for second_pass in (0, 1):
        program += sums.estimate(on["a"], on["weight"], on["estimate"], count, on["estimate"] if second_pass else None)
    program += sums.launch("normalize_weights", count, weight=on["weight"], estimate=on["estimate"], share=on["share"],
                           particles=count)  # fmt: skip
    if not lanes:
        program = [one._replace(flags=one.flags - {"IN_LANES"}) for one in program]
    device.run(tuple(program))
    found = {name: device.download(on[name], np.empty_like(values)) for name, values in buffers.items()}
    device.synchronize()
    return found


def compared(backend, lanes, count=1500, **options):
    """Check that a backend computes the bits of the reference; return its buffers."""
    expected, found = run_step("numpy", count, **options), run_step(backend, count, lanes=lanes, **options)
    for name, values in expected.items():
        assert np.array_equal(values, found[name], equal_nan=True), name
    return found


in_lanes = pytest.mark.parametrize("lanes", [False, True], ids=["scalars", "lanes"])


# The largest cloud has more blocks than a work-item sums.
@in_lanes
@pytest.mark.parametrize("count", [1, 37, 1500])
@pytest.mark.parametrize("flags", [PLAIN, frozenset({"FLOAT64"})], ids=["float32", "float64"])
@pytest.mark.sampled(1.0)
def test_every_backend_has_the_bits_of_the_reference(backend, count, flags, lanes):
    compared(backend, lanes, count, flags=flags)


@in_lanes
def test_deep_ladders_have_the_bits_of_the_reference(backend, lanes):
    state = compared(backend, lanes, depth=2.0**-14)["state"]
    assert state[c.RUNG] == 2.0**-14 and state[c.LEFT] == 1 - 2.0**-14
    # The evidence is computed at the whole temperature.
    assert state[c.EVIDENCE] == 0 and state[c.SLOW] == 0.9


@in_lanes
def test_weights_stay_where_only_particles_without_one_are_possible(backend, lanes):
    found = compared(backend, lanes, lone=True)
    stage = found["state"][: c.STAGE]
    assert stage[c.DEGENERATE] == 1 and stage[c.TOTAL] == 750 * 2.0**36 and stage[c.LEFT] == 0
    assert np.array_equal(found["weight"][:4] > 0, [False, True, False, True])


@in_lanes
@pytest.mark.parametrize("draws", [c.INDEPENDENT, c.RESIDUAL], ids=["stratified", "residual"])
def test_other_draws_have_the_bits_of_the_reference(backend, draws, lanes):
    found = compared(backend, lanes, draws=draws)
    if draws == c.RESIDUAL:
        # Certain copies of the second stage, in order.
        assert 0 < found["copies"][-1] <= 1500 and (np.diff(found["copies"]) >= 0).all()


CLOUDS = {
    "narrow": (1e-3, 1e-3, 0.0),
    "far from the first particle": (1e-3, 1e-3, 20.0),
    "across the turn": (0.3, 0.2, 0.0),
    "any heading": (10.0, 20.0, 0.0),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_estimates_are_the_moments_of_the_cloud(backend, name):
    spread, turn, far = CLOUDS[name]
    rng = np.random.default_rng(1)
    poses = rng.normal((40.0, -30.0, 3.1), (spread, 2 * spread, turn), (3000, 3))
    poses[0] += (far, far, far / 20)
    poses[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    weights = rng.exponential(size=len(poses))
    weights[0] = 1e-6
    cloud = Cloud([Sensor(gs.HeadingModel(backend=backend))], len(poses))
    cloud.restore(Contents(poses, weights, None, None, np.zeros(c.STATE), None))
    for _ in range(3):
        # The third one is a recording.
        numbers = cloud.estimate(len(poses))
    w = np.asarray(weights, np.longdouble) / weights.sum()
    heading = np.arctan2(w @ np.sin(poses[:, 2]), w @ np.cos(poses[:, 2]))
    mean = np.array([w @ poses[:, 0], w @ poses[:, 1], heading])
    # A mean direction of widely spread headings is less certain.
    np.testing.assert_allclose(numbers[:3].astype(float), mean.astype(float), atol=1e-13 if turn < 1 else 1e-11)
    rest = poses - mean
    rest[:, 2] = (rest[:, 2] + np.pi) % (2 * np.pi) - np.pi
    expected = ((rest * w[:, None]).T @ rest).astype(float)
    # Offsets of 20 m from the reference, squared, cost 9 digits of squares of a millimetre.
    np.testing.assert_allclose(covariance_of(numbers), expected, rtol=1e-10, atol=2e-12 * max(far, spread) ** 2)
    off = (rest[:, :2] ** 2).sum(axis=1) > c.FAR**2
    far_off = off | (np.abs(rest[:, 2]) > c.FAR_TURN)
    assert cloud.far_share(len(poses)) == pytest.approx(float(w[far_off].sum()), rel=1e-12)


def test_an_estimate_after_a_jump_has_the_moments_of_wrapped_headings(backend):
    model = gs.PositionModel(gs.PositionParameters(sigma=0.1), backend=backend)
    pf = gs.ParticleFilter(model, particles=4000, seed=2)
    pf.initialize(mean=(0.0, 0.0, 0.3), covariance=np.diag([1e-4, 1e-4, 1e-4]))
    pf.predict((0.0, 0.0, 0.0), (100.0, 0.0, 0.0))
    found, poses = pf.estimate(), pf.host_particles()
    assert np.abs(poses[:, 2]).max() <= np.pi
    # Nearly uniform on the circle: one deviation of any heading about any mean. Also beyond the limit.
    far = gs.OdometryMotion().sampled((0.0, 0.0, 0.0), (1e9, 0.0, 0.0))
    assert far.deviation[0] > 1e8 and settings_of(far)[0][4] == 1e5
    assert 1.6 < np.sqrt(found.covariance[2, 2]) < 2.0 and abs(found.pose[2]) <= np.pi
    rest = poses - found.pose
    rest[:, 2] = np.remainder(rest[:, 2] + np.pi, 2 * np.pi) - np.pi
    np.testing.assert_allclose(found.covariance, rest.T @ rest / len(rest), rtol=1e-9, atol=1e-9)
