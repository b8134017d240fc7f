"""Position fixes, headings, beacons and bumpers against mpmath and SciPy; stiff cases; integrals of 1."""

from __future__ import annotations

import numpy as np
import pytest
from support import absolute_oracle as oracle
from support.absolute_scenes import assert_close, each_precision

import gpusense as gs

STEPS = np.array([0.0, 0.3, -1.0, 2.5, -6.0, 12.0, 37.0])


# ------------------------------------------------------------------------------------------------------ position

WORLD = (4.9e6, 3.9e6, 5.1e6, 4.1e6)
POSITIONS = {
    "ordinary": gs.PositionParameters(sigma=2.0, z_hit=0.9, z_rand=0.1, region=WORLD, mount=(0.3, -0.2)),
    "correlated": gs.PositionParameters(covariance=((4.0, -1.9), (-1.9, 1.0)), mount=(1.0, 0.0)),
    "only outliers": gs.PositionParameters(sigma=1.0, z_hit=0.0, z_rand=1.0, region=WORLD),
    "no room for outliers": gs.PositionParameters(sigma=1.0, z_hit=0.5, z_rand=0.5, region=(0, 0, 1, 1)),
    **{f"sigma {s:g}": gs.PositionParameters(sigma=s) for s in (1e-8, 1e-3, 1e6)},
    "needle": gs.PositionParameters(covariance=((1.0, 1 - 1e-9), (1 - 1e-9, 1.0))),
    "uneven": gs.PositionParameters(covariance=((1e-12, 0.9e-6), (0.9e-6, 1.0)), z_hit=0.5, z_rand=0.5, region=WORLD),
}


@each_precision
def test_positions(backend: str, precision: str) -> None:
    rng = np.random.default_rng(3)
    fix = np.array([5e6 + 0.25, 4e6 - 0.5])
    for name, p in POSITIONS.items():
        scale = p.sigma or np.sqrt(p.covariance[0][0])
        steps = np.concatenate(
            [np.stack(np.meshgrid(STEPS, STEPS[:4]), axis=-1).reshape(-1, 2), rng.normal(0, 1, (9, 2))]
        )
        poses = np.concatenate([fix + scale * steps, rng.uniform(-4, 4, (len(steps), 1))], axis=1)
        poses[-1, 2] = 1e6
        found = gs.PositionModel(p, backend=backend, precision=precision).log_likelihood(poses, fix)
        assert found.dtype == precision, name
        assert_close(found, [oracle.position(pose, fix, p) for pose in poses], precision)


# ------------------------------------------------------------------------------------------------------- heading

HEADINGS = {
    "compass": gs.HeadingParameters(sigma=0.2, z_hit=0.9, z_rand=0.1, offset=-0.4),
    "only noise": gs.HeadingParameters(z_hit=0.0, z_rand=1.0),
    "turned far": gs.HeadingParameters(sigma=0.5, offset=1e5),
    **{f"sigma {s:g}": gs.HeadingParameters(sigma=s) for s in (1e-8, 1e-4, 0.7, 1.4999, 1.5001, 2.5, 6.0, 1e3, 1e6)},
    **{
        f"kappa {k:g}": gs.HeadingParameters(kind="von_mises", kappa=k)
        for k in (0, 1e-300, 1e-9, 0.5, 30, 1e4, 1e9, 1e16)
    },
    "von mises": gs.HeadingParameters(kind="von_mises", kappa=20.0, z_hit=0.5, z_rand=0.5, offset=3.0),
}


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.4)
@each_precision
def test_headings(backend: str, precision: str) -> None:
    for name, p in HEADINGS.items():
        width = p.sigma if p.kind == "wrapped_normal" else 1 / np.sqrt(p.kappa) if p.kappa else 1.0
        width = min(width, 0.1)
        for reading in (0.0, 3.1, 4.7, -1e6 + 0.1):
            at = np.remainder(reading - p.offset, 2 * np.pi)
            around = np.array([at + step * width for step in STEPS] + [at + np.pi - 1e-7, at - np.pi + 1e-7])
            theta = np.concatenate(
                [around, [np.pi, -np.pi, 0.0, 1.5, 1e6, -1e6 + 0.3, 1e9, 1e22, at + 1e5 * 2 * np.pi]]
            )
            poses = np.stack([np.zeros_like(theta), np.ones_like(theta), theta], axis=1)
            found = gs.HeadingModel(p, backend=backend, precision=precision).log_likelihood(poses, reading)
            with np.errstate(all="raise"):
                truth = [oracle.heading(t, reading, p) for t in theta]
            truth = np.array(truth, float)
            assert found.dtype == precision, name
            assert_close(found, truth, precision)


# ------------------------------------------------------------------------------------------------------- beacons

XY = np.array([(5e6, 4e6), (5e6 + 30.0, 4e6), (5e6, 4e6 + 40.0)])
BEACONS = {
    "normal": gs.BeaconParameters(mount=(0.2, 0.1), bias=0.15),
    "own biases": gs.BeaconParameters(range_max=40.0, sigma_range=2.0, bias=(0.15, -21.0, 12.0)),
    "own biases of t": gs.BeaconParameters(kind="student_t", range_max=40.0, bias=(0.15, -21.0, 12.0)),
    "near its end": gs.BeaconParameters(sigma_range=5.0, range_max=40.0, z_hit=1.0, z_rand=0.0),
    "shrunk": gs.BeaconParameters(bias=-45.0, sigma_range=3.0, z_hit=0.999, z_rand=0.001),
    "mixture": gs.BeaconParameters(kind="mixture", range_max=60.0),
    "one wide": gs.BeaconParameters(kind="mixture", heavy_weight=1.0, sigma_heavy=20.0, range_max=60.0),
    "one narrow": gs.BeaconParameters(kind="mixture", heavy_weight=0.0, z_hit=1.0, z_rand=0.0),
    **{f"t {nu}": gs.BeaconParameters(kind="student_t", nu=nu, range_max=60.0) for nu in (1, 2, 3, 4, 7, 30, 99, 100)},
    "t alone": gs.BeaconParameters(kind="student_t", nu=3, z_hit=1.0, z_rand=0.0, sigma_range=0.01, bias=0.1),
    "flat t": gs.BeaconParameters(kind="student_t", nu=5, sigma_range=1e6, z_hit=1.0, z_rand=0.0),
    "only noise": gs.BeaconParameters(z_hit=0.0, z_rand=1.0),
    "sigma 1e6": gs.BeaconParameters(sigma_range=1e6, z_hit=1.0, z_rand=0.0),
}


def own_bias(p: gs.BeaconParameters, beacon: int) -> gs.BeaconParameters:
    return p.replace(bias=p.bias[beacon]) if isinstance(p.bias, tuple) else p


@pytest.mark.long_on("warp")
@each_precision
def test_beacons(backend: str, precision: str) -> None:
    rng = np.random.default_rng(5)
    poses = np.concatenate([rng.uniform((0, 0, -3), (35, 40, 3), (7, 3)), [[0, 0, 0], [30, 0, 1e6], [-400, 20, 1]]])
    poses[:, :2] += XY[0]
    ranges = np.array([24.5, 22.0, np.nan, 31.0])
    for name, p in BEACONS.items():
        ids = [0, 1, 1, 2]
        found = gs.BeaconModel(XY, p, backend=backend, precision=precision).log_likelihood(poses, ranges, ids)
        parts = np.array(
            [
                [oracle.beacon(pose, XY[i], ranges[k], own_bias(p, i)) for k, i in enumerate(ids) if k != 2]
                for pose in poses
            ]
        )
        assert found.dtype == precision, name
        assert_close(found, parts.sum(axis=1), precision, parts)


@each_precision
@pytest.mark.parametrize(("kind", "nu"), [("normal", 1), ("student_t", 3), ("student_t", 99), ("mixture", 1)])
def test_beacons_of_ten_nanometres(backend: str, precision: str, kind: str, nu: int) -> None:
    p = gs.BeaconParameters(sigma_range=1e-8, kind=kind, nu=nu, sigma_heavy=1e-6, z_hit=1.0, z_rand=0.0, range_max=20.0)
    poses = np.zeros((len(STEPS), 3))
    poses[:, 0] = 1e-8 * STEPS
    xy = [[3.0, 4.0]]
    found = gs.BeaconModel(xy, p, backend=backend, precision=precision).log_likelihood(poses, [5.0])
    assert_close(found, [oracle.beacon(pose, xy[0], 5.0, p) for pose in poses], precision)
