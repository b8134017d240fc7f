"""The watching node: scans, map and the poses of any localiser in; diagnostics out.

    ros2 run gpusense_localization watch --ros-args -p backend:=auto -p base_frame:=base_footprint

It needs no gpusense filter: ``amcl_pose`` may come from nav2_amcl, or from any node that stamps its pose with the time
of the scan.
"""

from __future__ import annotations

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import LaserScan
from tf2_ros import Buffer, TransformException, TransformListener

from gpusense_localization import conversions
from gpusense_localization.watcher import Watcher
from gpusense_localization.wiring import diagnostic_array, latched


class WatchingNode(Node):
    """Diagnostics of a localiser."""

    def __init__(self) -> None:
        super().__init__("localization_watch")
        self.base = self.declare_parameter("base_frame", "base_footprint").value
        self.watcher = Watcher(
            backend=self.declare_parameter("backend", "auto").value,
            tolerance=self.declare_parameter("tolerance", 0.05).value,
            patience=self.declare_parameter("patience", 10.0).value,
        )
        self.reported: str | None = None
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        kept = latched()
        self.create_subscription(OccupancyGrid, "map", self.watcher.set_map, kept)
        self.create_subscription(LaserScan, "scan", self.on_scan, qos_profile_sensor_data)
        self.create_subscription(PoseWithCovarianceStamped, "amcl_pose", self.on_pose, kept)
        self.create_subscription(PoseWithCovarianceStamped, "initialpose", lambda _: self.watcher.reset(), 1)
        self.create_timer(1.0, self.publish)

    def on_scan(self, message: LaserScan) -> None:
        """Keep a scan until its pose comes."""
        try:
            laser = self.buffer.lookup_transform(self.base, message.header.frame_id, Time())
        except TransformException as error:
            self.get_logger().warning(str(error), throttle_duration_sec=2.0)
            return
        self.watcher.add_scan(message, conversions.transform_of(laser.transform))
        problem = self.watcher.problem
        if problem is not None and problem != self.reported:
            self.get_logger().error(f"a scan is skipped, as are others like it: {problem}")
            self.reported = problem

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Judge a pose, and publish the verdict at once."""
        if self.watcher.add_pose(message):
            self.publish()

    def publish(self) -> None:
        """Publish the diagnostics."""
        now = self.get_clock().now()
        self.diagnostics.publish(diagnostic_array(self.watcher.status(1e-9 * now.nanoseconds), now.to_msg()))


def main() -> None:
    """Run the node."""
    rclpy.init()
    node = WatchingNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
