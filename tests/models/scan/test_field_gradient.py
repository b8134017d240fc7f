"""Gradient and information of the interpolated likelihood field: finite differences, backends, frames and scans."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import gpusense as gs

SCANNER = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.05, count=80, range_max=6.0, mount=(0.3, -0.1, 0.4))
PARAMETERS = {
    "linear": {},
    "log": dict(z_hit=1.0, z_rand=0.0, sigma_hit=0.5),
    "max": dict(z_hit=0.85, z_max=0.05),
    "sharp": dict(z_hit=1.0, z_rand=0.0, sigma_hit=1e-3),
}


def scene(origin=(0.0, 0.0, 0.0), poses=12):
    """Return a cluttered map, poses in it and a scan with missing and max readings."""
    rng = np.random.default_rng(3)
    grid = gs.OccupancyGrid(100 * (rng.random((60, 80)) < 0.02), resolution=0.1, origin=origin)
    local = np.column_stack([rng.uniform(2, 6, poses), rng.uniform(2, 4, poses), rng.uniform(-3, 3, poses)])
    c, s = np.cos(origin[2]), np.sin(origin[2])
    x, y = origin[0] + c * local[:, 0] - s * local[:, 1], origin[1] + s * local[:, 0] + c * local[:, 1]
    ranges = rng.uniform(0.5, 4.0, 80)
    ranges[3], ranges[5] = np.nan, np.inf
    return grid, np.column_stack([x, y, local[:, 2] + origin[2]]), ranges


def field(grid, backend, precision="float64", kind="linear", **options):
    parameters = gs.LikelihoodFieldParameters(interpolation="bilinear", **PARAMETERS[kind])
    return gs.LikelihoodFieldModel(grid, SCANNER, parameters, backend=backend, precision=precision, **options)


@pytest.mark.parametrize("kind", PARAMETERS)
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (-40.0, 7.0, 0.7)], ids=["plain", "yawed"])
def test_gradients_are_finite_differences(kind, origin):
    grid, poses, ranges = scene(origin)
    model = field(grid, "numpy", kind=kind, temperature=0.5)
    log_p, gradient, information = model.gradient(poses, ranges)
    np.testing.assert_array_equal(log_p, model.log_likelihood(poses, ranges))
    # Central differences have errors of h^2 within a cell, and end points leave their cells with probability h.
    h = 1e-7
    numeric = [
        (model.log_likelihood(poses + step, ranges) - model.log_likelihood(poses - step, ranges)) / (2 * h)
        for step in h * np.eye(3)
    ]
    np.testing.assert_allclose(gradient, np.stack(numeric, axis=1), rtol=1e-4, atol=1e-6 * np.abs(gradient).max())
    assert np.linalg.eigvalsh(information).min() > -1e-9 * np.abs(information).max()


def test_information_is_the_curvature_at_a_perfect_fit():
    """Compare ``information`` with second derivatives of log p where all distances are 0: Gauss-Newton is exact."""
    cells = np.zeros((40, 40), int)
    cells[:, 30] = 100
    grid = gs.OccupancyGrid(cells, resolution=0.1)
    scanner = gs.Scanner([0.0, 0.2], range_max=6.0)
    parameters = gs.LikelihoodFieldParameters(z_hit=1.0, z_rand=0.0, sigma_hit=0.2, interpolation="bilinear")
    model = gs.LikelihoodFieldModel(grid, scanner, parameters, backend="numpy", precision="float64")
    pose = np.array([[1.05 + 0.03, 2.02, 0.0]])
    _, gradient, information = model.gradient(pose, [2.0, 2.0 / np.cos(0.2)])
    assert information[0, 0, 0] == pytest.approx(2 / 0.2**2)
    assert gradient[0, 0] == pytest.approx(-2 * 0.03 / 0.2**2)
    assert abs(information[0, 1]).max() == 0


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("specialize", [True, False])
def test_devices_agree_with_the_reference(device, precision, specialize):
    grid, poses, ranges = scene()
    for kind in ("linear", "log", "max"):
        expected = field(grid, "numpy", precision, kind).gradient(poses, ranges)
        found = field(grid, device, precision, kind, specialize=specialize).gradient(poses, ranges)
        # The sums of 80 readings have another order.
        bound = 1e-4 if precision == "float32" else 1e-12
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=bound, atol=bound * np.abs(other).max())


@pytest.mark.long_on("warp")
def test_several_scans_are_single_scans(backend):
    grid, poses, ranges = scene(poses=6)
    model = field(grid, backend)
    scans = np.stack([ranges, np.where(np.arange(80) < 40, ranges, np.nan), np.full(80, np.nan)])
    together = model.gradient(poses.reshape(3, 2, 3), scans)
    for i in range(3):
        alone = model.gradient(poses[2 * i : 2 * i + 2], scans[i])
        for one, other in zip(together, alone, strict=True):
            np.testing.assert_allclose(one[i], other, rtol=1e-12)
    assert (together[1][2] == 0).all()


def test_vectors_hold_particles_of_one_scan(device):
    grid, poses, ranges = scene(poses=51)
    scans = np.stack([ranges, np.where(np.arange(80) < 40, ranges, np.nan), ranges[::-1]])
    for kind in ("linear", "max"):
        expected, found = (
            field(grid, name, "float32", kind).gradient(poses.reshape(3, 17, 3), scans) for name in ("numpy", device)
        )
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4 * np.abs(other).max())


def climbing_scene():
    """Return a turned map, poses, and a scan near each: the second has no readings, the last is of another place."""
    grid, poses, _ = scene((3.0, 1.0, 0.4), poses=24)
    ranges = gs.RayCaster(grid, 6.0, backend="numpy").cast(poses, SCANNER.bearings)
    ranges[1], ranges[-1] = np.nan, ranges[0]
    return grid, poses + np.random.default_rng(5).normal(0, (0.05, 0.05, 0.02), poses.shape), ranges


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("name", ["opencl", "warp"])
@pytest.mark.parametrize("real", ["float32", "float64"])
def test_climbs_end_where_those_of_the_reference_do(name, real, needs, monkeypatch):
    grid, poses, ranges = climbing_scene()
    ends, steps, calm = field(grid, "numpy", precision=real)._climb(poses, ranges)
    assert calm.all() and steps[1] == 1 and (ends[1] == poses[1]).all() and steps.max() > 30
    device, atol = field(grid, needs(name), precision=real), {"float32": 2e-3, "float64": 1e-9}[real]
    for kind in ("cpu", "gpu"):
        # With the kernels of GPUs, of which Warp's let the first member of a team take all readings here.
        monkeypatch.setattr(
            device._context.backend, "info", dataclasses.replace(device._context.backend.info, kind=kind, lanes=1)
        )
        found = device._climb(poses, ranges)
        np.testing.assert_allclose(found[0], ends, atol=atol)
        if real == "float64":
            np.testing.assert_array_equal(found[1:], [steps, calm])


def test_climbs_without_float64_have_the_same_ends(backend, monkeypatch):
    grid, poses, ranges = climbing_scene()
    model = field(grid, backend, precision="float32")
    ends, _, calm = model._climb(poses, ranges)
    info = dataclasses.replace(model._context.backend.info, float64=False)
    monkeypatch.setattr(model._context.backend, "info", info)
    np.testing.assert_allclose(model._climb(poses, ranges)[0], ends, atol=2e-3)
    assert calm.all()


def test_gradients_need_interpolation():
    grid, poses, ranges = scene()
    with pytest.raises(ValueError, match="interpolation"):
        gs.LikelihoodFieldModel(grid, SCANNER, gs.LikelihoodFieldParameters(), backend="numpy").gradient(poses, ranges)
