"""The tests of this folder in the environment that has ROS 2."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from support.paths import TESTS
from support.ros_environment import VARIABLE, environment, here
from support.selection import skip_or_fail


def test_the_nodes_run_inside_ros(tmp_path: Path) -> None:
    place = os.environ.get(VARIABLE)
    if here():
        pytest.skip("this environment has ROS: the other files run in it")
    if not place:
        skip_or_fail("ros", f"{VARIABLE} must name an environment that .ci/ros made")
    command = [f"{place}/bin/python", "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0",
               f"--basetemp={tmp_path / 'inside'}", str(TESTS / "ros"), "-m", "", "-k", "inside"]  # fmt: skip
    done = subprocess.run(
        command, env=environment() | {"PYTEST_ADDOPTS": ""}, cwd=TESTS.parent, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert " passed" in done.stdout
