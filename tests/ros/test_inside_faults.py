"""Nodes as processes inside ROS 2: what breaks a rule is reported, and ends no node."""

from __future__ import annotations

import math
import signal
from pathlib import Path
from typing import Any

import pytest
from support.ros_environment import need_ros

from gpusense.world.messages import stamp_of

need_ros()
from rcl_interfaces.srv import GetParameters  # noqa: E402
from support.ros_robot import started, wait_for  # noqa: E402

ROOM = ["--backend", "numpy", "--ros-args", "-p", "max_particles:=500", "-p", "update_min_d:=0.05", "-p",
        "update_min_a:=0.05", "-p", "sigma_hit:=0.1"]  # fmt: skip
START = ["--start", "1.0", "1.3", "0.0", *ROOM]
WARN, ERROR, STALE = b"\1", b"\2", b"\3"


def last_x(robot: Any, time: float) -> float:
    """Return x of the pose of a time, once it has come."""
    found = wait_for(lambda: [one for one in robot.poses() if abs(stamp_of("pose", one) - time) < 1e-6], f"pose {time}")
    return float(found[-1].pose.pose.position.x)


def refused(robot: Any, send: Any, *texts: str, name: str = "amcl: filter") -> None:
    """Send until diagnostics are an error with the texts."""
    status = robot.status(
        name, lambda one: one.level == ERROR and all(text in one.message for text in texts), send=send
    )
    assert status.hardware_id == name.partition(":")[0]


def number(status: Any, *keys: str) -> int:
    """Return the sum of a status's values."""
    return sum(int(pair.value) for pair in status.values if pair.key in keys)


def ready(robot: Any) -> None:
    """Wait until the node listens, with a map and a mount."""
    robot.map()
    robot.transform(0.0, "base_footprint", "laser", 0.1, static=True)
    robot.transform(0.9, "odom", "base_footprint", 0.0)
    robot.scan(0.0)
    robot.initial_pose(1.0)
    robot.connected("map", "/tf_static", "/tf", "scan", "initialpose")


def heard(robot: Any) -> None:
    """Make the node ready, and wait until scans arrive: a publisher may know the node before the node knows it."""
    ready(robot)
    key, names = "scans received", (lambda one: "robot2" not in one.name)
    before = number(robot.status("amcl: filter", names), key)
    robot.status("amcl: filter", lambda one: names(one) and number(one, key) > before, send=lambda: robot.scan(0.0))


def test_faults_are_reported_and_the_node_goes_on(robot: Any, tmp_path: Path) -> None:
    with started(tmp_path / "log", *START) as node:
        poses = robot.poses()
        status = robot.status("amcl: filter", lambda one: True)
        assert (status.level, status.message) == (WARN, "no map yet")
        # A map that latecomers do not get, and maps that are none.
        volatile = robot.node.create_publisher(type(robot.map_message()), "map", 1)
        robot.status("amcl: filter", lambda one: "durability" in one.message)
        robot.node.destroy_publisher(volatile)
        robot.map(data=[0] * 5)
        for change in ({"data": [0] * 5}, {"resolution": 0.0}, {"width": 0, "height": 0, "data": []}):
            refused(robot, lambda change=change: robot.map(**change), "map:")
        assert node.alive()
        heard(robot)
        robot.status("amcl: filter", lambda one: one.message.startswith(("no estimate", "no scan")))
        robot.drive([1.0, 1.1, 1.2])
        assert abs(last_x(robot, 1.2) - 1.2) < 0.1
        # Poses that are none, or in another frame; the filter keeps its place.
        for change in ({"variance": math.nan}, {"variance": -1.0}, {"frame": "odom"}, {"x": math.nan}):
            refused(robot, lambda change=change: robot.initial_pose(**({"x": 3.0} | change)), "initialpose:")
        robot.drive([1.3, 1.4], first=0.3)
        assert abs(last_x(robot, 1.4) - 1.4) < 0.1
        robot.initial_pose(1.4)
        robot.status("amcl: filter", lambda one: "initialpose" not in one.message)
        # Transforms and scans that break a rule.
        refused(robot, lambda: robot.transform(1.45, "odom", "base_footprint", math.nan), "transforms:")
        refused(robot, lambda: robot.scan(1.4, angle_increment=0.0), "angle_increment")
        refused(robot, lambda: robot.map(resolution=0.0), "map:", "resolution")
        robot.map()
        # One transform and one scan far ahead.
        robot.transform(1001.0, "odom", "base_footprint", 9.0)
        robot.scan(1001.5)
        robot.drive([1.5, 1.6, 1.7], first=0.5)
        assert abs(last_x(robot, 1.7) - 1.7) < 0.1
        # Odometry that is late by more than the second of tf2's message filter.
        seen = node.text().count("\n")
        for k in range(3):
            robot.scan(1.8 + 0.1 * k, 1.8 + 0.1 * k)
        robot.status("amcl: filter", lambda one: True)
        robot.status("amcl: filter", lambda one: True)
        for k in range(3):
            robot.transform(1.8 + 0.1 * k, "odom", "base_footprint", 0.8 + 0.1 * k)
        assert abs(last_x(robot, 2.0) - 2.0) < 0.1 and node.text().count("\n") == seen
        # The recording starts again, twice, far from its end.
        robot.drive([30.0, 30.1], first=1.1)
        last_x(robot, 30.1)
        for _ in range(2):
            del poses[:]
            robot.drive([1.0, 1.1, 1.2, 1.3])
            assert abs(last_x(robot, 1.3) - 1.3) < 0.15
            robot.drive([20.0, 20.1], first=0.4)
            last_x(robot, 20.1)
        status = robot.status("amcl: filter", lambda one: one.message == "tracking")
        counts = {pair.key: pair.value for pair in status.values}
        assert (
            counts["verdict"] == "tracking" and int(counts["scans received"]) > int(counts["scans that counted"]) > 20
        )
        robot.status("amcl: filter", lambda one: one.level == STALE and "no scan" in one.message)
        assert "went back" in node.text() and "Traceback" not in node.text()
        assert node.alive() and node.stop(signal.SIGINT) == 0


def test_time_that_goes_back_may_start_the_filter_again_and_lost_scans_are_counted(robot: Any, tmp_path: Path) -> None:
    with started(tmp_path / "log", *START, "-p", "restart_after_jump:=true") as node:
        robot.poses()
        heard(robot)
        robot.drive([30.0, 30.1])
        last_x(robot, 30.1)
        robot.transform(1.0, "odom", "base_footprint", 7.0)
        robot.scan(1.0)
        assert abs(last_x(robot, 1.0) - 1.0) < 0.1

        def known(status: Any) -> int:
            return number(status, "scans received", "scans lost before the callback")

        before, sent = known(robot.status("amcl: filter", lambda one: True)), [0]

        def send(count: int) -> None:
            sent[0] += count
            for _ in range(count):
                robot.publishers["scan"].publish(robot.last)

        send(400)
        robot.status("amcl: filter", lambda one: known(one) - before == sent[0], send=lambda: send(1), pause=2.5)
        assert node.alive() and node.stop() == 0


@pytest.mark.parametrize("more, text", [
    (["--backend", "nosuch"], "nosuch"), ([*ROOM[:2], "--ros-args", "-p", "scan_topic:='bad topic'"], "bad topic"),
    (["--ros-args", "-p", "z_hit:=-1.0"], "z_hit"), (["--ros-args", "-p", "map_file:=/no.yaml"], "no.yaml"),
    (["watch", "--backend", "nosuch"], "nosuch"), (["watch", "--ros-args", "-p", "patience:=0.0"], "patience"),
    (["--ros-args", "-p", "nothing"], "nothing"),
])  # fmt: skip
def test_what_cannot_be_configured_is_named(robot: Any, tmp_path: Path, more: list[str], text: str) -> None:
    with started(tmp_path / "log", *more) as node:
        assert node.process.wait(90) == 1
    assert text in node.text() and "Traceback" not in node.text()


def test_a_lifecycle_manager_hears_of_a_failure_and_may_try_again(robot: Any, tmp_path: Path) -> None:
    with started(tmp_path / "log", "--no-autostart", "--params-file", str(parameters(tmp_path)), *ROOM[:2]) as node:
        assert not robot.change("CONFIGURE") and robot.state() == "unconfigured"
        node.says("z_rand")
        client = robot.node.create_client(GetParameters, "amcl/get_parameters")
        assert client.wait_for_service(90)
        future = client.call_async(GetParameters.Request(names=["max_particles", "laser_model_type", "z_rand"]))
        wait_for(future.done, "parameters")
        assert future.result().values[0].integer_value == 900
        assert node.alive() and node.stop(signal.SIGTERM) == 0


def parameters(folder: Path) -> Path:
    file = folder / "nav2_params.yaml"
    file.write_text("amcl:\n  ros__parameters: {max_particles: 900, z_rand: -0.5}\nother:\n  ros__parameters: {a: 1}\n")
    return file


def test_the_lifecycle_and_two_robots(robot: Any, tmp_path: Path) -> None:
    names = ["-r", "__ns:=/robot2", "-r", "/tf:=tf", "-r", "/tf_static:=tf_static"]
    with (
        started(tmp_path / "one", "--no-autostart", *START) as node,
        started(tmp_path / "two", *START, *names) as other,
    ):
        assert robot.change("CONFIGURE") and robot.change("ACTIVATE")
        heard(robot)
        robot.drive([1.0, 1.1])
        last_x(robot, 1.1)
        assert robot.change("DEACTIVATE") and robot.state() == "inactive"
        robot.drive([1.2, 1.3], first=0.2)
        assert robot.change("CLEANUP") and robot.state() == "unconfigured"
        assert robot.change("CONFIGURE") and robot.change("ACTIVATE")
        heard(robot)
        robot.drive([1.0, 1.1])
        last_x(robot, 1.1)
        assert max(stamp_of("pose", one) for one in robot.poses()) < 1.15
        first = robot.status("amcl: filter", lambda one: "robot2" not in one.name)
        second = robot.status("amcl: filter", lambda one: "robot2" in one.name)
        assert (first.name, second.name) == ("amcl: filter", "robot2/amcl: filter")
        assert second.message == "no map yet"
        assert node.stop() == 0 and other.stop(signal.SIGTERM) == 0


def test_the_watching_node(robot: Any, tmp_path: Path) -> None:
    name = "localization_watch: localisation"
    with started(tmp_path / "log", "watch", "--backend", "numpy", "--ros-args", "-p", "patience:=1.0e12") as node:
        robot.status(name, lambda one: one.level == STALE)
        refused(robot, lambda: robot.map(resolution=0.0), "map:", name=name)
        ready(robot)
        robot.status(name, lambda one: one.level == STALE)

        def judged(**more: Any) -> None:
            robot.scan(1.0)
            robot.initial_pose(**({"x": 1.0, "topic": "amcl_pose", "time": 1.0} | more))

        for change in ({"variance": math.nan}, {"variance": -1.0}, {"x": math.nan}, {"frame": "odom"}):
            refused(robot, lambda change=change: judged(**change), "amcl_pose:", name=name)
        status = robot.status(name, lambda one: one.level < ERROR, send=judged)
        assert status.values[0].key == "p_lost" and "Traceback" not in node.text()
        assert node.alive() and node.stop(signal.SIGTERM) == 0
