"""The environment of tests inside ROS 2: this one, or the one that ``.ci/ros`` makes."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

import pytest
from support.selection import required

import gpusense

# Path of an environment that .ci/ros made.
VARIABLE = "GPUSENSE_ROS"
# The wheels of ROS start Python with these variables; they must not reach other environments.
BOOTSTRAP = ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")


def here() -> bool:
    """Return whether this Python can import ROS."""
    return importlib.util.find_spec("rclpy") is not None and importlib.util.find_spec("tf2_msgs") is not None


def need_ros() -> None:
    """Skip a module's tests where ROS cannot be imported."""
    if here():
        return
    elsewhere = os.environ.get(VARIABLE)
    reason = f"runs within {elsewhere}" if elsewhere else f"{VARIABLE} must name an environment that .ci/ros made"
    if required("ros") and not elsewhere:
        pytest.fail(reason)
    pytest.skip(reason, allow_module_level=True)


def environment() -> dict[str, str]:
    """Return the variables for the other environment to find this one's packages."""
    kept = {name: value for name, value in os.environ.items() if name not in BOOTSTRAP}
    folders = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    return kept | {"PYTHONPATH": os.pathsep.join([str(Path(gpusense.__file__).parents[1]), *folders])}
