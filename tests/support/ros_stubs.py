"""Stand-ins for the modules of ROS 2 that the example's nodes and its launch file import.

Messages have the fields of ROS 2 Humble by rosbags' definitions, and accept only rclpy's types.
"""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(get_types_from_msg("geometry_msgs/Pose pose\nfloat64 weight\n", "nav2_msgs/msg/Particle"))
STORE.register(get_types_from_msg("std_msgs/Header header\nParticle[] particles\n", "nav2_msgs/msg/ParticleCloud"))
BASES = {"string": str, "bool": bool, "octet": bytes, "byte": bytes, "float32": float, "float64": float}
DEFAULTS = {str: "", bool: False, bytes: b"\0", float: 0.0, int: 0}


class Message:
    """A message; an undefined field or a value of another type is an error, as in rclpy."""

    def __init__(self, kind: str, **values: Any) -> None:
        vars(self).update(kind=kind, types={})
        for name, (node, what) in STORE.get_msgdef(kind).fields:
            if node == 1:
                self.types[name] = BASES.get(what[0], int)
                default = DEFAULTS[self.types[name]]
            elif node == 2:
                self.types[name], default = Message, Message(what)
            else:
                length = what[1] if node == 3 else 0
                self.types[name], default = object, [0.0] * length
            vars(self)[name] = default
        for name, value in values.items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self.types:
            raise AttributeError(f"{self.kind} has no field {name}")
        if not isinstance(value, self.types[name]):
            raise AssertionError(f"{self.kind}.{name} must be {self.types[name].__name__}, got {value!r}")
        vars(self)[name] = value


def message_class(kind: str) -> type:
    """Return the class of a kind of message."""

    class Of(Message):
        def __init__(self, **values: Any) -> None:
            super().__init__(kind, **values)

    return Of


class Time:
    """Stand-in for rclpy.time.Time."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds
        self.nanoseconds = round(seconds * 1e9)

    @classmethod
    def from_msg(cls, stamp: Any) -> Time:
        return cls(stamp.sec + 1e-9 * stamp.nanosec)

    def to_msg(self) -> Message:
        sec, nanosec = divmod(self.nanoseconds, 10**9)
        return Message("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def __add__(self, other: Any) -> Time:
        return Time(self.seconds + other.seconds)


class TransformError(Exception):
    """Stand-in for tf2_ros.TransformException."""


class Buffer:
    """Stand-in for tf2_ros.Buffer, with a fixed mount and odometry at some times."""

    mount: ClassVar[tuple[float, float, float]] = (0.1, 0.0, 0.0)

    def __init__(self) -> None:
        self.odometry: dict[float, tuple[float, float, float]] = {}

    def lookup_transform(self, target: str, source: str, time: Time) -> Any:
        if (target, source) == ("base_footprint", "laser"):
            return transform_message(self.mount)
        if (target, source) != ("odom", "base_footprint"):
            raise TransformError(f"{target} and {source} are not connected")
        if time.seconds not in self.odometry:
            raise TransformError(f"no odometry at {time.seconds:g} s")
        return transform_message(self.odometry[time.seconds])


def transform_message(pose: tuple[float, float, float]) -> Message:
    """Return geometry_msgs/TransformStamped of a pose whose heading is 0."""
    sent = Message("geometry_msgs/msg/TransformStamped")
    sent.transform.translation.x, sent.transform.translation.y = pose[:2]
    sent.transform.rotation.w = 1.0
    return sent


class Publisher:
    """A publisher; one of a lifecycle node publishes only while the node is active."""

    def __init__(self, topic: str, *, enabled: bool) -> None:
        self.topic, self.enabled, self.sent = topic, enabled, []

    def publish(self, message: Any) -> None:
        if self.enabled:
            self.sent.append(message)

    def get_subscription_count(self) -> int:
        return 1


class Node:
    """Stand-in for rclpy.node.Node; ``made`` holds the created objects by topic, service or period."""

    given: ClassVar[dict[str, Any]] = {}

    def __init__(self, name: str) -> None:
        self.name, self.parameters, self.made, self.logged = name, {}, {}, []

    def declare_parameter(self, name: str, value: Any) -> Any:
        self.parameters[name] = SimpleNamespace(value=self.given.get(name, value))
        return self.parameters[name]

    def get_parameter(self, name: str) -> Any:
        return self.parameters[name]

    def create_publisher(self, kind: Any, topic: str, quality: Any) -> Publisher:
        return self.made.setdefault(topic, Publisher(topic, enabled=True))

    def create_subscription(self, kind: Any, topic: str, callback: Any, quality: Any) -> Any:
        return self.made.setdefault(topic, SimpleNamespace(topic=topic, call=callback))

    def create_service(self, kind: Any, name: str, callback: Any) -> Any:
        return self.made.setdefault(name, SimpleNamespace(topic=name, call=callback))

    def create_timer(self, period: float, callback: Any, clock: Any = None) -> Any:
        return self.made.setdefault(period, SimpleNamespace(topic=period, call=callback))

    def destroy(self, one: Any) -> None:
        assert self.made.pop(one.topic) is one

    destroy_publisher = destroy_subscription = destroy_service = destroy_timer = destroy

    def destroy_node(self) -> None:
        self.made.clear()

    def get_logger(self) -> Any:
        def keep(level: str) -> Any:
            return lambda text, **_: self.logged.append((level, text))

        return SimpleNamespace(info=keep("info"), warning=keep("warning"), error=keep("error"))

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: Time(100.0))


class LifecycleNode(Node):
    """Stand-in for rclpy.lifecycle.LifecycleNode that raises exceptions of a transition."""

    state = "unconfigured"

    def create_lifecycle_publisher(self, kind: Any, topic: str, quality: Any) -> Publisher:
        return self.made.setdefault(topic, Publisher(topic, enabled=False))

    destroy_lifecycle_publisher = Node.destroy

    def _switch(self, state: Any, *, enabled: bool = False) -> str:
        for one in self.made.values():
            if isinstance(one, Publisher):
                one.enabled = enabled
        return "success"

    on_configure = on_deactivate = on_cleanup = on_shutdown = _switch

    def on_activate(self, state: Any) -> str:
        return self._switch(state, enabled=True)

    def trigger(self, name: str, before: str, after: str) -> str:
        assert self.state == before
        result = getattr(self, f"on_{name}")(self.state)
        self.state = after if result == "success" else before
        return result

    def trigger_configure(self) -> str:
        return self.trigger("configure", "unconfigured", "inactive")

    def trigger_activate(self) -> str:
        return self.trigger("activate", "inactive", "active")

    def trigger_deactivate(self) -> str:
        return self.trigger("deactivate", "active", "inactive")

    def trigger_cleanup(self) -> str:
        return self.trigger("cleanup", "inactive", "unconfigured")


class Recorded:
    """An object of a launch file that only holds its arguments."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.arguments, self.options = arguments, options


def _messages() -> dict[str, dict[str, Any]]:
    names = {
        "diagnostic_msgs": ("DiagnosticArray", "DiagnosticStatus", "KeyValue"),
        "geometry_msgs": ("PoseWithCovarianceStamped", "TransformStamped"),
        "nav2_msgs": ("Particle", "ParticleCloud"),
        "nav_msgs": ("OccupancyGrid",),
        "sensor_msgs": ("LaserScan",),
    }
    return {
        f"{package}.msg": {name: message_class(f"{package}/msg/{name}") for name in kinds}
        for package, kinds in names.items()
    }


def _modules() -> dict[str, dict[str, Any]]:
    """Return the modules' names and contents."""
    codes = SimpleNamespace(SUCCESS="success", FAILURE="failure", ERROR="error")
    broadcaster = type("Broadcaster", (), {"__init__": lambda self, node: setattr(self, "sent", []),
                                           "sendTransform": lambda self, one: self.sent.append(one)})  # fmt: skip
    listener = type("Listener", (Recorded,), {"unregister": lambda self: None})
    launch = {
        "launch": ("LaunchDescription",), "launch.actions": ("DeclareLaunchArgument",),
        "launch.conditions": ("IfCondition",), "launch.substitutions": ("LaunchConfiguration",),
        "launch_ros.actions": ("LifecycleNode", "Node"), "launch_ros.parameter_descriptions": ("ParameterValue",),
    }  # fmt: skip
    return _messages() | {
        "rclpy": {"init": lambda: None, "spin": lambda node: None, "try_shutdown": lambda: None},
        "rclpy.clock": {"Clock": Recorded, "ClockType": SimpleNamespace(STEADY_TIME=2)},
        "rclpy.duration": {"Duration": SimpleNamespace},
        "rclpy.lifecycle": {
            "LifecycleNode": LifecycleNode, "LifecycleState": str, "TransitionCallbackReturn": codes,
        },
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {
            "QoSProfile": Recorded, "qos_profile_sensor_data": Recorded(),
            "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL=1), "ReliabilityPolicy": SimpleNamespace(RELIABLE=1),
        },
        "rclpy.time": {"Time": Time},
        "std_srvs.srv": {"Empty": SimpleNamespace(Request=object, Response=object)},
        "tf2_ros": {
            "Buffer": Buffer, "TransformBroadcaster": broadcaster, "TransformException": TransformError,
            "TransformListener": listener,
        },
        "ament_index_python.packages": {"get_package_share_directory": lambda name: f"/share/{name}"},
    } | {name: {each: type(each, (Recorded,), {}) for each in kinds} for name, kinds in launch.items()}  # fmt: skip


def install(monkeypatch: Any) -> None:
    """Put the stand-ins among the imported modules."""
    for name, contents in _modules().items():
        package, _, rest = name.partition(".")
        for each in filter(None, (package, rest and name)):
            if each not in sys.modules or each == name:
                monkeypatch.setitem(sys.modules, each, ModuleType(each))
        vars(sys.modules[name]).update(contents)
