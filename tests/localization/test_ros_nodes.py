"""The nodes and the launch file of the example for ROS 2, with stand-ins for the modules of ROS."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import math
import re
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support import ros_stubs
from support.paths import ROOT

import gpusense as gs

PACKAGE = ROOT / "examples" / "ros2" / "gpusense_localization"
CODE = PACKAGE / "gpusense_localization"
COUNT = 40


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that imports a module of the example anew, beside the stand-ins."""
    ros_stubs.install(monkeypatch)
    monkeypatch.syspath_prepend(str(PACKAGE))
    ours = [name for name in sys.modules if name.partition(".")[0] == "gpusense_localization"]
    for name in ours:
        monkeypatch.delitem(sys.modules, name)
    yield lambda name: importlib.import_module(f"gpusense_localization.{name}")
    for name in [name for name in sys.modules if name.partition(".")[0] == "gpusense_localization"]:
        del sys.modules[name]


def map_message() -> Any:
    message = ros_stubs.Message("nav_msgs/msg/OccupancyGrid")
    info = message.info
    info.width, info.height, info.resolution, info.origin.orientation.w = 40, 40, 0.1, 1.0
    cells = np.zeros((40, 40), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = cells[:12, 25] = 100
    message.data = cells.ravel()
    return message


def scan_message(time: float, truth: tuple[float, float, float] = (1.0, 1.3, 0.0)) -> Any:
    """Return the scan of a laser 0.1 m before a robot in the map of ``map_message``."""
    message = ros_stubs.Message("sensor_msgs/msg/LaserScan", range_min=0.05, range_max=8.0)
    message.header.frame_id, message.header.stamp = "laser", ros_stubs.Time(time).to_msg()
    message.angle_min, message.angle_increment = -math.pi, 2 * math.pi / COUNT
    caster = gs.RayCaster(gs.OccupancyGrid.from_message(map_message()), range_max=8.0, backend="numpy")
    bearings = message.angle_min + message.angle_increment * np.arange(COUNT)
    message.ranges = caster.cast([(truth[0] + 0.1, truth[1], 0.0)], bearings)[0]
    return message


def initial_pose(x: float, y: float) -> Any:
    message = ros_stubs.Message("geometry_msgs/msg/PoseWithCovarianceStamped")
    pose = message.pose.pose
    pose.position.x, pose.position.y, pose.orientation.w = x, y, 1.0
    covariance = np.zeros((6, 6))
    covariance[[0, 1, 5], [0, 1, 5]] = 0.01
    message.pose.covariance = covariance.ravel()
    return message


def started(load: Any, monkeypatch: pytest.MonkeyPatch, **parameters: Any) -> Any:
    """Return an active node with a map and a first pose."""
    file = {"amcl": {"ros__parameters": {"sigma_hit": 0.1, "max_particles": 800, "update_min_d": 0.05}}}
    monkeypatch.setattr(ros_stubs.Node, "given", {"parameters": file, "backend": "numpy"} | parameters)
    node = load("node").LocalizationNode()
    assert node.trigger_configure() == "success" and node.trigger_activate() == "success"
    node.made["map"].call(map_message())
    node.made["initialpose"].call(initial_pose(1.0, 1.3))
    return node


def test_a_scan_waits_for_its_odometry(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    node = started(load, monkeypatch)
    poses = node.made["amcl_pose"].sent
    node.made["scan"].call(scan_message(1.0))
    assert not poses and len(node.queue) == 1
    node.buffer.odometry[1.0] = (0.0, 0.0, 0.0)
    node.made[0.01].call()
    assert len(poses) == 1 and len(node.queue) == 0 and node.queue.dropped == 0
    place = poses[0].pose.pose.position
    assert math.hypot(place.x - 1.0, place.y - 1.3) < 0.1
    assert poses[0].header.stamp.sec == 1 and poses[0].header.frame_id == "map"
    assert len(node.made["particle_cloud"].sent[0].particles) >= 500
    (sent,) = node.broadcaster.sent
    assert (sent.header.frame_id, sent.child_frame_id) == ("map", "odom") and sent.header.stamp.sec == 2
    assert sent.transform.translation.x == pytest.approx(place.x)


def test_the_lifecycle(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    node = started(load, monkeypatch)
    node.buffer.odometry = dict.fromkeys((1.0, 2.0), (0.0, 0.0, 0.0))
    diagnostics, poses = node.made["/diagnostics"], node.made["amcl_pose"]
    node.made["scan"].call(scan_message(9.0))
    assert node.trigger_deactivate() == "success" and len(node.queue) == 0
    node.made["scan"].call(scan_message(1.0))
    node.made[0.01].call()
    node.made[1.0].call()
    assert not poses.sent and not diagnostics.sent and not node.broadcaster.sent
    assert node.trigger_activate() == "success"
    node.made["scan"].call(scan_message(2.0))
    assert len(poses.sent) == 1
    node.trigger_deactivate()
    assert node.trigger_cleanup() == "success" and node.made == {} and node.localizer is None
    assert node.trigger_configure() == "success" and node.trigger_activate() == "success"
    assert "scan" in node.made


def test_bad_parameters_are_reported(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_stubs.Node, "given", {"parameters": {"z_hit": -1.0}})
    node = load("node").LocalizationNode()
    assert node.trigger_configure() == "failure" and node.made == {}
    ((level, text),) = node.logged
    assert level == "error" and "z_hit" in text
    monkeypatch.setattr(ros_stubs.Node, "given", {"parameters": {"z_hit": -1.0}, "autostart_node": True})
    assert load("node").main() == 1
    monkeypatch.setattr(ros_stubs.Node, "given", {"autostart_node": True})
    assert load("node").main() == 0


def test_the_filter_starts_anew_everywhere(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    node = started(load, monkeypatch)
    node.buffer.odometry = {1.0: (0.0, 0.0, 0.0), 2.0: (0.0, 0.0, 0.0)}
    node.made["scan"].call(scan_message(1.0))
    near = np.ptp(node.localizer.cloud()[0][:, :2], axis=0)
    response = object()
    assert node.made["reinitialize_global_localization"].call(object(), response) is response
    assert node.localizer.estimate is None
    wide = np.ptp(node.localizer.cloud()[0][:, :2], axis=0)
    assert (near < 1.5).all() and (wide > 3.0).all()
    # A robot that stands still is localised again; a bad scan before that publishes nothing.
    bad = scan_message(2.0)
    bad.range_max = math.inf
    node.made["scan"].call(bad)
    assert len(node.broadcaster.sent) == 1 and node.logged[-1][0] == "error"
    node.made["scan"].call(scan_message(2.0))
    assert len(node.made["amcl_pose"].sent) == 2 and len(node.broadcaster.sent) == 2


def test_a_bad_scan_after_a_new_pose_publishes_nothing(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    node = started(load, monkeypatch)
    node.buffer.odometry = {1.0: (0.0, 0.0, 0.0), 2.0: (0.0, 0.0, 0.0)}
    node.made["scan"].call(scan_message(1.0))
    node.made["initialpose"].call(initial_pose(2.0, 1.3))
    bad = scan_message(2.0)
    bad.range_max = math.inf
    node.made["scan"].call(bad)
    assert len(node.broadcaster.sent) == 1
    # Another map before the next scan keeps the new pose.
    node.made["map"].call(map_message())
    assert abs(node.localizer.cloud()[0][:, 0].mean() - 2.0) < 0.05


def test_diagnostics_of_the_filter(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    node = started(load, monkeypatch)
    now = [0.0]
    node.localizer._clock = node.queue._clock = lambda: now[0]
    sent = node.made["/diagnostics"].sent

    def status() -> tuple[int, str, dict[str, str]]:
        node.made[1.0].call()
        (one,) = sent[-1].status
        assert one.name == "gpusense: filter" and sent[-1].header.stamp.sec == 100
        return one.level[0], one.message, {pair.key: pair.value for pair in one.values}

    node.made["scan"].call(scan_message(1.0))
    now[0] = 2.0
    node.made[0.01].call()
    level, message, values = status()
    assert level == 3 and "no odometry at 1 s" in message and values["scans without transforms"] == "1"
    assert node.logged[-1] == ("warning", "a scan is skipped: no transform within 1 s: no odometry at 1 s")
    for k in range(4):
        node.buffer.odometry[2.0 + k] = (0.06 * k, 0.0, 0.0)
        node.made["scan"].call(scan_message(2.0 + k, (1.0 + 0.06 * k, 1.3, 0.0)))
    level, message, values = status()
    assert (level, message, values["verdict"]) == (0, "tracking", "tracking")
    assert values["scans that counted"] == "4" and float(values["p_lost"]) < 0.1
    now[0] = 8.0
    assert status()[0] == 3
    node.made["reinitialize_global_localization"].call(None, None)
    node.made["scan"].call(scan_message(5.0))
    level, message, _ = status()
    assert level == 1 and message.startswith("uncertain: ")
    bad = scan_message(5.0)
    bad.range_max = math.inf
    node.made["scan"].call(bad)
    assert status()[0] == 2
    node.localizer.grid = None
    assert status()[:2] == (1, "no map yet")


def test_the_watching_node_publishes(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_stubs.Node, "given", {"backend": "numpy"})
    node = load("watch_node").WatchingNode()
    node.made["map"].call(map_message())
    node.made["scan"].call(scan_message(100.0))
    pose = initial_pose(1.0, 1.3)
    pose.header.stamp = ros_stubs.Time(100.0).to_msg()
    node.made["amcl_pose"].call(pose)
    ((one,),) = [message.status for message in node.made["/diagnostics"].sent]
    assert one.name == "gpusense: localisation" and one.level in (b"\0", b"\1") and one.values[0].key == "p_lost"


# ------------------------------------------------------------------------------------------------------- the queue


@pytest.fixture
def queued(load: Any) -> Any:
    """Return a queue over scans that are numbers, its clock, its known transforms and what it delivered."""
    module, now, known, out = load("scan_queue"), [0.0], set(), []

    def look_up(scan: int) -> str:
        if scan not in known:
            raise module.NotYetError(f"none at {scan}")
        return f"t{scan}"

    queue = module.ScanQueue(look_up, lambda *pair: out.append(pair), patience=1.0, most=3, clock=lambda: now[0])
    return queue, now, known, out


def test_scans_are_delivered_in_their_order(queued: Any) -> None:
    queue, _, known, out = queued
    for scan in (1, 2, 3):
        queue.add(scan)
    known |= {1, 2, 3}
    queue.check()
    assert out == [(1, "t1"), (2, "t2"), (3, "t3")] and queue.dropped == 0


def test_a_scan_from_before_the_transforms_is_dropped(queued: Any) -> None:
    queue, _, known, out = queued
    queue.add(1)
    known |= {2}
    queue.add(2)
    known |= {1}
    queue.check()
    assert out == [(2, "t2")] and queue.dropped == 1 and queue.reason == "the transforms begin after the scan"


def test_patience_and_length(queued: Any) -> None:
    queue, now, known, out = queued
    for scan in range(5):
        now[0] = 0.3 * scan
        queue.add(scan)
    assert len(queue) == 3 and queue.dropped == 2 and "more than 3" in queue.reason
    now[0] = 1.61
    queue.check()
    assert len(queue) == 2 and queue.dropped == 3 and queue.reason == "no transform within 1 s: none at 2"
    queue.clear()
    known |= {3, 4}
    queue.check()
    assert not out


# ------------------------------------------------------------------------------------------------------- the package


def module_of(file: Any) -> ModuleType:
    spec = importlib.util.spec_from_file_location("launched", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_launch_file_starts_nodes_that_exist(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    module = module_of(PACKAGE / "launch" / "localize.launch.py")
    (description,) = module.generate_launch_description().arguments
    setup = (PACKAGE / "setup.py").read_text()
    scripts = dict(re.findall(r'f"(\w+) = \{NAME\}\.(\w+):main"', setup))
    kinds = {"localize": "LocalizationNode", "watch": "WatchingNode"}
    declared = {one.arguments[0]: one.options["default_value"] for one in description if "package" not in one.options}
    assert (PACKAGE / declared["parameters"].removeprefix(f"/share/{PACKAGE.name}/")).is_file()
    nodes = [one.options for one in description if "package" in one.options]
    assert {one["executable"] for one in nodes} == set(kinds) == set(scripts)
    monkeypatch.setattr(ros_stubs.Node, "given", {"backend": "numpy"})
    for one in nodes:
        node = getattr(load(scripts[one["executable"]]), kinds[one["executable"]])()
        (given,) = one["parameters"]
        assert node.name == one["name"] and given.keys() <= node.parameters.keys() | {"use_sim_time"}
        used = {value.arguments[0].arguments[0] for value in given.values()}
        assert used <= declared.keys()
    for file in re.findall(r'\["([\w/.]+)"\]', setup):
        assert (PACKAGE / file).is_file()


def test_the_manifest_names_what_is_imported() -> None:
    files = [*CODE.glob("*.py"), *(PACKAGE / "launch").glob("*.py")]
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text()))]
    modules = {node.module.partition(".")[0] for node in nodes if isinstance(node, ast.ImportFrom)}
    modules |= {name.name.partition(".")[0] for node in nodes if isinstance(node, ast.Import) for name in node.names}
    others = modules - {*sys.stdlib_module_names, "gpusense", "gpusense_localization", "numpy"}
    named = set(re.findall(r"<exec_depend>(\w+)</exec_depend>", (PACKAGE / "package.xml").read_text()))
    assert others == named
