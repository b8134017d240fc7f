"""The command ``gpusense ros``: its options as arguments of ROS, and bad input, without ROS."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from support.command_line import error_of

from gpusense.commands import cli


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return the arguments passed to nodes, with a substitute for rclpy."""
    found: list[Any] = []
    rclpy = ModuleType("rclpy")
    rclpy.__spec__ = ModuleSpec("rclpy", None)
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    for name in ("localization", "watching"):
        module = ModuleType(name)
        module.main = lambda args, name=name: found.append((name, args)) or 0
        monkeypatch.setitem(sys.modules, f"gpusense.ros.nodes.{name}", module)
    return found


def parameters(args: list[str]) -> dict[str, str]:
    return dict(args[k + 1].split(":=", 1) for k, each in enumerate(args) if each == "-p")


def test_options_become_parameters(called: list[Any], tmp_path: Path) -> None:
    grid, file = tmp_path / "it's.yaml", tmp_path / "nav2_params.yaml"
    grid.write_text("")
    file.write_text("amcl: {ros__parameters: {max_particles: 900}}\n")
    argv = ["ros", "--map", str(grid), "--params-file", str(file), "--start", "1", "-2", "0.5", "--odom-topic", "odom",
            "--mount", "0.1", "0", "0", "--backend", "numpy", "--ros-args", "-r", "__ns:=/a"]  # fmt: skip
    assert cli.main(argv) == 0
    ((name, args),) = called
    doubled = str(grid).replace("'", "''")
    assert name == "localization" and args[1:4] == ["--ros-args", "--params-file", str(file)]
    assert args[-2:] == ["-r", "__ns:=/a"]
    assert parameters(args) == {
        "autostart_node": "true", "backend": "'numpy'", "map_file": f"'{doubled}'", "mount": "[0.1, 0.0, 0.0]",
        "odom_topic": "'odom'", "set_initial_pose": "true", "initial_pose.x": "1.0", "initial_pose.y": "-2.0",
        "initial_pose.yaw": "0.5",
    }  # fmt: skip


def test_a_file_of_fit_and_the_watching_node(called: list[Any], tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("beam_model: {}\n")
    assert cli.main(["ros", "--params-file", str(file), "--global", "--no-autostart"]) == 0
    assert cli.main(["ros", "watch", "--base-frame", "base_link"]) == 0
    (_, fitted), (name, watching) = called
    assert "--params-file" not in fitted
    assert parameters(fitted) == {"autostart_node": "false", "parameters": f"'{file}'", "set_initial_pose": "false"}
    assert name == "watching" and parameters(watching) == {"base_frame": "'base_link'"}


@pytest.mark.parametrize("more, text", [
    (["--start", "nan", "0", "0"], "must be a finite number"), (["--map", "no.yaml"], "no.yaml"),
    (["--params-file", "no.yaml"], "no.yaml"), (["watch", "--global"], "--global: must not come with watch"),
    (["--start", "0", "0", "0", "--global"], "not allowed with"), (["listen"], "invalid choice"),
])  # fmt: skip
def test_bad_input(more: list[str], text: str, called: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert text in error_of(["ros", *more], capsys) and not called


def test_without_ros(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "source a ROS installation" in error_of(["ros"], capsys)
