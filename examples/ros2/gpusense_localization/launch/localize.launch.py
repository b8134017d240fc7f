"""Start the localiser, and on request the node that watches it.

ros2 launch gpusense_localization localize.launch.py parameters:=FILE backend:=opencl watch:=true
"""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = "gpusense_localization"
ARGUMENTS = {
    "parameters": (str, None, "parameters of nav2_amcl, or parameters.yaml of gpusense fit"),
    "node": (str, "", "which of several amcl nodes of the file, such as /robot1/amcl"),
    "backend": (str, "auto", "the device of gpusense"),
    "namespace": (str, "", "namespace of the nodes"),
    "use_sim_time": (bool, "false", "whether time comes from /clock"),
    "autostart": (bool, "true", "whether the node configures and activates itself; false for a lifecycle manager"),
    "watch": (bool, "false", "whether the watching node runs beside"),
    "base_frame": (str, "base_footprint", "frame of the robot's base, for the watching node"),
}


def generate_launch_description() -> LaunchDescription:
    """Return what ``ros2 launch`` runs."""
    own = str(Path(get_package_share_directory(PACKAGE)) / "config" / "amcl.yaml")
    values = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind) for name, (kind, _, _) in ARGUMENTS.items()
    }
    common = {name: values[name] for name in ("backend", "use_sim_time")}
    namespace = LaunchConfiguration("namespace")
    localize = LifecycleNode(
        package=PACKAGE, executable="localize", name="amcl", namespace=namespace, output="screen",
        parameters=[common | {
            "parameters": values["parameters"], "node": values["node"], "autostart_node": values["autostart"],
        }],
    )  # fmt: skip
    watch = Node(
        package=PACKAGE, executable="watch", name="localization_watch", namespace=namespace, output="screen",
        parameters=[common | {"base_frame": values["base_frame"]}], condition=IfCondition(LaunchConfiguration("watch")),
    )  # fmt: skip
    declared = [
        DeclareLaunchArgument(name, default_value=own if default is None else default, description=text)
        for name, (_, default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, localize, watch])
