"""Localise from scans, odometry and a map, and publish pose, particle cloud and transform from map to odometry.

It is a lifecycle node with the topics, frames and parameters of nav2_amcl.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Pose as PoseMessage
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid as MapMessage
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Empty

from gpusense.logs.records import Pose, planar, pose_fields, transform_fields
from gpusense.logs.transform_buffer import BACK
from gpusense.ros import conversions
from gpusense.ros.conversions import defaults, mount_of, options_of
from gpusense.ros.localizer import Localizer
from gpusense.ros.nodes.wiring import Guard, TFMessage, Transforms, diagnostic_array, latched, run, unreliable
from gpusense.ros.pacing import Losses, Rest, ScanQueue
from gpusense.world.grid import OccupancyGrid
from gpusense.world.map_files import read_map
from gpusense.world.messages import stamp_of

try:
    from nav2_msgs.msg import Particle, ParticleCloud
except ImportError:
    Particle, ParticleCloud = None, None

# Interval between checks of waiting scans [s].
_LOOK = 0.1
# Scans that wait in the middleware while the node is busy.
_DEPTH = 50


class LocalizationNode(LifecycleNode):
    """Monte Carlo localisation with gpusense."""

    def __init__(self) -> None:
        super().__init__("amcl", automatically_declare_parameters_from_overrides=True)
        for name, value in defaults().items():
            if not self.has_parameter(name):
                self.declare_parameter(name, value, ParameterDescriptor(dynamic_typing=True))
        self.full_name = self.get_fully_qualified_name().lstrip("/")
        self.guard = Guard(self.get_logger())
        self.active = False
        self._made: list[tuple[Callable[[Any], Any], Any]] = []

    def start(self) -> bool:
        """Configure and activate the node, if the parameter ``autostart_node`` is set; return whether it succeeded."""
        if not self.get_parameter("autostart_node").value:
            return True
        triggers = (self.trigger_configure, self.trigger_activate)
        return all(trigger() == TransitionCallbackReturn.SUCCESS for trigger in triggers)

    # -------------------------------------------------------------------------------------------------- the lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, compile, and listen for the map, a first pose and transforms."""
        try:
            self._configure({name: each.value for name, each in self.get_parameters_by_prefix("").items()})
            return super().on_configure(state)
        except Exception as error:
            self.guard.report("configure", error)
            self._release()
            return TransitionCallbackReturn.FAILURE

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start localising."""
        self.active = True
        self.localizer.begin()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop localising, and keep the filter."""
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
        """Free everything, so that the node can be reconfigured."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def _configure(self, values: dict[str, Any]) -> None:
        self.options, without = options_of(values)
        if without:
            self.get_logger().warning(f"parameters without effect: {', '.join(without)}")
        self.localizer = Localizer(self.options, backend=values["backend"], seed=values["seed"], risk=values["risk"])
        if values["map_file"]:
            self.localizer.set_map(read_map(values["map_file"]))
        begin = time.perf_counter()
        self.get_logger().info(f"compiling for {values['backend']}, which takes long the first time")
        self.localizer.warm_up()
        self.get_logger().info(f"compiled for {values['backend']} in {time.perf_counter() - begin:.1f} s")
        self.queue = ScanQueue(self.look_up, self.localize, patience=float(values["scan_patience"]))
        self.restarts = values["restart_after_jump"]
        self.received = self.lost = self.dropped = 0
        self.losses = Losses()
        self.rest, self.unshown = Rest(), False
        self.stamp = -float("inf")
        self.map_reason: str | None = None
        self._listen(values)
        self._publish()

    def _listen(self, values: dict[str, Any]) -> None:
        """Create subscriptions, the service and timers, and record their destructors."""
        self.transforms = Transforms(
            self.guard, self.options.frames[1:], values["odom_topic"], mount_of(values["mount"]), self.check_waiting,
            self.options.frames[0],
        )  # fmt: skip
        try:
            self.transforms.subscribe(self)
        finally:
            self._made += [(self.destroy_subscription, each) for each in self.transforms.subscriptions]
        map_topic, scan_topic = self.options.topics
        topics: list[tuple[Any, ...]] = [
            (LaserScan, scan_topic, self.on_scan, unreliable(_DEPTH)),
            (PoseWithCovarianceStamped, "initialpose", self.on_initial_pose, 1),
        ]
        if not values["map_file"]:
            topics.insert(0, (MapMessage, map_topic, self.on_map, latched()))
        for kind, topic, callback, profile in topics:
            events = SubscriptionEventCallbacks(incompatible_qos=self.on_map_quality) if kind is MapMessage else None
            take = self.guard.around("map" if kind is MapMessage else topic, callback)
            made = self.create_subscription(kind, topic, take, profile, event_callbacks=events)
            self._made.append((self.destroy_subscription, made))
        anywhere = "reinitialize_global_localization"
        service = self.create_service(Empty, anywhere, self.guard.around(anywhere, self.on_reinitialize))
        self._made.append((self.destroy_service, service))
        # Scans wait by wall clock, since simulated time may stop.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        for period, name, work in ((_LOOK, "scans", self.check), (1.0, "status", self.publish_diagnostics)):
            timer = self.create_timer(period, self.guard.around(name, work), clock=steady)
            self._made.append((self.destroy_timer, timer))

    def _publish(self) -> None:
        def add(*arguments: Any) -> Any:
            made = self.create_lifecycle_publisher(*arguments)
            self._made.append((self.destroy_lifecycle_publisher, made))
            return made

        self.pose = add(PoseWithCovarianceStamped, "amcl_pose", latched())
        self.cloud = add(ParticleCloud or PoseArray, "particle_cloud", qos_profile_sensor_data)
        self.diagnostics = add(DiagnosticArray, "/diagnostics", 10)
        has_broadcast = TFMessage is not None and self.options.tf_broadcast
        self.broadcaster: Any = add(TFMessage, "/tf", 100) if has_broadcast else None

    def _release(self) -> None:
        self.active = False
        self.guard.troubles.clear()
        made, self._made = self._made, []
        for destroy, each in made:
            destroy(each)

    # ------------------------------------------------------------------------------------------------------ callbacks

    def on_map(self, message: MapMessage) -> None:
        """Take a map; a bad one leaves the previous map."""
        self.localizer.set_map(OccupancyGrid.from_message(message))

    def on_map_quality(self, event: Any) -> None:
        """Report why a publisher's map does not arrive."""
        self.map_reason = (
            f"a publisher of {self.options.topics[0]} does not keep its map for late subscribers (its durability must "
            "be transient local)"
        )
        self.get_logger().warning(f"no map: {self.map_reason}")

    def on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Begin around a pose that a user sets."""
        self.localizer.start_at(*conversions.start_of(message, self.options.frames[0]))

    def on_reinitialize(self, request: Empty.Request, response: Empty.Response) -> Empty.Response:
        """Begin all over the map."""
        self.localizer.start_anywhere()
        self.get_logger().info("the filter starts all over the map")
        return response

    def on_scan(self, message: LaserScan, info: Any) -> None:
        """Queue a scan until its transforms are known."""
        lost = self.losses.take(info["publication_sequence_number"])
        if not self.active:
            return
        self.received, self.lost = self.received + 1, self.lost + lost
        self.queue.add(message, stamp_of("message", message))
        self._report_dropped()

    def check_waiting(self) -> None:
        """Check whether the transforms of waiting scans have arrived."""
        if self.active and len(self.queue):
            self.queue.check()
            self._report_dropped()

    def check(self) -> None:
        """Continue what waits: scans, and particles to publish."""
        self.check_waiting()
        if self.active and self.unshown:
            self.publish_cloud()

    def _report_dropped(self) -> None:
        if self.queue.dropped > self.dropped:
            self.dropped = self.queue.dropped
            self.get_logger().warning(f"a scan is skipped: {self.queue.reason}", throttle_duration_sec=2.0)

    def look_up(self, message: LaserScan) -> tuple[Pose, Any]:
        """Return the pose of the base in the odometry frame at a scan's stamp, and the laser's (4, 4) on the base."""
        self.transforms.take_waiting()
        laser = self.transforms.laser(message.header.frame_id)
        odometry = self.transforms.buffer.look_up(*self.options.frames[1:], stamp_of("message", message))
        return planar(odometry), laser

    def localize(self, message: LaserScan, transforms: tuple[Pose, Any]) -> None:
        """Localise with a scan, and publish the results."""
        stamp = stamp_of("message", message)
        if stamp < self.stamp - BACK:
            self.get_logger().warning(
                f"time went back from {self.stamp:.3f} s to {stamp:.3f} s", throttle_duration_sec=2.0
            )
            if self.restarts:
                self.localizer.start_again()
        self.stamp = stamp
        if self.localizer.update(message, *transforms):
            self.publish_estimate(message)
        if self.localizer.problem is not None:
            self.guard.report(self.options.topics[1], ValueError(self.localizer.problem))
        if self.localizer.estimate is not None and self.broadcaster is not None:
            self.publish_transform(message)

    # ------------------------------------------------------------------------------------------------------- messages

    def publish_estimate(self, scan: LaserScan) -> None:
        """Publish the pose and the particles."""
        estimate = self.localizer.estimate
        pose = PoseWithCovarianceStamped()
        pose.header.stamp, pose.header.frame_id = scan.header.stamp, self.options.frames[0]
        x, y, yaw = (float(value) for value in estimate.pose)
        conversions.fill(pose.pose.pose, pose_fields((x, y, yaw)))
        pose.pose.covariance = conversions.covariance_fields(estimate.covariance)
        self.pose.publish(pose)
        self.header, self.unshown = pose.header, True
        self.publish_cloud()

    def publish_cloud(self) -> None:
        """Publish the particles, with rests: their message costs more than a scan."""
        if not self.cloud.get_subscription_count() or not self.rest.over:
            return
        self.unshown = False
        with self.rest.after():
            particles = conversions.cloud_fields(*self.localizer.cloud())
            if ParticleCloud is None:
                cloud = PoseArray(header=self.header)
                cloud.poses = [conversions.fill(PoseMessage(), fields["pose"]) for fields in particles]
            else:
                cloud = ParticleCloud(header=self.header)
                cloud.particles = [conversions.fill(Particle(), fields) for fields in particles]
            self.cloud.publish(cloud)

    def publish_transform(self, scan: LaserScan) -> None:
        """Send the transform from the map to the odometry frame."""
        sent = TransformStamped()
        ahead = Time.from_msg(scan.header.stamp) + Duration(seconds=self.options.transform_tolerance)
        sent.header.stamp, sent.header.frame_id = ahead.to_msg(), self.options.frames[0]
        sent.child_frame_id = self.options.frames[1]
        conversions.fill(sent.transform, transform_fields(self.localizer.map_to_odometry()))
        self.broadcaster.publish(TFMessage(transforms=[sent]))

    def publish_diagnostics(self) -> None:
        """Publish the diagnostics of the filter."""
        if not self.active:
            return
        counts = {
            "received": self.received, "without transforms": self.queue.dropped,
            "lost before the callback": self.lost,
        }  # fmt: skip
        reason = self.map_reason if self.localizer.grid is None else self.queue.reason
        fields = self.localizer.status(counts, reason, self.full_name)
        fields = self.guard.into(fields)
        self.diagnostics.publish(diagnostic_array(fields, self.get_clock().now().to_msg()))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; with the parameter ``autostart_node`` it configures and activates itself."""
    return run(LocalizationNode, args)
