"""The node as a process inside ROS 2: its poses of a recording equal the offline filter's."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.ros_environment import need_ros

import gpusense as gs
from gpusense.commands import cli
from gpusense.ros.conversions import moved_enough
from gpusense.world.messages import planar_pose, stamp_of

need_ros()
from nav2_msgs.msg import ParticleCloud  # noqa: E402
from rclpy.qos import qos_profile_sensor_data  # noqa: E402
from support.ros_robot import play, started, wait_for  # noqa: E402

PARAMETERS = """\
amcl:
  ros__parameters:
    base_frame_id: base_link
    max_particles: 800
    sigma_hit: 0.1
    update_min_d: 0.05
    update_min_a: 0.05
    save_pose_rate: 0.5
    set_initial_pose: true
    initial_pose: {x: %f, y: %f, yaw: %f}
"""


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Make a folder with a bag, a map and parameters."""
    argv = ["simulate", "--world", "office", "--scans", "120", "--beams", "91", "--view", "270", "--mount", "0.2",
            "0", "0", "--backend", "numpy", "--log-out", str(tmp_path / "bag"), "--format", "ros2", "--map-out",
            str(tmp_path / "map.yaml"), "--tum", str(tmp_path / "truth.tum")]  # fmt: skip
    assert cli.main(argv) == 0
    _, x, y, _, _, _, z, w = map(float, (tmp_path / "truth.tum").read_text().split("\n")[0].split())
    (tmp_path / "nav2_params.yaml").write_text(PARAMETERS % (x, y, 2 * math.atan2(z, w)))
    return tmp_path


def offline(folder: Path) -> dict[float, np.ndarray]:
    """Return the poses of the same filter, scan by scan, by their times."""
    options = gs.compat.from_nav2(folder / "nav2_params.yaml")
    grid, track, last = gs.read_map(folder / "map.yaml"), {}, None
    for scan in gs.read_log(folder / "bag"):
        if last is None:
            filtered = options.make_filter(options.make_model(grid, scan.scanner, backend="numpy"), seed=0)
            filtered.initialize(mean=options.initial_pose, covariance=np.diag([0.25, 0.25, (math.pi / 12) ** 2]))
        elif not moved_enough(last, scan.odometry, options.update_min):
            continue
        else:
            filtered.predict(last, scan.odometry)
        filtered.correct(scan.ranges)
        last, track[round(scan.time, 3)] = scan.odometry, np.array(filtered.estimate().pose)
    return track


@pytest.mark.parametrize("without", ["", "tf2_msgs"])
def test_the_poses_are_those_of_the_filter_offline(robot: Any, recording: Path, without: str) -> None:
    more = ["--mount", "0.2", "0", "0", "--odom-topic", "odom"] if without else ["--no-autostart"]
    arguments = ["--map", str(recording / "map.yaml"), "--params-file", str(recording / "nav2_params.yaml"),
                 "--backend", "numpy", *more]  # fmt: skip
    with started(recording / "log", *arguments, without=without) as node:
        if not without:
            assert robot.change("CONFIGURE") and robot.change("ACTIVATE")
            assert robot.state() == "active"
        poses, clouds = robot.poses(), robot.listen(ParticleCloud, "particle_cloud", qos_profile_sensor_data)
        node.says("parameters without effect: save_pose_rate")
        node.says("odometry is read from the topic odom" if without else "compiled for numpy")
        scans = play(robot, recording / "bag", 10.0, skip=("/tf", "/tf_static") if without else ())
        expected = offline(recording)
        wait_for(lambda: len(poses) >= 0.95 * scans, "poses")
        # The last particles come after a rest, or with the last pose.
        wait_for(lambda: clouds and clouds[-1].header == poses[-1].header, "the particles of the last pose")
        assert {len(one.particles) for one in clouds} <= set(range(500, 801))
        assert node.alive() and node.stop() == 0
    assert scans == 120
    found = {round(stamp_of("pose", each), 3): planar_pose("pose", each.pose.pose) for each in poses}
    assert len(found) >= 0.9 * scans
    apart = [math.dist(found[time][:2], expected[time][:2]) for time in found.keys() & expected.keys()]
    assert len(apart) >= 0.9 * len(expected) and np.median(apart) < 0.03
    assert poses[-1].header.frame_id == "map"
