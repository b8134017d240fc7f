"""Point-to-line ICP: kernels of each language, and nearest points against all points."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from support.matching_scenes import FRONT, RING, random_pairs

from gpusense.backends import get_backend
from gpusense.interface.structs import MatchRules
from gpusense.matching.icp import IcpPairs, space_of
from gpusense.matching.points import scan_points
from gpusense.reference import icp_pairs as reference
from gpusense.reference.line_fit import fit_lines

RULES = MatchRules(40, 2, 3, 1, 0, 0, 1.0, 0.3, 1.0, 0.03, 0.85, 0.06, 0.3, 1e-4)
# Sums have another order than NumPy's: information is compared relative to its largest number.
TOLERANCE = {"float32": (2e-5, 2e-4), "float64": (1e-10, 1e-9)}


def run(backend: str, precision: str, scanner, rules, guesses, noise=(0.01,) * 4):
    """Match four pairs, with rules of each level of noise."""
    device, real = get_backend(backend), np.dtype(precision)
    first, second, _ = random_pairs(4, scanner, seed=3)
    second[1, 50:90] = np.inf
    points = scan_points(np.concatenate([first, second]), scanner, real)
    lock, space = space_of(device)
    with lock, space:
        pairs = IcpPairs(device, real, points, np.arange(8).reshape(2, 4).T, np.array(noise), space)
        return pairs.run(np.arange(4), guesses, rules if isinstance(rules, list) else [rules])


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.4)
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("scanner", [RING, FRONT], ids=["ring", "front"])
@pytest.mark.parametrize("thin", [0, 1])
def test_devices_agree_with_the_reference(device, precision, scanner, thin):
    rng = np.random.default_rng(5)
    truth = random_pairs(4, scanner, seed=3)[2]
    guesses = truth[:, None] + rng.uniform(-0.1, 0.1, (4, 3, 3))
    rules = RULES._replace(thin=thin, iterations=6 if thin else 40)
    expected, found = (run(name, precision, scanner, rules, guesses) for name in ("numpy", device))
    pose, sums = TOLERANCE[precision]
    np.testing.assert_allclose(found[..., :6], expected[..., :6], atol=pose)
    for part in (slice(6, 12), slice(12, 18)):
        largest = np.abs(expected[..., part]).max(axis=-1, keepdims=True)
        assert (np.abs(found - expected)[..., part] <= sums * largest).all()
    np.testing.assert_allclose(found[..., 18:], expected[..., 18:], rtol=sums, atol=pose)


# PoCL takes 6 s to compile a team, and Warp's processor has none: each team, precision and kind of scan is tried once.
TEAMS = {"large": (1024, 256), "small": (255, 32), "none": (31, 1)}
KINDS = {"ring": (RING, 0), "front": (FRONT, 0), "thin": (FRONT, 1)}
ONCE = [("large", "thin", "float64"), ("small", "ring", "float32"), ("none", "front", "float32")]
EACH = [
    pytest.param(*TEAMS[case[0]], *KINDS[case[1]], case[2], id="-".join(case),
                 marks=[] if case in ONCE else pytest.mark.slow)
    for case in itertools.product(TEAMS, KINDS, ("float32", "float64"))
]  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(("limit", "team", "scanner", "thin", "precision"), EACH)
def test_a_team_of_work_items_agrees_with_the_reference(device, monkeypatch, limit, team, scanner, thin, precision):
    """GPUs match in teams within their groups; here processors do."""
    sizes = pretend_gpu(device, monkeypatch, limit)
    test_devices_agree_with_the_reference(device, precision, scanner, thin)
    assert sizes == [(4 * 3 * team,)]


def pretend_gpu(device, monkeypatch, limit=1024) -> list[tuple[int, ...]]:
    """Match in teams like GPUs with groups of at most ``limit``; return the list of sizes of launches."""
    sizes: list[tuple[int, ...]] = []
    starts = device.run
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, kind="gpu", lanes=1))
    monkeypatch.setattr(device, "largest_group", lambda kernel, flags: limit)
    monkeypatch.setattr(device, "run", lambda program: (sizes.append(program[-1].size), starts(program)))
    return sizes


@pytest.mark.long
def test_items_of_few_points_have_small_teams(device, monkeypatch):
    sizes = pretend_gpu(device, monkeypatch)
    guesses = random_pairs(4, RING, seed=3)[2][:, None] + np.zeros((4, 3, 3))
    rules = RULES._replace(thin=1, iterations=6, stride=12, score_stride=12)
    expected, found = (run(name, "float32", RING, rules, guesses) for name in ("numpy", device))
    np.testing.assert_allclose(found[..., :6], expected[..., :6], atol=TOLERANCE["float32"][0])
    assert sizes == [(4 * 3 * 32,)]


@pytest.mark.long_on("warp")
def test_pairs_of_different_noise_share_a_launch_and_keep_their_rules(device):
    guesses = random_pairs(4, RING, seed=3)[2][:, None] + 0.05
    levels = [RULES, RULES._replace(stride=5, capture=0.6, near=0.2), RULES._replace(iterations=3)]
    noise = (0.01, 0.02, 0.01, 0.04)
    alone = np.array([run(device, "float32", RING, [level] * 3, guesses, noise) for level in levels])
    both = run(device, "float32", RING, levels, guesses, noise)
    assert (both == alone[[0, 1, 0, 2], np.arange(4)]).all()
    assert not (both == alone[0]).all(axis=(1, 2)).all()


@pytest.mark.long_on("warp")
def test_the_search_by_bearing_finds_the_nearest_of_all_points(device):
    """One iteration from far-off guesses: pairs and their sums equal a comparison of all points."""
    rng = np.random.default_rng(1)
    guesses = np.column_stack([rng.uniform(-3, 3, (400, 2)), rng.uniform(-3, 3, 400)]).reshape(4, 100, 3)
    rules = RULES._replace(iterations=1, capture=5.0)
    expected = run("numpy", "float64", FRONT, rules, guesses)
    found = run(device, "float64", FRONT, rules, guesses)
    assert (found[..., 18] == expected[..., 18]).all()
    np.testing.assert_allclose(found[..., 19], expected[..., 19], rtol=1e-12)
    assert (found[..., 21:32] == expected[..., 21:32]).all()
    np.testing.assert_allclose(found[..., 32:], expected[..., 32:], atol=1e-9)


def test_lines_are_total_least_squares():
    """Normals and offsets follow from the smallest singular vector of the centred neighbours."""
    rng = np.random.default_rng(0)
    z = 2 + 0.02 * rng.normal(size=(1, 360))
    points = scan_points(z, RING, np.dtype(np.float64))
    line = np.empty((360, 4))
    which = np.zeros(1, np.int32)
    fit_lines(frozenset(), points.point, points.start, which, line, 1, 360, 1, 2, 16, 0.1, 0.05, 0.0, 0.06)
    for k in (0, 1, 100, 359):
        near = points.point[(k + np.arange(-2, 3)) % 360, :2]
        centre = near.mean(axis=0)
        _, sizes, axes = np.linalg.svd(near - centre)
        assert abs(line[k, :2] @ axes[1]) == pytest.approx(1, abs=1e-9)
        assert line[k, :2] @ centre == pytest.approx(line[k, 2], abs=1e-12)
        assert line[k, 3] == pytest.approx(1 / sizes[0] ** 2)


def test_the_step_is_gauss_newtons():
    """Information and gradient equal finite differences of weighted errors at fixed pairs and weights."""
    rng = np.random.default_rng(2)
    angle = rng.uniform(-3, 3, 20)
    line = np.column_stack([np.cos(angle), np.sin(angle), rng.normal(size=20), np.ones(20)])
    arm = rng.normal(size=(20, 2))
    information, gradient, _, numbers, pull = reference.add_pairing(line, arm, arm, 0.5, False)

    def error(pose):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        place = arm @ np.array([[c, s], [-s, c]]) + pose[:2]
        return (line[:, :2] * place).sum(axis=1) - line[:, 2]

    jacobian = np.stack([(error(step) - error(-step)) / 2e-6 for step in 1e-6 * np.eye(3)], axis=1)
    weight = 1 / (1 + (error(np.zeros(3)) / 0.5) ** 2)
    np.testing.assert_allclose(information, jacobian.T @ (weight[:, None] * jacobian), atol=1e-8)
    np.testing.assert_allclose(gradient, -jacobian.T @ (weight * error(np.zeros(3))), atol=1e-8)
    assert numbers[0] == pytest.approx(weight.sum())
    np.testing.assert_allclose(pull, weight * error(np.zeros(3)))
