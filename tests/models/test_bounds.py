"""Bounds of many poses, found by the device: exact, and errors as for few poses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gpusense as gs
from gpusense.backends import Backend, arrays, get_backend
from gpusense.backends.workspace import Workspace
from gpusense.models import poses as poses_module
from gpusense.models.poses import bounds_on_device

ODD = (np.nan, np.inf, -np.inf, 5e-324, 1.7e308, 2.0**20 + 1)
GRID = gs.OccupancyGrid([[0] * 40 + [100]] * 30, 0.5)
SCANNER = gs.Scanner(np.linspace(-1.0, 1.0, 7), range_max=4.0)
RANGES = np.array([1.0, 2.0, np.inf, 3.0, 0.5, 2.5, 1.5])


@pytest.fixture
def late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every device bound poses, from 8 on."""
    monkeypatch.setattr(poses_module, "bounds_poses", lambda backend: backend.info.float64)
    monkeypatch.setattr(poses_module, "LEAST_BOUNDED", 8)


@pytest.mark.parametrize("count", [1, 2, 63, 64, 65, 16384, 16385, 100_003])
def test_bounds_are_those_of_numpy(count: int, device: Backend) -> None:
    poses = np.random.default_rng(count).normal(0, 1e3, (count, 3))
    space = Workspace(device)
    for row, column, odd in [(0, 0, None), *((count // 2, i % 3, odd) for i, odd in enumerate(ODD)), (0, 1, -1e300)]:
        changed = poses.copy()
        changed[row, column] = poses[row, column] if odd is None else odd
        found = bounds_on_device(device, space, space.upload("poses", changed), count)
        np.testing.assert_array_equal(found, [changed.min(axis=0), changed.max(axis=0)])
        with np.errstate(over="ignore", under="ignore"):
            single = changed.astype(np.float32)
        found = bounds_on_device(device, space, space.upload("poses", single), count, single=True)
        np.testing.assert_array_equal(found, [single.min(axis=0), single.max(axis=0)])


@settings(deadline=None)
@given(st.lists(st.floats(width=64), min_size=1, max_size=200), st.integers(1, 9), st.integers(0, 50))
def test_the_reference_takes_every_number_of_a_work_item(numbers: list[float], items: int, apart: int) -> None:
    apart = min(apart, len(numbers) - 1)
    number, found = np.array(numbers), np.empty(2 * items)
    count = len(number) - apart
    get_backend("numpy").compile("bound_numbers", frozenset())((items,), number, found, count, apart, items)
    for i in range(items):
        low, high = number[:count][i::items], number[apart:][i::items]
        expected = (low.min(), high.max()) if len(low) else (np.inf, -np.inf)
        np.testing.assert_array_equal(found[[i, items + i]], expected)


def calls(backend: Backend) -> list[tuple[str, object]]:
    """Return calls of models that place poses, by name."""
    beam, field = (kind(GRID, SCANNER, backend=backend) for kind in (gs.BeamModel, gs.LikelihoodFieldModel))
    beacons = gs.BeaconModel([(1.0, 2.0)], backend=backend)
    caster = gs.RayCaster(GRID, 4.0, backend=backend)
    unseen = np.full(7, np.nan)
    return [
        ("beam", lambda poses: beam.log_likelihood(poses, RANGES)),
        ("field", lambda poses: field.log_likelihood(poses, RANGES)),
        ("no readings", lambda poses: field.log_likelihood(poses, unseen)),
        ("scans", lambda poses: field.log_likelihood(np.stack([poses, poses[::-1]]), [RANGES, RANGES + 0.1])),
        ("two", lambda poses: np.array(gs.log_likelihoods([beam, field], poses, RANGES))),
        ("beacons", lambda poses: beacons.log_likelihood(poses, [3.0])),
        ("no beacons", lambda poses: beacons.log_likelihood(poses, [np.nan])),
        ("rays", lambda poses: caster.cast(poses, SCANNER.bearings)),
        ("no rays", lambda poses: caster.cast(poses, [])),
    ]


def test_results_have_the_bits_of_poses_that_the_host_bounds(
    device: Backend, late: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(3)
    cloud = np.column_stack([rng.uniform(1, 18, 50), rng.uniform(1, 13, 50), rng.normal(0, 9, 50)])
    turned = cloud + np.array([0.0, 0.0, 2.0**21])
    used: list[bool] = []
    real = poses_module.bounds_on_device

    def bounds(*given: Any, single: bool) -> object:
        used.append(single)
        return real(*given, single=single)

    monkeypatch.setattr(poses_module, "bounds_on_device", bounds)
    for name, call in calls(device):
        # Use each number of poses once per path, since GPUs have a shorter path for repeated sizes.
        single = cloud[2:].astype(np.float32), turned[3:].astype(np.float32)
        for poses in (cloud, turned[1:], cloud[:3], *single):
            used.clear()
            found = call(poses)  # type: ignore[operator]
            assert bool(used) == (len(poses) > 3 and not name.startswith("no ")), name
            assert not any(used) or poses.dtype == np.float32
            # Poses of several scans, and of small calls on GPUs, pass through float64.
            assert all(used) or poses.dtype != np.float32 or name == "scans" or device.info.kind == "gpu", name
            with monkeypatch.context() as early:
                early.setattr(poses_module, "bounds_poses", lambda backend: False)
                np.testing.assert_array_equal(found, call(poses), err_msg=name)  # type: ignore[operator]


def test_a_pose_that_is_not_finite_is_refused_with_the_same_words(device: Backend, late: None) -> None:
    poses = np.zeros((50, 3)) + 2.0
    poses[33, 1] = np.nan
    for name, call in calls(device):
        messages = []
        for least in (8, 1000):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(poses_module, "LEAST_BOUNDED", least)
                with pytest.raises(ValueError, match=r"^poses: ") as caught:
                    call(poses)  # type: ignore[operator]
            messages.append(str(caught.value))
        assert messages[0] == messages[1], name
        poses[33, 1] = 2.0
        call(poses)  # type: ignore[operator]
        poses[33, 1] = np.nan


def test_only_gpus_bound_poses(device: Backend) -> None:
    assert poses_module.bounds_poses(device) == (device.info.kind == "gpu")
    few = np.zeros((poses_module.LEAST_BOUNDED, 3))
    assert arrays.bounds_of(few) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
