"""Bumpers by brute force; for all sensors without a scan: missing readings, laws, batches, extreme poses."""

from __future__ import annotations

import dataclasses
import runpy

import numpy as np
import pytest
from support import absolute_oracle as oracle
from support.absolute_scenes import (
    CELLS,
    GRID,
    MISSING,
    NAN,
    SQUARE,
    assert_close,
    each_precision,
    models,
    poses_around,
)
from support.kernel_scenes import squared_distances
from support.paths import ROOT
from support.public_names import classes_of

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.models import chunking
from gpusense.models.landmark.base import FeatureModel
from gpusense.models.point.base import PointModel
from gpusense.models.point.bumper import sample_outline

# -------------------------------------------------------------------------------------------------------- bumper


def brute_force(pose, points, radius, pressed, p, *, unknown="free", outside="free"):
    """Return log P of one segment; nan if a point is so near an edge that its cell is uncertain."""
    pad = 30
    occupied = (CELLS >= 65) | ((CELLS == -1) if unknown == "occupied" else False)
    squared = squared_distances(np.pad(occupied, pad, constant_values=outside == "occupied"))
    nearest = []
    for point in points:
        x, y, _, _ = oracle.placed_point(pose, point, GRID.origin, GRID.resolution)
        col, row = int(np.floor(x)), int(np.floor(y))
        if min(x - col, y - row, col + 1 - x, row + 1 - y) < 1e-6:
            return NAN
        nearest.append(squared[row + pad, col + pad])
    return oracle.bump(min(nearest), GRID.resolution, radius, pressed, p)


SCENES = {
    "circle": (0.17, None, {}),
    "square": (SQUARE, None, dict(unknown="occupied")),
    "sides": (SQUARE, [0, 1, -1, 1], {}),
    "arcs": (0.3, [(-0.5, 0.5), (2.5, 4.0)], dict(outside="occupied")),
}
BUMPERS = {
    "ordinary": gs.BumperParameters(),
    "sharp": gs.BumperParameters(sigma=1e-8, p_contact=0.9),
    "certain": gs.BumperParameters(sigma=0.01, p_contact=1.0, p_false=0.0),
    "blunt": gs.BumperParameters(sigma=1e6),
}


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.25)
@each_precision
@pytest.mark.parametrize("scene", SCENES)
def test_bumpers_by_brute_force(backend: str, precision: str, scene: str) -> None:
    outline, segments, how = SCENES[scene]
    poses = poses_around(GRID, 30)
    radius, points, start = sample_outline(outline, segments, GRID.resolution / 2)
    for p in BUMPERS.values():
        model = gs.BumperModel(GRID, outline, p, segments=segments, backend=backend, precision=precision, **how)
        for pressed in ([True] * model.segments, [False, True][: model.segments]):
            truth = np.array(
                [
                    [
                        brute_force(pose, points[start[s] : start[s + 1]], radius, pressed[s], p, **how)
                        for s in range(model.segments)
                    ]
                    for pose in poses
                ]
            )
            told = ~np.isnan(truth).any(axis=1)
            assert told.sum() > 20
            found = model.log_likelihood(poses, pressed if segments else pressed[0])
            assert_close(found[told], truth[told].sum(axis=1), precision, truth[told])


@pytest.mark.long_on("warp")
@each_precision
def test_a_bumper_of_ten_nanometres(backend: str, precision: str) -> None:
    cells = np.zeros((5, 9), int)
    cells[2, 7] = 100
    p, poses = gs.BumperParameters(sigma=1e-8, p_contact=0.9, p_false=0.0), [[0.45, 0.25, 0.0]]
    for steps in (-2.0, 0.3, 5.0):
        radius = 0.3 - 0.05 + 1e-8 * steps
        model = gs.BumperModel(gs.OccupancyGrid(cells, 0.1), radius, p, backend=backend, precision=precision)
        for pressed in (True, False):
            found = model.log_likelihood(poses, pressed)
            assert_close(found, [oracle.bump(9, 0.1, radius, pressed, p)], precision)


# ---------------------------------------------------------------------------------------------------- all sensors


def test_every_sensor_has_a_row() -> None:
    sensors = classes_of(PointModel) - classes_of(FeatureModel)
    assert {type(model) for model, _ in models("numpy").values()} == sensors
    assert MISSING.keys() == models("numpy").keys()


@each_precision
def test_missing_readings_and_no_particles(backend: str, precision: str) -> None:
    poses = poses_around(GRID)
    for name, (model, measured) in models(backend, precision).items():
        found = model.log_likelihood(poses, MISSING[name])
        assert found.dtype == precision and found.shape == (len(poses),)
        np.testing.assert_array_equal(found, 0)
        for reading in (measured[0], MISSING[name]):
            assert model.log_likelihood(np.zeros((0, 3)), reading).shape == (0,)
    none = gs.BeaconModel([], backend=backend, precision=precision)
    np.testing.assert_array_equal(none.log_likelihood(poses, []), 0)


def test_one_missing_reading_of_several(backend: str) -> None:
    poses = poses_around(GRID)
    bumper, one = models(backend)["bumper"][0], gs.BumperModel(GRID, SQUARE, segments=[0, -1, -1, -1], backend=backend)
    np.testing.assert_array_equal(bumper.log_likelihood(poses, [True, NAN]), one.log_likelihood(poses, True))
    beacons = models(backend)["beacons"][0]
    np.testing.assert_array_equal(beacons.log_likelihood(poses, [NAN, 4.0]), beacons.log_likelihood(poses, [4.0], [1]))


@pytest.mark.long_on("warp")
@each_precision
def test_batches_order_and_repetition_change_no_bit(backend: str, precision: str, monkeypatch) -> None:
    poses = poses_around(GRID)
    order = np.random.default_rng(0).permutation(len(poses))
    whole = {name: m.log_likelihood(poses, *z) for name, (m, z) in models(backend, precision).items()}
    monkeypatch.setattr(chunking, "CHUNK", 7)
    for name, (model, measured) in models(backend, precision).items():
        out = np.empty(len(poses), precision)
        assert model.log_likelihood(poses, *measured, out=out) is out
        np.testing.assert_array_equal(out, whole[name])
        np.testing.assert_array_equal(model.log_likelihood(poses[order], *measured), whole[name][order])


def test_poses_that_the_host_places_have_the_same_bits(backend: str) -> None:
    """The host computes places and residuals for devices without float64."""
    poses = poses_around(GRID)
    device = get_backend(backend)
    before = device.info
    usual = {name: m.log_likelihood(poses, *z) for name, (m, z) in models(backend).items()}
    try:
        device.info = dataclasses.replace(before, float64=False)
        for name, (model, measured) in models(device).items():
            np.testing.assert_array_equal(model.log_likelihood(poses, *measured), usual[name])
            with pytest.raises(ValueError, match="precision: must be 'float32'"):
                models(device, "float64")
    finally:
        device.info = before


@pytest.mark.long_on("warp")
@each_precision
def test_extreme_poses_are_never_nan(backend: str, precision: str) -> None:
    huge = np.array([0.0, 1e-300, 1.0, 1e9, 1e18, 1e30, 1e200, -1e308, 1.7e308])
    theta = np.array([0.0, np.pi, -np.pi, 1e6, 1e22, 1.7e308])
    poses = np.stack(np.meshgrid(huge, huge, theta), axis=-1).reshape(-1, 3)
    given = {
        **models(backend, precision),
        "needle": (gs.PositionModel(gs.PositionParameters(sigma=1e-8, mount=(1e3, 0)), backend=backend,
                                    precision=precision), ((-1e308, 0.0),)),
        "sharp": (gs.HeadingModel(gs.HeadingParameters(sigma=1e-8), backend=backend, precision=precision), (1e300,)),
        "tail": (gs.BeaconModel([(0.0, 0.0)], gs.BeaconParameters(kind="student_t", nu=1, z_hit=1, z_rand=0),
                                backend=backend, precision=precision), ([3.0],)),
    }  # fmt: skip
    for name, (model, measured) in given.items():
        found = model.log_likelihood(poses, *measured)
        assert not np.isnan(found).any() and not np.isposinf(found).any(), name
        # Exponents are clamped before they overflow.
        assert np.isfinite(found).all(), name


@pytest.mark.long_on("warp")
@each_precision
def test_the_frame_does_not_matter(backend: str, precision: str) -> None:
    """The world is shifted and turned by half a turn; multiples of 2^-10 move exactly."""
    rng = np.random.default_rng(8)
    poses = np.concatenate([np.round(rng.uniform(-8, 8, (40, 2)) * 1024) / 1024, rng.uniform(-3, 3, (40, 1))], axis=1)
    shift = np.array([4194304.0, -1048576.0, 0.0])
    own = dict(backend=backend, precision=precision)
    position = gs.PositionModel(gs.PositionParameters(covariance=((2.0, 0.7), (0.7, 1.0))), **own)
    here = position.log_likelihood(poses, (0.5, 1.0))
    np.testing.assert_array_equal(position.log_likelihood(poses + shift, (4194304.5, -1048575.0)), here)
    np.testing.assert_array_equal(position.log_likelihood(-poses, (-0.5, -1.0)), here)
    xy, z = np.array([(0.0, 8.0), (8.0, -8.0), (-8.0, 0.5)]), [3.0, 7.0, 2.0]
    here = gs.BeaconModel(xy, **own).log_likelihood(poses, z)
    np.testing.assert_array_equal(gs.BeaconModel(xy + shift[:2], **own).log_likelihood(poses + shift, z), here)
    turned = gs.BeaconModel(-xy[::-1], **own).log_likelihood(-poses, z[::-1])
    np.testing.assert_allclose(turned, here, rtol=8 * np.finfo(precision).eps)
    compass = gs.HeadingModel(gs.HeadingParameters(sigma=0.4), **own)
    # A mirrored world.
    np.testing.assert_array_equal(compass.log_likelihood(poses, 1.0), compass.log_likelihood(-poses, -1.0))


def test_the_example_sharpens_the_estimate(capsys) -> None:
    runpy.run_path(str(ROOT / "examples" / "several_sensors.py"))
    lines = capsys.readouterr().out.splitlines()
    together = [float(line.split()[4]) for line in lines if line.startswith("... and")]
    assert len(together) == 4 and together[3] < 1 < together[2] < together[0]
