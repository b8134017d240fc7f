"""A robot for tests inside ROS 2: it plays recordings, sends messages, and starts nodes as processes."""

from __future__ import annotations

import importlib
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

import gpusense as gs

# Longest wait for a condition, even on a busy machine [s].
PATIENCE = 90.0
COUNT = 90
TIMES = {"CONFIGURE": Transition.TRANSITION_CONFIGURE, "ACTIVATE": Transition.TRANSITION_ACTIVATE,
         "DEACTIVATE": Transition.TRANSITION_DEACTIVATE, "CLEANUP": Transition.TRANSITION_CLEANUP}  # fmt: skip


# A room with a wall in it, 4 m wide.
CELLS = np.zeros((40, 40), np.int8)
CELLS[[0, -1]] = CELLS[:, [0, -1]] = CELLS[:12, 25] = 100


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    """Return the first true value of a condition; fail without one."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError(f"waited {PATIENCE:g} s for {what}")


def latched() -> QoSProfile:
    return QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Node:
    """A process that runs a node."""

    def __init__(self, log: Path, *arguments: str, without: str = "", **environment: str) -> None:
        start = "from gpusense.commands.cli import main; import sys; sys.exit(main())"
        if without:
            start = f"import sys; sys.modules[{without!r}] = None; {start}"
        self.log = log
        with log.open("w") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-c", start, *arguments], stdout=file, stderr=subprocess.STDOUT,
                env=os.environ | environment,
            )  # fmt: skip

    def text(self) -> str:
        return self.log.read_text(errors="replace")

    def says(self, text: str) -> None:
        wait_for(lambda: text in self.text() or self.process.poll() is not None, f"{text!r} in {self.text()}")
        assert text in self.text(), self.text()

    def alive(self) -> bool:
        return self.process.poll() is None

    def stop(self, number: int = signal.SIGINT) -> int:
        """Send a signal, and return the exit code."""
        self.process.send_signal(number)
        return self.process.wait(PATIENCE)


@contextmanager
def started(log: Path, *arguments: str, **more: str) -> Iterator[Node]:
    """Start ``gpusense ros`` with arguments, and end it."""
    node = Node(log, "ros", *arguments, **more)
    try:
        yield node
    finally:
        node.process.kill()
        node.process.wait()


class Robot:
    """A node spun in a thread; ``got`` holds received messages by topic."""

    def __init__(self, namespace: str = "") -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("robot", context=self.context, namespace=namespace)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.got: dict[str, list[Any]] = {}
        self.publishers: dict[str, Any] = {}
        self.thread = threading.Thread(target=self._spin, daemon=True)
        self.thread.start()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self.executor.spin()

    def close(self) -> None:
        rclpy.shutdown(context=self.context)
        self.thread.join()
        self.node.destroy_node()

    def listen(self, kind: Any, topic: str, quality: Any = 100) -> list[Any]:
        if topic not in self.got:
            kept = self.got[topic] = []
            self.node.create_subscription(kind, topic, kept.append, quality)
        return self.got[topic]

    def poses(self) -> list[Any]:
        """Return the node's poses, with the last one from before the first call."""
        return self.listen(PoseWithCovarianceStamped, "amcl_pose", latched())

    def publisher(self, kind: Any, topic: str, quality: Any = 100) -> Any:
        if topic not in self.publishers:
            self.publishers[topic] = self.node.create_publisher(kind, topic, quality)
        return self.publishers[topic]

    def connected(self, *topics: str, listeners: int = 1) -> None:
        """Wait until nodes listen to topics that were published."""
        for topic in topics:
            wait_for(lambda t=topic: self.publishers[t].get_subscription_count() >= listeners, f"listeners of {topic}")

    def change(self, name: str, node: str = "amcl") -> bool:
        """Trigger a transition of a lifecycle node; return whether it succeeded."""
        client = self.node.create_client(ChangeState, f"{node}/change_state")
        assert client.wait_for_service(PATIENCE)
        future = client.call_async(ChangeState.Request(transition=Transition(id=TIMES[name])))
        wait_for(future.done, f"the transition {name}")
        return bool(future.result().success)

    def state(self, node: str = "amcl") -> str:
        client = self.node.create_client(GetState, f"{node}/get_state")
        assert client.wait_for_service(PATIENCE)
        future = client.call_async(GetState.Request())
        wait_for(future.done, "the state")
        return str(future.result().current_state.label)

    def status(
        self, ends: str, condition: Callable[[Any], Any], send: Callable[[], Any] | None = None, pause: float = 0.2
    ) -> Any:
        """Return the next diagnostic status of a name that meets a condition; send messages until it comes."""
        kept = self.listen(DiagnosticArray, "/diagnostics")
        del kept[:]
        last = -math.inf

        def found() -> Any:
            nonlocal last
            if send is not None and time.monotonic() - last > pause:
                last = time.monotonic()
                send()
            return next((one for one in seen() if condition(one)), None)

        def seen() -> list[Any]:
            return [one for array in list(kept) for one in array.status if one.name.endswith(ends)]

        try:
            return wait_for(found, f"a status of {ends}")
        except AssertionError as error:
            raise AssertionError(f"{error}; {[(one.name, one.message) for one in seen()[-3:]]}") from None

    # ------------------------------------------------------------------------------------------------------ messages

    def stamp(self, message: Any, time: float, frame: str = "") -> Any:
        message.header.stamp.sec, message.header.frame_id = math.floor(time), frame
        message.header.stamp.nanosec = round((time - math.floor(time)) * 1e9)
        return message

    def transform(self, time: float, parent: str, child: str, x: float, static: bool = False) -> None:
        one = self.stamp(TransformStamped(child_frame_id=child), time, parent)
        one.transform.translation.x, one.transform.rotation.w = x, 1.0
        topic = "/tf_static" if static else "/tf"
        self.publisher(TFMessage, topic, latched() if static else 100).publish(TFMessage(transforms=[one]))

    def odometry(self, time: float, x: float) -> None:
        one = self.stamp(Odometry(child_frame_id="base"), time, "odom")
        one.pose.pose.position.x, one.pose.pose.orientation.w = x, 1.0
        self.publisher(Odometry, "odom").publish(one)

    def scan(self, time: float, x: float = 1.0, **changes: Any) -> None:
        """Publish the scan of a laser 0.1 m before a robot at (x, 1.3) in the room."""
        one = self.stamp(LaserScan(range_min=0.05, range_max=8.0), time, "laser")
        one.angle_min, one.angle_increment = -math.pi, 2 * math.pi / COUNT
        bearings = -math.pi + 2 * math.pi / COUNT * np.arange(COUNT)
        caster = gs.RayCaster(gs.OccupancyGrid(CELLS, 0.1), range_max=8.0, backend="numpy")
        one.ranges = caster.cast([(x + 0.1, 1.3, 0.0)], bearings)[0].astype(np.float32).tolist()
        for name, value in changes.items():
            setattr(one, name, value)
        self.last = one
        self.publisher(LaserScan, "scan").publish(one)

    def initial_pose(self, x: float, variance: float = 0.01, frame: str = "map", topic: str = "initialpose",
                     time: float = 0.0) -> PoseWithCovarianceStamped:  # fmt: skip
        one = self.stamp(PoseWithCovarianceStamped(), time, frame)
        one.pose.pose.position.x, one.pose.pose.position.y, one.pose.pose.orientation.w = x, 1.3, 1.0
        covariance = np.zeros((6, 6))
        covariance[[0, 1, 5], [0, 1, 5]] = variance
        one.pose.covariance = covariance.ravel().tolist()
        self.publisher(PoseWithCovarianceStamped, topic).publish(one)
        return one

    def map(self, **changes: Any) -> None:
        """Publish the room."""
        self.publisher(OccupancyGrid, "map", latched()).publish(self.map_message(**changes))

    def map_message(self, **changes: Any) -> OccupancyGrid:
        one = OccupancyGrid()
        one.info.width = one.info.height = 40
        one.info.resolution, one.info.origin.orientation.w = 0.1, 1.0
        one.data = CELLS.ravel().tolist()
        for name, value in changes.items():
            setattr(one if name == "data" else one.info, name, value)
        return one

    def drive(self, times: Any, first: float = 0.0) -> None:
        """Publish transforms and scans of a robot that drives 0.1 m from scan to scan."""
        for k, each in enumerate(times):
            self.transform(each, "odom", "base_footprint", first + 0.1 * k)
            self.scan(each, 1.0 + first + 0.1 * k)


def play(robot: Robot, folder: Path, rate: float, skip: tuple[str, ...] = (), most: int = 40) -> int:
    """Play a bag of ROS 2 at a rate, and return the number of its scans.

    Playing waits while ``most`` scans have no pose yet, as on a busy machine.
    """
    from rosbags.rosbag2 import Reader

    with Reader(folder) as reader:
        kinds = {each.topic: each.msgtype.split("/") for each in reader.connections if each.topic not in skip}
        for topic, (package, _, name) in kinds.items():
            kind = getattr(importlib.import_module(f"{package}.msg"), name)
            robot.publisher(kind, topic, latched() if topic == "/tf_static" else 100)
        robot.connected(*(topic for topic in kinds if topic != "/odom"))
        begin, first, scans = time.monotonic(), None, 0
        for connection, stamp, raw in reader.messages():
            if connection.topic not in kinds:
                continue
            first = stamp if first is None else first
            time.sleep(max(0.0, begin + (stamp - first) * 1e-9 / rate - time.monotonic()))
            wait_for(lambda sent=scans: sent - len(robot.poses()) < most, "poses")
            robot.publishers[connection.topic].publish(bytes(raw))
            scans += kinds[connection.topic][2] == "LaserScan"
    return scans
