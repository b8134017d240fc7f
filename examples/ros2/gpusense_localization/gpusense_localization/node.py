"""The node: scan, odometry and map in; pose, particle cloud and the transform from map to odometry out.

    ros2 run gpusense_localization localize --ros-args -p parameters:=FILE -p backend:=auto

``parameters`` is a file for nav2_amcl, or what ``gpusense fit`` wrote; ``node`` names one of several in it. Topics and
frames are those of nav2_amcl.
"""

from __future__ import annotations

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav2_msgs.msg import Particle, ParticleCloud
from nav_msgs.msg import OccupancyGrid
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import LaserScan
from tf2_ros import Buffer, TransformBroadcaster, TransformException, TransformListener

import gpusense as gs
from gpusense_localization import conversions
from gpusense_localization.localizer import Localizer


class LocalizationNode(Node):
    """Monte Carlo localisation with gpusense."""

    def __init__(self) -> None:
        super().__init__("amcl")
        file = self.declare_parameter("parameters", "").value
        chosen = self.declare_parameter("node", "").value or None
        options = gs.compat.from_nav2(file or {"amcl": {"ros__parameters": {}}}, node=chosen)
        self.localizer = Localizer(options, backend=self.declare_parameter("backend", "auto").value)
        self.options = options
        self.reported: str | None = None
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.broadcaster = TransformBroadcaster(self)
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)
        self.pose = self.create_publisher(PoseWithCovarianceStamped, "amcl_pose", kept)
        self.cloud = self.create_publisher(ParticleCloud, "particle_cloud", qos_profile_sensor_data)
        map_topic, scan_topic = options.topics
        self.create_subscription(OccupancyGrid, map_topic, self.localizer.set_map, kept)
        self.create_subscription(LaserScan, scan_topic, self.on_scan, qos_profile_sensor_data)
        self.create_subscription(PoseWithCovarianceStamped, "initialpose", self.on_initial_pose, 1)
        if options.ignored:
            self.get_logger().warning(f"parameters without effect: {', '.join(options.ignored)}")

    def on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Begin around a pose that a user sets."""
        covariance = conversions.covariance_of(message.pose.covariance)
        self.localizer.start_at(conversions.pose_of(message.pose.pose), covariance)

    def on_scan(self, message: LaserScan) -> None:
        """Localise with a scan, and publish the results."""
        _, odometry_frame, base = self.options.frames
        try:
            laser = self.buffer.lookup_transform(base, message.header.frame_id, Time())
            odometry = self.buffer.lookup_transform(odometry_frame, base, Time.from_msg(message.header.stamp))
        except TransformException as error:
            self.get_logger().warning(str(error), throttle_duration_sec=2.0)
            return
        mount = conversions.transform_of(laser.transform)
        if self.localizer.update(message, conversions.transform_of(odometry.transform), mount):
            self.publish_estimate(message)
        problem = self.localizer.problem
        if problem is not None and problem != self.reported:
            self.get_logger().error(f"a scan is skipped, as are others like it: {problem}")
            self.reported = problem
        if self.localizer.estimate is not None and self.options.tf_broadcast:
            self.publish_transform(message)

    def publish_estimate(self, scan: LaserScan) -> None:
        """Publish the pose and the particles."""
        estimate = self.localizer.estimate
        pose = PoseWithCovarianceStamped()
        pose.header.stamp, pose.header.frame_id = scan.header.stamp, self.options.frames[0]
        conversions.fill(pose.pose.pose, conversions.pose_fields(tuple(float(value) for value in estimate.pose)))
        pose.pose.covariance = conversions.covariance_fields(estimate.covariance)
        self.pose.publish(pose)
        if self.cloud.get_subscription_count():
            particles = conversions.cloud_fields(*self.localizer.cloud())
            cloud = ParticleCloud(header=pose.header)
            cloud.particles = [conversions.fill(Particle(), fields) for fields in particles]
            self.cloud.publish(cloud)

    def publish_transform(self, scan: LaserScan) -> None:
        """Send the transform from the map to the odometry frame."""
        sent = TransformStamped()
        ahead = Time.from_msg(scan.header.stamp) + Duration(seconds=self.options.transform_tolerance)
        sent.header.stamp, sent.header.frame_id = ahead.to_msg(), self.options.frames[0]
        sent.child_frame_id = self.options.frames[1]
        conversions.fill(sent.transform, conversions.transform_fields(self.localizer.map_to_odometry()))
        self.broadcaster.sendTransform(sent)


def main() -> None:
    """Run the node."""
    rclpy.init()
    node = LocalizationNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
