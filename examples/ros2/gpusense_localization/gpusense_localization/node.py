"""The node: scan, odometry and map in; pose, particle cloud and the transform from map to odometry out.

    ros2 launch gpusense_localization localize.launch.py parameters:=FILE

It is a lifecycle node. ``parameters`` is a file for nav2_amcl, or what ``gpusense fit`` wrote; ``node`` names one of
several in it. Topics and frames are those of nav2_amcl.
"""

from __future__ import annotations

import sys
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav2_msgs.msg import Particle, ParticleCloud
from nav_msgs.msg import OccupancyGrid
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Empty
from tf2_ros import Buffer, TransformBroadcaster, TransformException, TransformListener

import gpusense as gs
from gpusense_localization import conversions
from gpusense_localization.localizer import Localizer
from gpusense_localization.scan_queue import NotYetError, ScanQueue
from gpusense_localization.wiring import diagnostic_array, latched

# Time between two looks at the transforms of scans that wait [s].
_LOOK = 0.01


class LocalizationNode(LifecycleNode):
    """Monte Carlo localisation with gpusense."""

    def __init__(self) -> None:
        super().__init__("amcl")
        for name, value in {"parameters": "", "node": "", "backend": "auto", "autostart_node": False}.items():
            self.declare_parameter(name, value)
        self.localizer: Localizer | None = None
        self.active = False
        self.reported: str | None = None
        self._made: list[tuple[Any, Any]] = []

    def value_of(self, name: str) -> Any:
        """Return a parameter's value."""
        return self.get_parameter(name).value

    # -------------------------------------------------------------------------------------------------- the lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, and listen for the map, a first pose and transforms."""
        source = self.value_of("parameters") or {"amcl": {"ros__parameters": {}}}
        try:
            self.options = gs.compat.from_nav2(source, node=self.value_of("node") or None)
            self.localizer = Localizer(self.options, backend=self.value_of("backend"))
        except (OSError, TypeError, ValueError) as error:
            self.get_logger().error(f"parameters: {error}")
            return TransitionCallbackReturn.FAILURE
        if self.options.ignored:
            self.get_logger().warning(f"parameters without effect: {', '.join(self.options.ignored)}")
        self.queue, self.dropped = ScanQueue(self.look_up, self.localize), 0
        self._publish_and_listen()
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to localise."""
        self.active = True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop to localise; the filter is kept."""
        self.active = False
        self.queue.clear()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free the filter, topics and services."""
        result = super().on_cleanup(state)
        self._release()
        return result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free the filter, topics and services."""
        result = super().on_shutdown(state)
        self._release()
        return result

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free all, so that the node can be configured anew."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def _publish_and_listen(self) -> None:
        """Create topics, services and timers, and keep how each is destroyed."""
        kept, map_topic, scan_topic = latched(), *self.options.topics
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.broadcaster = TransformBroadcaster(self)
        self.pose = self.create_lifecycle_publisher(PoseWithCovarianceStamped, "amcl_pose", kept)
        self.cloud = self.create_lifecycle_publisher(ParticleCloud, "particle_cloud", qos_profile_sensor_data)
        self.diagnostics = self.create_lifecycle_publisher(DiagnosticArray, "/diagnostics", 10)
        self._made = [(self.destroy_lifecycle_publisher, one) for one in (self.pose, self.cloud, self.diagnostics)]
        for kind, topic, callback, quality in (
            (OccupancyGrid, map_topic, self.localizer.set_map, kept),
            (LaserScan, scan_topic, self.on_scan, qos_profile_sensor_data),
            (PoseWithCovarianceStamped, "initialpose", self.on_initial_pose, 1),
        ):
            self._made.append((self.destroy_subscription, self.create_subscription(kind, topic, callback, quality)))
        service = self.create_service(Empty, "reinitialize_global_localization", self.on_reinitialize)
        self._made.append((self.destroy_service, service))
        # Scans wait by the wall's clock, as simulated time may stand.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        for period, callback in ((_LOOK, self.check_waiting), (1.0, self.publish_diagnostics)):
            self._made.append((self.destroy_timer, self.create_timer(period, callback, clock=steady)))

    def _release(self) -> None:
        self.active, self.localizer, self.reported = False, None, None
        for destroy, one in self._made:
            destroy(one)
        if self._made:
            self.listener.unregister()
        self._made = []

    # ------------------------------------------------------------------------------------------------------ callbacks

    def on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Begin around a pose that a user sets."""
        covariance = conversions.covariance_of(message.pose.covariance)
        self.localizer.start_at(conversions.pose_of(message.pose.pose), covariance)

    def on_reinitialize(self, request: Empty.Request, response: Empty.Response) -> Empty.Response:
        """Begin all over the map."""
        self.localizer.start_anywhere()
        self.get_logger().info("the filter starts all over the map")
        return response

    def on_scan(self, message: LaserScan) -> None:
        """Take a scan; it waits for its transforms."""
        if self.active:
            self.queue.add(message)
            self._report_dropped()

    def check_waiting(self) -> None:
        """Look whether the transforms of scans that wait have come."""
        if self.active and len(self.queue):
            self.queue.check()
            self._report_dropped()

    def _report_dropped(self) -> None:
        if self.queue.dropped > self.dropped:
            self.dropped = self.queue.dropped
            self.get_logger().warning(f"a scan is skipped: {self.queue.reason}", throttle_duration_sec=2.0)

    def look_up(self, message: LaserScan) -> tuple[conversions.Pose, conversions.Pose]:
        """Return the poses of the base in the odometry frame at a scan's stamp, and of the laser on the base.

        Raises:
            NotYetError: they are not known yet.
        """
        _, odometry_frame, base = self.options.frames
        try:
            laser = self.buffer.lookup_transform(base, message.header.frame_id, Time())
            odometry = self.buffer.lookup_transform(odometry_frame, base, Time.from_msg(message.header.stamp))
        except TransformException as error:
            raise NotYetError(str(error)) from error
        return conversions.transform_of(odometry.transform), conversions.transform_of(laser.transform)

    def localize(self, message: LaserScan, transforms: tuple[conversions.Pose, conversions.Pose]) -> None:
        """Localise with a scan, and publish the results."""
        if self.localizer.update(message, *transforms):
            self.publish_estimate(message)
        problem = self.localizer.problem
        if problem is not None and problem != self.reported:
            self.get_logger().error(f"a scan is skipped, as are others like it: {problem}")
            self.reported = problem
        if self.localizer.estimate is not None and self.options.tf_broadcast:
            self.publish_transform(message)

    # ------------------------------------------------------------------------------------------------------- messages

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

    def publish_diagnostics(self) -> None:
        """Publish how the filter fares."""
        if self.active:
            fields = self.localizer.status(self.queue.dropped, self.queue.reason)
            self.diagnostics.publish(diagnostic_array(fields, self.get_clock().now().to_msg()))


def main() -> int:
    """Run the node; with the parameter ``autostart_node`` it configures and activates itself."""
    rclpy.init()
    node = LocalizationNode()
    try:
        if node.value_of("autostart_node"):
            for trigger in (node.trigger_configure, node.trigger_activate):
                if trigger() != TransitionCallbackReturn.SUCCESS:
                    return 1
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
