"""Pose graphs: the sparse solution against SciPy's dense least squares, and covariances against dense inverses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpusense.chaining.drift import Drift, inverse_blocks, pose_covariances
from gpusense.chaining.graph import KERNEL, Equations, normal_equations, pose_jacobians, solve
from gpusense.chaining.links import CLOSURE, MATCH, Links, chained
from gpusense.world.pose_algebra import pose_difference, wrap_angle


def scene(seed: int, count: int = 12, outlier: bool = False) -> tuple[np.ndarray, Links]:
    """Return disturbed poses around a loop, and links of full and of partial information."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(count) / count
    truth = np.stack([3 * np.cos(angle), 2 * np.sin(angle), angle + np.pi / 2], axis=1)
    # Links to the next two poses, and closures.
    first = np.concatenate([np.arange(count - 1), np.arange(count - 2), [0, 1, 2]])
    second = np.concatenate([np.arange(1, count), np.arange(2, count), [count - 1, count - 2, count // 2]])
    root = rng.normal(0, 3, (len(first), 3, 3)) + 4 * np.eye(3)
    # Corridors: nothing is known along x.
    root[3, :, 0] = root[-1, :, 0] = 0.0
    pose = pose_difference(truth[first], truth[second]) + rng.normal(0, 0.05, (len(first), 3))
    if outlier:
        pose[-2] += (2.0, -1.0, 0.7)
    kind = [MATCH] * (2 * count - 3) + [CLOSURE] * 3
    links = Links.joined([
        Links.of(name, [a], [b], p[None], (r.T @ r)[None], 0.9)
        for name, a, b, p, r in zip(kind, first, second, pose, root, strict=True)
    ])  # fmt: skip
    return chained(truth[0], pose[: count - 1]), links


def dense(start: np.ndarray, links: Links, kernel: float) -> tuple[np.ndarray, float]:
    """Return the poses of least cost by SciPy, with numerical derivatives and independent residuals."""
    from scipy.optimize import least_squares

    values, axes = np.linalg.eigh(links.information)
    root = np.sqrt(np.maximum(values, 0))[:, :, None] * axes.transpose(0, 2, 1)

    def errors(free: np.ndarray) -> np.ndarray:
        z = np.concatenate([start[0], free]).reshape(-1, 3)
        place, heading = z[:, 0] + 1j * z[:, 1], np.exp(1j * z[:, 2])
        there = (place[links.second] - place[links.first]) / heading[links.first]
        turn = np.angle(heading[links.second] / heading[links.first] / np.exp(1j * links.pose[:, 2]))
        off = np.stack([there.real - links.pose[:, 0], there.imag - links.pose[:, 1], turn], axis=1)
        scaled = np.einsum("lij,lj->li", root, off)
        if np.isinf(kernel):
            return scaled.ravel()
        return np.sqrt(kernel**2 * np.log1p(np.square(scaled).sum(axis=1) / kernel**2))

    found = least_squares(errors, start[1:].ravel(), xtol=1e-12, ftol=1e-12, gtol=1e-12, max_nfev=500)
    return np.concatenate([start[0], found.x]).reshape(-1, 3), 2 * found.cost


@pytest.mark.parametrize("seed", range(4))
def test_least_squares_are_those_of_scipy(seed: int) -> None:
    start, links = scene(seed)
    found = solve(start, links, kernel=np.inf, least=1e-14)
    truth, cost = dense(start, links, np.inf)
    assert found.cost == pytest.approx(cost, rel=1e-8)
    off = found.poses - truth
    off[:, 2] = wrap_angle(off[:, 2])
    assert np.abs(off).max() < 1e-5
    assert (found.links.weight == 1).all()


@pytest.mark.parametrize("seed", range(2))
def test_the_kernel_leaves_an_outlier_out_as_scipy_does(seed: int) -> None:
    start, links = scene(seed, outlier=True)
    found = solve(start, links, least=1e-14)
    truth, cost = dense(found.poses + 0.01 * (np.arange(len(start)) > 0)[:, None], links, KERNEL)
    assert found.cost == pytest.approx(cost, rel=1e-5)
    assert np.abs(found.poses - truth)[:, :2].max() < 5e-3
    assert found.links.weight[-2] < 0.2
    assert np.delete(found.links.weight, -2).min() > 0.3


def test_jacobians_are_those_of_differences() -> None:
    start, links = scene(1)
    one, two = pose_jacobians(start, links.first, links.second)
    for index, analytic in ((links.first, one), (links.second, two)):
        for k in range(3):
            residual = []
            for sign in (1, -1):
                rows = np.repeat(start[None], len(links), axis=0)
                rows[np.arange(len(links)), index, k] += sign * 1e-6
                residual.append(np.array([links[[n]].residuals(rows[n])[0] for n in range(len(links))]))
            numeric = (residual[0] - residual[1]) / 2e-6
            assert np.abs(analytic[:, :, k] - numeric).max() < 1e-7


def test_normal_equations_are_those_of_the_dense_jacobian() -> None:
    start, links = scene(1)
    # Two links between the same poses, and a pose without any.
    start = np.concatenate([start, [(9.0, 8.0, 0.3)]])
    links = Links.joined([links, links[3:5]])
    links = replace(links, weight=np.linspace(0.2, 1.0, len(links)))
    one, two = pose_jacobians(start, links.first, links.second)
    whole = np.zeros((len(links), 3, len(start), 3))
    whole[np.arange(len(links)), :, links.first], whole[np.arange(len(links)), :, links.second] = one, two
    whole = whole[:, :, 1:].reshape(len(links), 3, -1)
    side = np.einsum("lij,lik,l->ljk", whole, links.information, links.weight)
    matrix = normal_equations(start, links).toarray()
    assert matrix == pytest.approx(np.einsum("ljk,lkm->jm", side, whole), abs=1e-9)
    gradient = np.einsum("ljk,lk->j", side, links.residuals(start))
    ordered = Equations(len(start), links.first, links.second, ordered=True)
    information = links.information * links.weight[:, None, None]
    pull = np.einsum("lij,lj->li", information, links.residuals(start))
    again, turned = ordered.at(start, information, pull, np.full(len(start), 0.5))
    place = (3 * ordered.place[:, None] + np.arange(3)).ravel()
    assert again.toarray()[np.ix_(place, place)][3:, 3:] == pytest.approx(matrix + 0.5 * np.eye(len(matrix)))
    assert turned[place] == pytest.approx(np.append(np.zeros(3), gradient), abs=1e-9)
    assert (ordered.step(again, turned)[0] == 0).all()


def test_a_direction_that_no_link_observes_stays_where_it_was() -> None:
    information = np.diag([0.0, 100.0, 400.0])
    links = Links.of(MATCH, [0, 1], [1, 2], np.array([(5.0, 0.1, 0.0), (7.0, -0.1, 0.0)]), np.stack([information] * 2))
    start = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.5, 0.0, 0.0)])
    found = solve(start, links)
    assert found.poses[:, 0] == pytest.approx([0.0, 1.0, 2.5], abs=1e-6)
    assert found.poses[:, 1] == pytest.approx([0.0, 0.1, 0.0], abs=1e-4)
    spread = pose_covariances(found)
    assert spread[1, 0, 0] > 1e4
    assert spread[2, 0, 0] > 1e4
    assert spread[1, 1, 1] == pytest.approx(1 / 100, rel=1e-2)


@pytest.mark.parametrize("poses", [np.zeros((1, 3)), np.zeros((0, 3))])
def test_a_graph_without_links_stays(poses: np.ndarray) -> None:
    found = solve(poses, Links.joined([]))
    assert found.poses.shape == poses.shape
    assert pose_covariances(found).shape == (*poses.shape, 3)


@pytest.mark.parametrize("settle", [False, True])
def test_the_cost_never_rises(settle: bool) -> None:
    for seed in range(5):
        start, links = scene(seed, outlier=True)
        squared = links.squared(links.residuals(start))
        before = float(np.sum(KERNEL**2 * np.log1p(squared / KERNEL**2)))
        assert solve(start, links, settle=settle).cost <= before


def test_a_long_chain_that_turns_settles_in_a_few_steps() -> None:
    # Firm links over one and two steps disagree in heading: the ends of the chain turn far.
    rng, count = np.random.default_rng(2), 400
    steps = np.tile([0.5, 0.0, 0.02], (count - 1, 1))
    truth = chained(np.zeros(3), steps)
    first = np.concatenate([np.arange(count - 1), np.arange(count - 2)])
    second = np.concatenate([np.arange(1, count), np.arange(2, count)])
    links = Links.of(MATCH, first, second, pose_difference(truth[first], truth[second]),
                     np.tile(np.diag([1e4, 1e4, 1e5]), (len(first), 1, 1)))  # fmt: skip
    start = chained(np.zeros(3), steps + rng.normal(0, 1, steps.shape) * (0.005, 0.005, 0.1))
    plain, found = (solve(start, links, kernel=np.inf, settle=one) for one in (False, True))
    assert plain.iterations == 50 and plain.cost > 100
    assert found.iterations < 8
    assert found.poses == pytest.approx(truth, abs=1e-6)


@pytest.mark.parametrize("count", [2, 3, 40])
def test_covariances_are_blocks_of_the_dense_inverse(count: int) -> None:
    rng = np.random.default_rng(count)
    first = np.append(np.arange(count - 1), rng.integers(0, count - 1, count))
    second = np.append(np.arange(1, count), np.minimum(first[count - 1 :] + rng.integers(1, 9, count), count - 1))
    keep = first != second
    first, second = first[keep], second[keep]
    root = rng.normal(0, 1, (len(first), 3, 3)) + 3 * np.eye(3)
    links = Links.of(MATCH, first, second, rng.normal(0, 1, (len(first), 3)), root.transpose(0, 2, 1) @ root)
    found = solve(np.cumsum(rng.normal(0, 1, (count, 3)), axis=0), links)
    matrix = normal_equations(found.poses, found.links)
    whole = np.linalg.inv(matrix.toarray() + 1e-6 * np.eye(3 * count - 3))
    blocks = inverse_blocks(matrix, 1e-6)
    for k in range(count - 1):
        part = slice(3 * k, 3 * k + 3)
        assert np.allclose(blocks[k], whole[part, part], rtol=1e-8, atol=1e-12)
    # Relative covariances from the complete inverse, by the derivatives of the relative pose.
    joint = np.zeros((3 * count, 3 * count))
    joint[3:, 3:] = whole
    one, two = pose_jacobians(found.poses, first, second)
    relative = Drift(found).relative(first, second)
    for n, (a, b) in enumerate(zip(first, second, strict=True)):
        wide = np.zeros((3, 3 * count))
        wide[:, 3 * a : 3 * a + 3], wide[:, 3 * b : 3 * b + 3] = one[n], two[n]
        assert np.allclose(relative[n], wide @ joint @ wide.T, rtol=1e-6, atol=1e-10)
    # Eliminating all other poses leaves the covariances of a few anchors unchanged.
    some = Drift(found, most=max(count // 3, 1))
    pairs = np.array([(a, b) for a in some.anchors for b in some.anchors if a < b], np.int64).reshape(-1, 2).T
    assert np.allclose(some.relative(*pairs), Drift(found, most=count).relative(*pairs), rtol=1e-6, atol=1e-10)


def test_breaks_of_a_long_graph_are_seen_between_its_anchors() -> None:
    # Each pose is linked to the next one; a link in the middle has hardly any information.
    count, broken = 320, 161
    information = np.tile(np.diag([1e4, 1e4, 1e5]), (count - 1, 1, 1))
    information[broken - 1] = np.diag([1.0, 1.0, 4.0])
    steps = np.tile([0.5, 0.0, 0.0], (count - 1, 1))
    links = Links.of(MATCH, np.arange(count - 1), np.arange(1, count), steps, information)
    found = solve(chained(np.zeros(3), steps), links)
    pairs = np.array([broken - 3, broken - 1, 10]), np.array([broken + 2, broken, 14])
    for drift, most in ((Drift(found), 300), (Drift(found, most=20), 20)):
        deviation = np.sqrt(drift.relative(*pairs)[:, 0, 0])
        assert len(drift.anchors) <= most
        assert deviation[:2] == pytest.approx(1.0, abs=0.01)
        assert deviation[2] < 0.05
    # Up to 300 poses nothing is omitted.
    assert len(Drift(solve(found.poses[:300], links[:299])).anchors) == 300


def test_closures_of_eliminated_poses_count_between_kept_ones() -> None:
    # Two passages of a circle, each pose linked to the next two, with closures between passages.
    count, lap = 120, 60
    angle = 2 * np.pi * np.arange(count) / lap
    poses = np.stack([5 * np.cos(angle), 5 * np.sin(angle), angle + np.pi / 2], axis=1)
    first = np.concatenate([np.arange(count - 1), np.arange(count - 2)])
    second = np.concatenate([np.arange(1, count), np.arange(2, count)])
    moved = pose_difference(poses[first], poses[second])
    links = Links.of(MATCH, first, second, moved, np.tile(np.diag([1e4, 2e4, 4e4]), (len(first), 1, 1)))
    again = np.arange(1, lap - 1, 3)
    moved = pose_difference(poses[again], poses[again + lap + 1])
    # As along a corridor, nothing is known along x.
    closures = Links.of(
        CLOSURE, again, again + lap + 1, moved, np.tile(np.diag([0.0, 900.0, 900.0]), (len(again), 1, 1))
    )
    plain, found = solve(poses, links), solve(poses, Links.joined([links, closures]))
    reduced, exact = Drift(found, most=30), Drift(found, most=count)
    a, b = np.triu_indices(len(reduced.anchors), 1)
    pairs = reduced.anchors[a], reduced.anchors[b]
    far = np.abs(pairs[1] - pairs[0] - lap) < 10
    wide = np.linalg.det(exact.relative(*pairs))
    ratio = np.linalg.det(reduced.relative(*pairs)) / wide
    assert 0.9 < ratio.min() < ratio.max() < 1.5
    # The second passage drifts unless loops are closed.
    assert (np.linalg.det(Drift(plain, most=30).relative(*pairs)) / wide)[far].min() > 20
