"""Run ``gpusense ros``: a ROS 2 node that localises, or that watches another localiser."""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path
from typing import Any

from gpusense._util import checks
from gpusense._util.documents import read_mapping
from gpusense.commands.arguments import Options, finite_number, refuse
from gpusense.localization.nav2_file import FITTED

FIRST = ("map", "params_file", "start", "anywhere", "odom_topic")
SHARED = ("backend",)
CODES = {0: "interrupted or terminated", 1: "the node could not start (its log has the reason)"}

_ROS = "--ros-args"

EPILOG = """\
Topics, frames and parameters equal nav2_amcl's: the node reads scan, map, initialpose and /tf, and writes amcl_pose,
particle_cloud, the transform from map to odom and /diagnostics (docs/ros2.md). It is a lifecycle node called amcl, and
starts active.

'gpusense ros watch' judges the poses of nav2_amcl, or of any node that publishes amcl_pose, and writes /diagnostics.

Options of ROS 2 follow --ros-args: remappings, namespaces and parameters, as for every node.

examples:
  gpusense ros --map map.yaml --params-file nav2_params.yaml
  gpusense ros --map map.yaml --start 1 2 0 --ros-args -p use_sim_time:=true
  gpusense ros --global --ros-args -r __ns:=/robot1 -r /tf:=tf \\
      -r /tf_static:=tf_static
  gpusense ros --odom-topic odom --mount 0.2 0 0
  gpusense ros watch --base-frame base_link"""


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("watch", "judge the poses of another localiser (default: localise)", ("localize", "watch"), "localize",
        nargs="?", dest="what")  # fmt: skip
    add("--map YAML", "a map_server map (default: the topic map)", Path)
    add("--params-file YAML", "parameters of nav2_amcl, as nav2_params.yaml has them, or parameters.yaml of "
        "'gpusense fit'", Path)  # fmt: skip
    with add.exclusive():
        add("--start X Y THETA", "first pose [m, m, rad]", finite_number)
        add("--global", "start all over the map", dest="anywhere")
    add("--mount X Y THETA", "pose of the laser on the robot [m, m, rad] (default: by /tf)", finite_number)
    add("--odom-topic TOPIC", "read odometry from nav_msgs/Odometry (default: by /tf)")
    add("--base-frame FRAME", "frame of the robot's base (default: base_footprint)")
    add("--no-autostart", "leave it to a lifecycle manager to configure and activate")
    add(f"{_ROS} ARGUMENT", "arguments of ROS 2", default=[], nargs=argparse.REMAINDER)


def run(args: argparse.Namespace) -> int:
    """Run the node until it is interrupted or terminated."""
    chosen = _localize(args) if args.what == "localize" else _watch(args)
    if importlib.util.find_spec("rclpy") is None:
        raise ValueError(
            "gpusense ros: must run where rclpy can be imported: source a ROS installation, or on Linux (x86-64) "
            "pip install 'gpusense[ros2]'"
        )
    ros: list[str] = [_ROS]
    if args.params_file is not None and "parameters" not in chosen:
        ros += ["--params-file", str(args.params_file)]
    for name, value in chosen.items():
        ros += ["-p", f"{name}:={_yaml(value)}"]
    if args.what == "localize":
        from gpusense.ros.nodes.localization import main
    else:
        from gpusense.ros.nodes.watching import main
    # The user's arguments come last, and take precedence.
    return main(["gpusense", *ros, *args.ros_args])


def _localize(args: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters of the localising node."""
    chosen: dict[str, Any] = {"autostart_node": not args.no_autostart} | _common(args)
    if args.base_frame is not None:
        chosen["base_frame_id"] = args.base_frame
    if args.odom_topic is not None:
        chosen["odom_topic"] = args.odom_topic
    if args.params_file is not None and any(key in read_mapping(args.params_file) for key in FITTED):
        chosen["parameters"] = args.params_file
    if args.anywhere:
        chosen["set_initial_pose"] = False
    if args.start is not None:
        chosen["set_initial_pose"] = True
        chosen |= {f"initial_pose.{name}": value for name, value in zip(("x", "y", "yaw"), args.start, strict=True)}
    return chosen


def _watch(args: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters of the watching node."""
    refuse(args, ("start", "anywhere", "odom_topic", "no_autostart"), "must not come with watch")
    return _common(args) | ({} if args.base_frame is None else {"base_frame": args.base_frame})


def _common(args: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters of either node."""
    chosen: dict[str, Any] = {} if args.backend == "auto" else {"backend": args.backend}
    if args.map is not None:
        chosen["map_file"] = checks.existing_file(args.map)
    if args.mount is not None:
        chosen["mount"] = args.mount
    return chosen


def _yaml(value: Any) -> str:
    """Return a parameter's value as YAML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (str, Path)):
        return "'" + str(value).replace("'", "''") + "'"
    return str(value)
