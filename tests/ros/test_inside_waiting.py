"""Nodes inside ROS 2 that no executor spins, as while a callback keeps them busy: messages wait, and none is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from support.ros_environment import need_ros

need_ros()
import rclpy  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.lifecycle import TransitionCallbackReturn  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.qos import qos_profile_sensor_data  # noqa: E402
from support.ros_robot import wait_for  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from gpusense.ros.nodes.localization import LocalizationNode  # noqa: E402
from gpusense.ros.nodes.watching import WatchingNode  # noqa: E402
from gpusense.ros.nodes.wiring import Guard, Transforms  # noqa: E402

NUMBER = 400


@pytest.fixture
def make(robot: Any) -> Iterator[Callable[..., Any]]:
    """Yield a function that makes a node of this process, with parameters; it ends with the test."""
    made: list[Any] = []

    def node_of(kind: Any, *parameters: str) -> Any:
        rclpy.init(args=["--ros-args", *(word for each in ("backend:=numpy", *parameters) for word in ("-p", each))])
        made.append(kind())
        return made[0]

    yield node_of
    for each in made:
        each.destroy_node()
    rclpy.try_shutdown()


def known(transforms: Any) -> int:
    """Take what waits, and return the number of transforms from the odometry's frame to the base."""
    transforms.take_waiting()
    return sum(len(each.times) for each in transforms.buffer.links() if each.child == "base")


def test_transforms_wait_in_order(robot: Any) -> None:
    robot.publisher(TFMessage, "/tf", 2 * NUMBER)
    transforms = Transforms(Guard(robot.node.get_logger()), ("odom", "base"), apart="/map")
    node = rclpy.create_node("busy", context=robot.context)
    transforms.subscribe(node)
    robot.connected("/tf")
    for k in range(NUMBER):
        robot.transform(5.0 + 0.01 * k, "odom", "base", 0.01 * k)
        # Two localisers, the second far behind.
        robot.transform(5.0 + 0.01 * k - 4.0 * (k % 2), "map", "odom", 0.1)
    wait_for(lambda: known(transforms) == NUMBER, "transforms")
    np.testing.assert_allclose(transforms.buffer.look_up("odom", "base", 7.005)[0, 3], 2.005)
    assert {(each.parent, each.child) for each in transforms.buffer.links()} == {("odom", "base")}
    node.destroy_node()


def test_odometry_of_a_publisher_that_sends_without_acknowledgements(robot: Any) -> None:
    robot.publisher(Odometry, "odom", qos_profile_sensor_data)
    transforms = Transforms(Guard(robot.node.get_logger()), ("odom", "base"), odometry="odom", mount=(0.0, 0.0, 0.0))
    node = rclpy.create_node("busy", context=robot.context)
    transforms.subscribe(node)
    robot.connected("odom")
    sent = 0

    def arrives() -> bool:
        nonlocal sent
        robot.odometry(5.0 + 0.01 * sent, 0.01 * sent)
        sent += 1
        return known(transforms) >= 3

    wait_for(arrives, "odometry")
    node.destroy_node()


def test_the_watcher_takes_the_scans_before_a_pose(robot: Any, make: Callable[..., Any]) -> None:
    node = make(WatchingNode, "mount:=[0.1, 0.0, 0.0]")
    node.on_map(robot.map_message())
    robot.scan(0.0)
    robot.connected("scan")
    for k in range(20):
        robot.scan(1.0 + k)
    pose = robot.initial_pose(1.0, topic="amcl_pose", time=20.0)

    def is_judged() -> bool:
        # A publisher may know the node before the node knows it, and scans of that time are lost.
        robot.scan(20.0)
        node.on_pose(pose)
        return bool(node.watcher.status(20.0)["level"] == 0)

    wait_for(is_judged, "the scan of the pose")


def test_a_configuration_that_fails_leaves_no_topic(robot: Any, make: Callable[..., Any]) -> None:
    node = make(LocalizationNode, "scan_topic:='bad topic'")
    before = [len(list(each)) for each in (node.subscriptions, node.publishers, node.services, node.timers)]
    for topic in ("bad topic", "scan"):
        node.set_parameters([Parameter("scan_topic", value=topic)])
        done = node.trigger_configure()
        assert done == (TransitionCallbackReturn.SUCCESS if topic == "scan" else TransitionCallbackReturn.FAILURE)
        if topic == "scan":
            assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
        assert [len(list(each)) for each in (node.subscriptions, node.publishers, node.services, node.timers)] == before
