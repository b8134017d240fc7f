"""Transforms over time: chains, interpolation, stamps that go back, and logs that use them."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from support.bags import Writer

import gpusense as gs
from gpusense.logs.transform_buffer import TransformBuffer, TransformError


def message(parent: str, child: str, time: float, place: Any = (0.0, 0.0, 0.0), turn: Any = (0, 0, 0, 1.0)) -> Any:
    sec = math.floor(time)
    stamp = SimpleNamespace(sec=sec, nanosec=round((time - sec) * 1e9))
    translation, rotation = dict(zip("xyz", place, strict=True)), dict(zip("xyzw", turn, strict=True))
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id=parent), child_frame_id=child,
        transform={"translation": translation, "rotation": rotation},
    )  # fmt: skip


def matrix(rotation: Rotation, place: Any) -> np.ndarray:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rotation.as_matrix(), place
    return made


def moving(buffer: TransformBuffer, parent: str, child: str, *times: float) -> None:
    """Add a frame whose x is the time."""
    for time in times:
        buffer.add(message(parent, child, time, (time, 0.0, 0.0)))


def test_random_trees_agree_with_scipy() -> None:
    rng, times = np.random.default_rng(3), np.linspace(100.0, 104.0, 9)
    buffer, poses = TransformBuffer(), {0: lambda t: np.eye(4)}
    for child in range(1, 8):
        parent, static = int(rng.integers(child)), child % 3 == 0
        places, turns = rng.normal(size=(9, 3)), Rotation.random(9, rng)
        for time, place, turn in zip(times, places, turns.as_quat(), strict=True):
            size = rng.uniform(0.5, 2) * rng.choice([-1, 1])
            buffer.add(message(f"/f{parent}", f"f{child}", time, place, size * turn), static)
            if static:
                places, turns = places[:1], turns[:1]
                break
        poses[child] = lambda t, up=poses[parent], p=places, r=turns, still=static: up(t) @ (
            matrix(r[0], p[0]) if still
            else matrix(Slerp(times, r)(t), [np.interp(t, times, column) for column in p.T])
        )  # fmt: skip
    for _ in range(60):
        a, b = (int(each) for each in rng.integers(8, size=2))
        time = float(rng.uniform(100, 104))
        expected = np.linalg.inv(poses[a](time)) @ poses[b](time)
        np.testing.assert_allclose(buffer.look_up(f"f{a}", f"/f{b}", time), expected, atol=1e-6)


def test_the_latest_common_time_and_the_ends() -> None:
    buffer = TransformBuffer()
    moving(buffer, "odom", "base", 1.0, 2.0, 3.0)
    moving(buffer, "base", "arm", 1.5, 2.5)
    assert buffer.look_up("odom", "arm")[0, 3] == 5.0
    assert buffer.look_up("odom", "base")[0, 3] == 3.0
    with pytest.raises(TransformError, match=r"from base to arm ends at 2\.500 s, asked for 2\.600 s"):
        buffer.look_up("odom", "arm", 2.6)
    with pytest.raises(TransformError, match=r"from odom to base begins at 1\.000 s"):
        buffer.look_up("odom", "base", 0.9)
    with pytest.raises(TransformError, match="no transform names laser"):
        buffer.look_up("odom", "laser")
    buffer.add(message("map", "other", 1.0))
    with pytest.raises(TransformError, match="not connected"):
        buffer.look_up("map", "base")


def test_old_transforms_are_forgotten() -> None:
    buffer = TransformBuffer(cache=10.0)
    buffer.add(message("base", "laser", 0.0, (0.5, 0.0, 0.0)), static=True)
    moving(buffer, "odom", "base", *np.arange(100.0).tolist())
    assert buffer.look_up("odom", "laser", 90.0)[0, 3] == 90.5
    with pytest.raises(TransformError, match="begins"):
        buffer.look_up("odom", "base", 80.0)


@pytest.mark.parametrize("ahead", [1000.0, 3.0])
def test_one_stamp_ahead_blocks_nothing(ahead: float) -> None:
    buffer = TransformBuffer(cache=10.0)
    moving(buffer, "odom", "base", 10.0, 10.1, 10.2 + ahead)
    assert buffer.add(message("odom", "base", 10.2, (10.2, 0, 0)))
    assert not buffer.add(message("odom", "base", 10.3, (10.3, 0, 0)))
    assert buffer.look_up("odom", "base", 10.15)[0, 3] == pytest.approx(10.15)
    assert buffer.look_up("odom", "base")[0, 3] == 10.3


def test_a_recording_that_starts_again_forgets_its_end_in_all_links() -> None:
    buffer = TransformBuffer(cache=10.0)
    moving(buffer, "odom", "base", 1.0, 20.0)
    moving(buffer, "base", "arm", 1.0, 20.0)
    buffer.add(message("base", "laser", 20.0), static=True)
    assert buffer.add(message("odom", "base", 2.0, (7.0, 0.0, 0.0)))
    assert buffer.look_up("odom", "laser", 2.0)[0, 3] == 7.0
    with pytest.raises(TransformError, match="arm ends at 1"):
        buffer.look_up("base", "arm", 15.0)
    # Disorder within two seconds is ignored.
    assert not buffer.add(message("odom", "base", 1.5, (6.0, 0.0, 0.0)))
    assert buffer.look_up("odom", "base", 1.75)[0, 3] == 6.5


def test_one_old_stamp_in_a_log_drops_nothing() -> None:
    buffer = TransformBuffer()
    moving(buffer, "odom", "base", 10.0, 11.0, 12.0, 0.0, 13.0)
    moving(buffer, "base", "arm", 10.0, 13.0)
    assert [buffer.look_up("odom", "base", time)[0, 3] for time in (10.0, 11.5, 13.0)] == [10.0, 11.5, 13.0]
    # Two are a restarted recording.
    moving(buffer, "odom", "base", 2.0, 2.5, 3.0)
    assert [buffer.look_up("odom", "base", time)[0, 3] for time in (2.25, 2.75)] == [2.25, 2.75]
    with pytest.raises(TransformError, match="no transform from base to arm yet"):
        buffer.look_up("base", "arm", 12.0)


def test_a_frame_may_change_its_parent() -> None:
    buffer = TransformBuffer()
    moving(buffer, "hand", "cup", 1.0, 2.0)
    moving(buffer, "table", "cup", 3.0, 4.0)
    buffer.add(message("world", "hand", 0.0), static=True)
    buffer.add(message("world", "table", 0.0, (10.0, 0.0, 0.0)), static=True)
    assert [buffer.look_up("world", "cup", time)[0, 3] for time in (1.5, 3.5)] == [1.5, 13.5]


@pytest.mark.parametrize("bad", [
    message("a", "b", 1.0, (math.nan, 0.0, 0.0)), message("a", "b", 1.0, turn=(0, 0, 0, 0)),
    message("a", "b", 1.0, turn=(0, 0, math.inf, 1)), message("a", "/a", 1.0), message("", "b", 1.0),
])  # fmt: skip
def test_a_bad_transform_is_refused_and_harms_nothing(bad: Any) -> None:
    buffer = TransformBuffer()
    moving(buffer, "a", "b", 0.5, 1.5)
    with pytest.raises(ValueError):
        buffer.add(bad)
    assert buffer.look_up("a", "b", 1.0)[0, 3] == 1.0


def test_fixed_chains() -> None:
    buffer = TransformBuffer()
    moving(buffer, "odom", "base", 1.0, 2.0)
    for time in (1.0, 2.0, 3.0):
        buffer.add(message("base", "laser", time, (0.1, 0.0, 0.0)))
    buffer.add(message("base", "rear", 1.0, (0.5, 0.0, 0.0)), static=True)
    buffer.add(message("base", "rear", 2.0, (-0.3, 0.0, 0.0)), static=True)
    assert buffer.fixed("base", "laser")[0, 3] == 0.1 and buffer.fixed("rear", "base")[0, 3] == 0.3
    with pytest.raises(TransformError, match="from odom to base changes"):
        buffer.fixed("odom", "laser")


def test_odometry_of_a_log_through_two_frames(tmp_path: Path) -> None:
    with Writer(tmp_path, "mcap") as bag:
        bag.transform(1.0, "base_footprint", "base_link", (0.5, 0.0), 0.0)
        bag.transform(1.0, "base_link", "laser", (9.0, 0.0), 0.0)
        bag.transform(1.1, "base_link", "laser", (0.25, 0.0), 0.0)
        for k in range(3):
            bag.transform(1.0 + k, "odom", "base_footprint", (0.0, 1.0 * k), 0.0, topic="/tf")
        bag.scan(2.5, [2.0] * 5, -0.2, 0.1)
    (scan,) = gs.read_log(bag.path)
    assert scan.odometry == (0.0, 1.5, 0.0) and scan.scanner.mount == (0.75, 0.0, 0.0)
