"""Parts of ROS for both nodes: guards around callbacks, transforms, messages, and process lifetime."""

from __future__ import annotations

import functools
import math
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import rclpy
import rclpy.logging
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from gpusense.logs.records import Pose, planar_mount
from gpusense.logs.transform_buffer import TransformBuffer
from gpusense.ros.conversions import ERROR, odometry_fields, pose_matrix
from gpusense.world.messages import LEVEL

try:
    from tf2_msgs.msg import TFMessage as TFMessage
except ImportError:
    TFMessage = None

# Time to keep moving transforms [s]: a busy node may lag behind a recording that plays faster.
_CACHE = 30.0
# Messages of moving transforms, and of odometry, that wait in the middleware while the node is busy.
_DEPTH = 1000
# Least time between log lines about a subject [s].
_QUIET = 2.0


def latched() -> QoSProfile:
    """Return the quality of service of topics that send their last message to newcomers."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)


def unreliable(depth: int) -> QoSProfile:
    """Return the quality of service of sensors, with a longer queue."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


def waiting(subscription: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the messages that wait at a subscription, each with its info, at most 1000.

    The executor takes one message of each topic in a round, so frequent topics lag behind costly callbacks.
    """
    with subscription.handle:
        for _ in range(_DEPTH):
            taken = subscription.handle.take_message(subscription.msg_type, False)
            if taken is None:
                return
            yield taken


def diagnostic_array(fields: dict[str, Any], stamp: Any) -> DiagnosticArray:
    """Return the message of one status."""
    status = DiagnosticStatus(name=fields["name"], hardware_id=fields["hardware_id"], message=fields["message"])
    status.level = bytes([fields["level"]])
    status.values = [KeyValue(**pair) for pair in fields["values"]]
    array = DiagnosticArray(status=[status])
    array.header.stamp = stamp
    return array


class Guard:
    """Guard that lets a callback fail without ending the node; errors are logged, and kept in ``troubles``."""

    def __init__(self, log: Any) -> None:
        self.log = log
        self.troubles: dict[str, str] = {}
        self._logged: dict[str, tuple[str, float]] = {}

    def around(self, subject: str, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return a callback with a guard around it; a failing service returns its response."""

        @functools.wraps(callback)
        def run(*arguments: Any) -> Any:
            try:
                result = callback(*arguments)
            except Exception as error:
                self.report(subject, error)
                return arguments[1] if len(arguments) > 1 else None
            self.troubles.pop(subject, None)
            return result

        return run

    def report(self, subject: str, error: Exception) -> None:
        """Log an error once, and at most one error per subject in 2 s."""
        text = described(error)
        self.troubles[subject] = text
        before, since = self._logged.get(subject, ("", -_QUIET))
        if text != before and time.monotonic() - since > _QUIET:
            self._logged[subject] = text, time.monotonic()
            self.log.error(f"{subject}: {text}")
            if not isinstance(error, (OSError, TypeError, ValueError)):
                self.log.debug("".join(traceback.format_exception(error)))

    def into(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Return the fields of a status with the errors, if there are any."""
        if not self.troubles:
            return fields
        texts = [f"{subject}: {text}" for subject, text in self.troubles.items()]
        return fields | {"level": ERROR, "message": "; ".join([*texts, fields["message"]])}


class Transforms:
    """Transforms of the robot, from ``/tf``, or odometry from ``nav_msgs/Odometry`` and the mount from a parameter.

    An empty topic ``odometry``, or None as ``mount`` (x, y, yaw), leaves it to ``/tf``. ``arrived`` is called after new
    transforms. Transforms from and to the frame ``apart``, of the map, do not count: localisers send them.
    """

    def __init__(
        self,
        guard: Guard,
        frames: tuple[str, str],
        odometry: str = "",
        mount: Pose | None = None,
        arrived: Callable[[], None] = lambda: None,
        apart: str = "",
    ) -> None:
        self.buffer, self.frames, self.guard, self.arrived = TransformBuffer(_CACHE), frames, guard, arrived
        self.odometry, self.mount, self.apart, self._warned = odometry, mount, apart.strip("/"), False
        self.subscriptions: list[Any] = []
        self._takers: list[Callable[[Any], None]] = []
        if TFMessage is None:
            self.mount, self.odometry = mount or (0.0, 0.0, 0.0), odometry or "odom"
            guard.log.warning(
                f"tf2_msgs cannot be imported: odometry is read from the topic {self.odometry}, the laser is taken to "
                f"be at {self.mount} on the robot (parameter mount), and no transform is sent"
            )

    def subscribe(self, node: Any) -> None:
        """Make the ``subscriptions`` of a node."""
        if TFMessage is not None:
            kept = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._listen(node, TFMessage, "/tf", QoSProfile(depth=_DEPTH), functools.partial(self._add, static=False))
            self._listen(node, TFMessage, "/tf_static", kept, functools.partial(self._add, static=True))
        if self.odometry:
            self._listen(node, Odometry, self.odometry, unreliable(_DEPTH), self._add_odometry)

    def _listen(self, node: Any, kind: Any, topic: str, quality: QoSProfile, take: Callable[[Any], None]) -> None:
        """Subscribe to a topic of transforms; ``take`` takes a message."""

        def run(message: Any) -> None:
            take(message)
            self.guard.around("scans", self.arrived)()

        self.subscriptions.append(node.create_subscription(kind, topic, run, quality))
        self._takers.append(take)

    def take_waiting(self) -> None:
        """Take the messages that wait in the middleware."""
        for subscription, take in zip(self.subscriptions, self._takers, strict=True):
            for message, _ in waiting(subscription):
                take(message)

    def laser(self, frame: str) -> np.ndarray:
        """Return the (4, 4) pose of a laser on the robot's base."""
        if self.mount is not None:
            return pose_matrix(self.mount)
        matrix = self.buffer.look_up(self.frames[1], frame)
        tilt = planar_mount(matrix)[2]
        if tilt > LEVEL and not self._warned:
            self._warned = True
            degrees = math.degrees(tilt)
            self.guard.log.warning(f"the laser {frame} is tilted by {degrees:.3g} deg; it is taken to be level")
        return matrix

    def _add(self, message: Any, static: bool) -> None:
        for each in message.transforms:
            if self.apart not in (each.header.frame_id.strip("/"), each.child_frame_id.strip("/")):
                self.guard.around("transforms", self.buffer.add)(each, static)

    def _add_odometry(self, message: Odometry) -> None:
        self.guard.around("odometry", self.buffer.add)(odometry_fields(message, self.frames))


def run(make: Callable[[], Any], args: Sequence[str] | None = None) -> int:
    """Run a node until it is interrupted or terminated; return the exit code, 1 if the node could not start.

    The optional method ``start`` of the node that ``make`` makes returns whether it can continue. ``args`` includes
    ``--ros-args``; ``sys.argv`` by default.
    """
    node = None
    try:
        try:
            rclpy.init(args=None if args is None else list(args))
            node = make()
        except Exception as error:
            rclpy.logging.get_logger("gpusense").error(described(error))
            return 1
        if not getattr(node, "start", lambda: True)():
            return 1
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def described(error: Exception) -> str:
    """Return an error's text, with its type unless the user caused it."""
    return str(error) if isinstance(error, (OSError, TypeError, ValueError)) else f"{type(error).__name__}: {error}"
