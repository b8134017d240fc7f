"""Watch a localiser as a node: read scans, map and the localiser's poses; publish diagnostics.

It needs no filter of gpusense: ``amcl_pose`` may come from nav2_amcl, or from any node that stamps its pose with the
time of the scan.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid as MapMessage
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from gpusense.backends import get_backend
from gpusense.logs.transform_buffer import TransformError
from gpusense.ros.conversions import WATCH, check_watch, mount_of
from gpusense.ros.nodes.wiring import Guard, Transforms, diagnostic_array, latched, run, unreliable, waiting
from gpusense.ros.watcher import Watcher
from gpusense.world.grid import OccupancyGrid
from gpusense.world.map_files import read_map


class WatchingNode(Node):
    """Diagnostics of a localiser."""

    def __init__(self) -> None:
        super().__init__("localization_watch")
        dynamic = ParameterDescriptor(dynamic_typing=True)
        values = {name: self.declare_parameter(name, value, dynamic).value for name, value in WATCH.items()}
        check_watch(values)
        get_backend(values["backend"])
        self.full_name = self.get_fully_qualified_name().lstrip("/")
        self.guard = Guard(self.get_logger())
        self.watcher = Watcher(
            backend=values["backend"], tolerance=values["tolerance"], patience=values["patience"],
            frame=values["global_frame_id"], range_max=values["laser_max_range"], risk=values["risk"],
        )  # fmt: skip
        self.transforms = Transforms(self.guard, ("odom", values["base_frame"]), mount=mount_of(values["mount"]))
        self.transforms.subscribe(self)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        kept = latched()
        if values["map_file"]:
            self.watcher.set_map(read_map(values["map_file"]))
        else:
            self.create_subscription(MapMessage, "map", self.guard.around("map", self.on_map), kept)
        self.take_scan = self.guard.around("scan", self.on_scan)
        self.scans = self.create_subscription(LaserScan, "scan", self.take_scan, unreliable(50))
        for kind, topic, callback, quality in (
            (PoseWithCovarianceStamped, "amcl_pose", self.on_pose, unreliable(50)),
            (PoseWithCovarianceStamped, "initialpose", self.on_initial_pose, 1),
        ):
            self.create_subscription(kind, topic, self.guard.around(topic, callback), quality)
        # Simulated time may stop.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self.guard.around("status", self.publish), clock=steady)

    def on_map(self, message: MapMessage) -> None:
        """Take a map; a bad one leaves the previous map."""
        self.watcher.set_map(OccupancyGrid.from_message(message))

    def on_initial_pose(self, message: Any) -> None:
        """Forget the scans so far."""
        self.watcher.reset()

    def on_scan(self, message: LaserScan) -> None:
        """Keep a scan until its pose arrives."""
        try:
            laser = self.transforms.laser(message.header.frame_id)
        except TransformError as error:
            self.get_logger().warning(str(error), throttle_duration_sec=2.0)
            return
        if self.watcher.add_scan(message, laser):
            self.publish()
        if self.watcher.problem is not None:
            raise ValueError(self.watcher.problem)

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Judge a pose by the scans up to now, and publish the verdict at once."""
        for scan, _ in waiting(self.scans):
            self.take_scan(scan)
        if self.watcher.add_pose(message):
            self.publish()

    def publish(self) -> None:
        """Publish the diagnostics."""
        now = self.get_clock().now()
        fields = self.watcher.status(1e-9 * now.nanoseconds, self.full_name)
        fields = self.guard.into(fields)
        self.diagnostics.publish(diagnostic_array(fields, now.to_msg()))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(WatchingNode, args)
