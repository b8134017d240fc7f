"""The landmark model against mpmath: known, unknown and joint association, stiff and extreme cases, quadrature."""

from __future__ import annotations

import functools
from itertools import pairwise

import numpy as np
import pytest
from support import landmark_oracle as oracle
from support import landmark_scenes as scenes
from support.selection import on_every_backend

import gpusense as gs
from gpusense.evaluation.tolerances import TOLERANCES

PRECISIONS = ("float32", "float64")
NAN = scenes.NAN
KNOWN = (0, 2, -1, 5, 6)


@functools.cache
def tabled(name: str, precision: str) -> oracle.Table:
    """Return the densities of a scene in mpmath, for the kernels' inputs."""
    model, poses, features = scenes.model(name, "numpy", precision=precision)
    return oracle.table(model, oracle.exact_inputs(model, poses, features))


@functools.cache
def truth(name: str, precision: str, how: str) -> np.ndarray:
    """Return (N, F) log p of a scene's features in mpmath, or (N,) of their joint association."""
    model, _, _ = scenes.model(name, "numpy", association="nearest" if how == "known" else how)
    densities = tabled(name, precision)
    if how == "joint":
        return oracle.joint(model, densities)
    return oracle.likelihoods(model, densities, KNOWN if how == "known" else None)


def assert_within(found: np.ndarray, expected: np.ndarray, terms: int = 1) -> None:
    """Check for equal infinities, no NaN, and the table's tolerance times the number of terms of a sum."""
    eps = np.finfo(found.dtype).eps
    assert not np.isnan(found).any()
    np.testing.assert_array_equal(np.isneginf(found), np.isneginf(expected))
    finite = np.isfinite(expected)
    apart = np.abs(found[finite].astype(np.float64) - expected[finite])
    worst = np.max(apart / (eps * (terms + np.abs(expected[finite]))), initial=0.0)
    assert worst <= TOLERANCES["landmark"].value, f"{worst:.1f} eps (1 + |log p|)"


def scored(name: str, backend: str, precision: str, how: str) -> tuple[np.ndarray, np.ndarray]:
    """Return (N,) log p of a scene and (N, F) parts of it."""
    if how == "known":
        model, poses, features = scenes.model(name, backend, precision=precision)
        return model.log_likelihood(poses, features, KNOWN), model._evaluate(poses, features, KNOWN, each=True)[2]
    model, poses, features = scenes.model(name, backend, precision=precision, association=how)
    return model.log_likelihood(poses, features), model.associate(poses, features)[1]


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.25)
@on_every_backend(
    on_warp=lambda name, precision, how: name == "everything" and (precision, how) != ("float64", "sum"),
    name=scenes.SCENES,
    precision=PRECISIONS,
    how=("nearest", "sum", "known"),
)
def test_features_against_mpmath(backend, name, precision, how):
    expected = truth(name, precision, how)
    log_p, parts = scored(name, backend, precision, how)
    assert_within(parts if how != "known" else parts[:, [0, 1, 3, 4]],
                  expected if how != "known" else expected[:, [0, 1, 3, 4]])  # fmt: skip
    # The sum's terms may cancel: the terms bound its error.
    eps = np.finfo(precision).eps
    possible = np.isfinite(expected).all(axis=1)
    assert not np.isnan(log_p).any()
    np.testing.assert_array_equal(np.isfinite(log_p), possible)
    total, size = expected[possible].sum(axis=1), (1 + np.abs(expected[possible])).sum(axis=1)
    assert (np.abs(log_p[possible].astype(np.float64) - total) <= TOLERANCES["landmark"].value * eps * size).all()


@pytest.mark.long
@pytest.mark.sampled(0.4)
@on_every_backend(
    on_warp=lambda name, precision: (name, precision) == ("everything", "float32"),
    name=("ordinary", "everything", "no false positives"),
    precision=PRECISIONS,
)
def test_joint_association_tries_all(backend, name, precision):
    model, poses, features = scenes.model(name, backend, precision=precision, association="joint")
    expected = truth(name, precision, "joint")
    assert_within(model.log_likelihood(poses, features), expected, terms=len(features))
    which, parts = model.associate(poses, features)
    possible = np.isfinite(expected)
    for own in which[possible]:
        chosen = own[own >= 0]
        assert len(np.unique(chosen)) == len(chosen)
    assert_within(parts[possible].sum(axis=1, dtype=parts.dtype), expected[possible], terms=len(features))


@pytest.mark.long_on("warp")
@on_every_backend(on_warp=lambda precision: precision == "float32", precision=PRECISIONS)
def test_features_as_the_caller_gave_them(backend, precision):
    """The bound includes rounding of positions, directions and readings: float32 keeps them in two numbers."""
    model, poses, features = scenes.model("everything", backend, precision=precision)
    expected = oracle.likelihoods(
        model, oracle.table(model, oracle.exact_inputs(model, poses, features, rounded=False))
    )
    found = model.associate(poses, features)[1]
    # float64 positions of up to 300 m, rounded by up to 16 eps; deviations are 0.2.
    allowed = (TOLERANCES["landmark"].value + (3e4 if precision == "float64" else 0)) * np.finfo(precision).eps
    assert (np.abs(found.astype(np.float64) - expected) <= allowed * (1 + np.abs(expected))).all()


@pytest.mark.parametrize("name", ["ordinary", "everything", "wide field", "narrow field", "flat", "ranges", "bearings"])
@pytest.mark.parametrize("place", [(0.0, 0.0), (2.9, 0.9), (3.0, 1.0)])
def test_the_mixture_integrates_to_1(name, place):
    """The integral is over all features of a known landmark, also at zero range and near the sensor's limits."""
    landmarks, p, _, _, options = scenes.make(name)
    model = gs.LandmarkModel(landmarks, p, backend="numpy", precision="float64", **{**options, "mount": (0, 0, 0)})
    half, (low, high), j = p.field_of_view / 2, model._sensor.span, 0 if place == (3.0, 1.0) else 2
    # Put the landmark a little to the left, since zero range has no direction.
    away = scenes.XY[j] - place
    d, b = np.hypot(*away), 0.1
    pose = [[*place, np.arctan2(away[1], away[0]) - b]]

    def pieces(start, end, middle, sigma):
        cuts = [
            start,
            *(middle + sigma * s for s in (-30, -8, -3, 0, 3, 8, 30) if start < middle + sigma * s < end),
            end,
        ]
        nodes, weights = np.polynomial.legendre.leggauss(24)
        x = np.concatenate([(e - s) / 2 * nodes + (e + s) / 2 for s, e in pairwise(cuts)])
        w = np.concatenate([(e - s) / 2 * weights for s, e in pairwise(cuts)])
        return x, w

    axes = [([NAN], [1.0])] * 3
    if p.sigma_range is not None:
        axes[0] = pieces(0.0, p.range_max, d, p.sigma_range)
    if p.sigma_bearing is not None:
        # The wrapped difference jumps half a turn away from the landmark.
        back = (b + 2 * np.pi) % (2 * np.pi) - np.pi
        cut = min(max(back, -half), half)
        first, second = (pieces(*ends, b, p.sigma_bearing) for ends in ((-half, cut), (cut, half)))
        axes[1] = np.append(first[0], second[0]), np.append(first[1], second[1])
    if p.sigma_signature is not None:
        axes[2] = pieces(low, high, scenes.SIGNATURES[j], p.sigma_signature)
    # The components are independent, so one axis is integrated at a time, with the others fixed.
    for axis in range(3):
        if len(axes[axis][0]) > 1:
            grid = np.full((len(axes[axis][0]), 3), NAN)
            grid[:, axis] = axes[axis][0]
            grid[:, 1] = np.where(np.isnan(grid[:, 1]), NAN, np.clip(grid[:, 1], -half, half))
            _, _, parts = model._evaluate(pose, grid, np.full(len(grid), j), each=True)
            assert abs(np.exp(parts[0]) @ axes[axis][1] - 1) < 1e-11
