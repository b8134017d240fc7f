"""The parts of the nodes that need no ROS: conversions, the localiser, the watcher, and the queue of scans."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.logs.records import planar
from gpusense.logs.transform_buffer import TransformError
from gpusense.ros import conversions, localizer, watcher
from gpusense.ros.localizer import ScanQueue
from gpusense.world.messages import planar_covariance, planar_pose

from_nav2 = gs.compat.from_nav2
AHEAD = conversions.pose_matrix((0.1, 0.0, 0.0))


def test_conversions() -> None:
    pose, odometry = (3.0, -1.0, 2.5), (0.4, 0.2, -1.2)
    fixed = conversions.map_to_odometry(pose, odometry)
    np.testing.assert_allclose(gs.compose_poses(fixed, odometry), pose, atol=1e-12)
    covariance = np.array([[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]])
    numbers = conversions.covariance_fields(covariance)
    assert len(numbers) == 36 and numbers[5] == 0.2 and numbers[35] == 3.0
    np.testing.assert_array_equal(planar_covariance(numbers), covariance)
    message = SimpleNamespace(position=SimpleNamespace(x=0.0, y=0.0, z=9.0), orientation=SimpleNamespace(w=0.0))
    assert planar_pose("pose", conversions.fill(message, conversions.pose_fields(pose))) == pytest.approx(pose)
    np.testing.assert_allclose(planar(conversions.pose_matrix(pose)), pose)
    cloud = conversions.cloud_fields(np.arange(30.0).reshape(10, 3), np.full(10, 0.1), most=4)
    assert [each["pose"]["position"]["x"] for each in cloud] == [0.0, 9.0, 18.0, 27.0]
    least = (0.25, 0.2)
    assert not conversions.moved_enough((0, 0, 3.1), (0.2, 0.2, -3.1), least)
    assert conversions.moved_enough((0, 0, 0), (0.0, -0.3, 0.0), least)
    assert conversions.moved_enough((0, 0, 3.0), (0.0, 0.0, -3.0), least)


class FakeFilter:
    """A filter that records its calls, with the interface of gs.ParticleFilter."""

    made: ClassVar[list[FakeFilter]] = []

    def __init__(self, model: Any, **options: Any) -> None:
        self.model, self.options, self.calls = model, options, []
        FakeFilter.made.append(self)

    def initialize(self, **start: Any) -> None:
        self.calls.append(("initialize", start))

    def initialize_uniform(self) -> None:
        self.calls.append(("uniform",))

    def predict(self, before: Any, after: Any) -> None:
        self.calls.append(("predict", tuple(before), tuple(after)))

    def correct(self, ranges: np.ndarray) -> None:
        assert len(ranges) == self.model.scanner.count
        self.calls.append(("correct", ranges))

    def estimate(self) -> Any:
        return SimpleNamespace(pose=np.array([1.0, 2.0, 0.5]), covariance=np.eye(3))


def scan_of(count: int, seconds: int = 0) -> Any:
    header = SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=0))
    return SimpleNamespace(header=header, angle_min=-math.pi, angle_increment=2 * math.pi / count, range_min=0.1,
                           range_max=8.0, ranges=np.full(count, 2.0))  # fmt: skip


def grid(wall: int = 0) -> gs.OccupancyGrid:
    """Return a room, with a wall of some cells in it."""
    cells = np.zeros((40, 40), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = cells[:wall, 20] = 100
    return gs.OccupancyGrid(cells, 0.1)


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch) -> localizer.Localizer:
    """Return a localizer on a map whose filters record their calls."""
    FakeFilter.made = []
    monkeypatch.setattr("gpusense.localization.filter.ParticleFilter", FakeFilter)
    own = localizer.Localizer(from_nav2({"sigma_hit": 0.1}), backend="numpy")
    own.set_map(grid())
    return own


def test_the_localizer_drives_a_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    FakeFilter.made = []
    monkeypatch.setattr("gpusense.localization.filter.ParticleFilter", FakeFilter)
    options = from_nav2({"max_particles": 900, "alpha1": 0.3, "recovery_alpha_slow": 0.01, "recovery_alpha_fast": 0.1})
    own = localizer.Localizer(options, backend="numpy")
    assert not own.update(scan_of(90), (0.0, 0.0, 0.0), AHEAD)
    own.set_map(grid())
    assert own.update(scan_of(90), (0.0, 0.0, 0.0), AHEAD)
    assert not own.update(scan_of(90), (0.1, 0.0, 0.0), AHEAD)
    assert own.update(scan_of(90), (0.3, 0.0, 0.0), AHEAD)
    (made,) = FakeFilter.made
    assert [call[0] for call in made.calls] == ["uniform", "correct", "predict", "correct"]
    assert made.calls[2] == ("predict", (0.0, 0.0, 0.0), (0.3, 0.0, 0.0))
    assert made.options == dict(
        motion=gs.OdometryMotion((0.3, 0.2, 0.2, 0.2)), particles=(500, 900), seed=0, recovery="augmented",
        beam_skip=None,
    )  # fmt: skip
    np.testing.assert_allclose(localizer.map_to_odometry((1.0, 2.0, 0.5), (0.3, 0.0, 0.0)), own.map_to_odometry())
    for k, count in enumerate((91, 88, 90)):
        assert own.update(scan_of(count), (1.0 + k, 0.0, 0.0), AHEAD)
    assert len(FakeFilter.made) == 2 and FakeFilter.made[1].calls[0][0] == "initialize"
    assert np.isfinite(FakeFilter.made[1].calls[-1][1]).sum() == 90
    own.set_map(grid())
    assert own.update(scan_of(90), (5.0, 0.0, 0.0), AHEAD)
    again = FakeFilter.made[2].calls
    assert [call[0] for call in again] == ["initialize", "predict", "correct"]
    np.testing.assert_array_equal(again[0][1]["mean"], (1.0, 2.0, 0.5))
    assert again[1] == ("predict", (3.0, 0.0, 0.0), (5.0, 0.0, 0.0))


def test_a_scan_that_breaks_a_rule_is_skipped() -> None:
    own = localizer.Localizer(from_nav2({"sigma_hit": 0.1}), backend="numpy")
    own.set_map(grid())
    wrong = scan_of(60)
    wrong.angle_increment = 0.0
    assert not own.update(wrong, (0.0, 0.0, 0.0), np.eye(4)) and "angle_increment" in own.problem
    assert own.filter is None and own.estimate is None
    assert own.update(scan_of(60), (0.0, 0.0, 0.0), np.eye(4)) and own.problem is None


def test_scans_that_differ_by_rounding_or_limits_keep_the_scanner(own: localizer.Localizer) -> None:
    assert own.update(scan_of(4), (0.0, 0.0, 0.0), AHEAD)
    message = scan_of(4)
    message.angle_min += 1e-6
    message.range_min, message.range_max, message.ranges = 0.5, 6.0, np.array([0.0, 0.3, 7.0, 2.0])
    laser = AHEAD.copy()
    laser[0, 3] += 1e-9
    assert own.update(message, (1.0, 0.0, 0.0), laser)
    (made,) = FakeFilter.made
    np.testing.assert_array_equal(made.calls[-1][1], [math.nan, math.nan, math.inf, 2.0])


def test_a_beam_that_repeats_the_first_direction_is_used_once(own: localizer.Localizer) -> None:
    message = scan_of(9)
    message.angle_increment = 2 * math.pi / 8
    assert own.update(message, (0.0, 0.0, 0.0), AHEAD)
    np.testing.assert_array_equal(FakeFilter.made[0].calls[-1][1], [2.0] * 8 + [math.nan])


def test_a_scanner_of_as_many_beams_as_places_may_vary(own: localizer.Localizer) -> None:
    for k in range(2):
        message = scan_of(localizer.PLACES)
        message.angle_min, message.angle_increment = -1.0 + 0.1 * k, 2.0 / localizer.PLACES
        assert own.update(message, (1.0 * k, 0.0, 0.0), np.eye(4))
    first, second = FakeFilter.made
    assert np.isfinite(first.calls[-1][1]).all()
    # Readings of 2 are at bearings of 2 rad.
    read = second.model.scanner.bearings[np.isfinite(second.calls[-1][1])]
    assert read.min() == pytest.approx(-0.9, abs=0.005) and read.max() == pytest.approx(1.1, abs=0.005)


def test_the_localizer_localises() -> None:
    own = localizer.Localizer(from_nav2({"sigma_hit": 0.1, "update_min_d": 0.05}), backend="numpy")
    own.set_map(grid())
    own.start_at((1.0, 1.3, 0.2), np.diag([0.01, 0.01, 0.01]))
    caster = gs.RayCaster(own.grid, range_max=8.0, backend="numpy")
    for k in range(5):
        message = scan_of(60)
        truth = (1.05 + 0.1 * k, 1.25, 0.25)
        bearings = gs.Scanner.from_laser_scan(message).bearings
        message.ranges = caster.cast([truth], bearings)[0]
        assert own.update(message, (0.1 * k * math.cos(0.25), -0.1 * k * math.sin(0.25), 0.0), np.eye(4))
    assert np.hypot(*(np.asarray(own.estimate.pose)[:2] - truth[:2])) < 0.1
    values = {each["key"]: each["value"] for each in own.status({})["values"]}
    assert values["radius"] == f"{own.estimate.protection_level(0.05):.3f}" and values["risk"] == "0.05"


def test_the_cause_comes_once_from_scans_at_their_stamps(monkeypatch: pytest.MonkeyPatch, needs: Any) -> None:
    """Scans of a recording that plays faster keep their stamps."""
    seen = []

    def diagnose(models: Any, moments: Any, *, search: bool) -> Any:
        seen.append([one.time for one in moments])
        return SimpleNamespace(cause="time", text="likely cause: wrong times")

    monkeypatch.setattr(localizer, "diagnose_run", diagnose)
    own = localizer.Localizer(from_nav2({"sigma_hit": 0.1}), backend=needs("opencl"), clock=lambda: 7.0)
    own.set_map(grid())
    own.start_at((1.0, 1.3, 0.2), np.diag([0.01, 0.01, 0.01]))
    for k in range(3):
        # The room has no walls that are 2 m away all around.
        assert own.update(scan_of(60, 100 + 5 * k), (0.3 * k, 0.0, 0.0), np.eye(4))
    assert own.estimate.verdict != "tracking"
    messages = {own.status({})["message"] for _ in range(2)}
    assert messages == {f"{own.estimate.verdict}: likely cause: wrong times"}
    assert seen == [[100.0, 105.0, 110.0]]
    monkeypatch.setattr(localizer, "diagnose_run", lambda *_, **__: SimpleNamespace(cause="none", text="agree"))
    assert own.update(scan_of(60, 115), (0.9, 0.0, 0.0), np.eye(4)) and "wrong" not in own.status({})["message"]


def test_the_node_names_a_wrong_odometry(needs: Any) -> None:
    """The odometry turns by 0.2 rad more than the robot at each scan, and counts as exact: the robot is soon lost."""
    walls, scanner = gs.worlds.building(seed=4, size=(24.0, 16.0)), gs.Scanner(np.linspace(-2, 2, 81), range_max=15.0)
    run = gs.worlds.simulate_run(walls, scanner, scans=30, seed=3)
    exact = {f"alpha{number}": 0.001 for number in range(1, 6)}
    options = from_nav2({"sigma_hit": 0.1, "update_min_d": 0.0, "update_min_a": 0.0} | exact)
    own, odometry = localizer.Localizer(options, backend=needs("opencl")), run.odometry[0]
    own.set_map(walls)
    own.start_at(run.poses[0], np.diag([0.01, 0.01, 0.01]))
    steps = gs.pose_difference(run.odometry[:-1], run.odometry[1:]) + np.array([0.0, 0.0, 0.2])
    for k, (ranges, step) in enumerate(zip(run.scans, [np.zeros(3), *steps], strict=True)):
        odometry, message = gs.compose_poses(odometry, step), scan_of(81, k)
        message.angle_min, message.angle_increment, message.range_max = -2.0, 4.0 / 80, 15.0
        message.ranges = ranges
        assert own.update(message, tuple(odometry.tolist()), np.eye(4))
    status = own.status({})
    assert status["level"] == 2 and status["message"].endswith("likely cause: wrong odometry")


# ------------------------------------------------------------------------------------------------- the watching node


def stamped(time: float, frame: str = "map", **fields: Any) -> Any:
    stamp = SimpleNamespace(sec=int(time), nanosec=round((time - int(time)) * 1e9))
    return SimpleNamespace(**fields | {"header": SimpleNamespace(stamp=stamp, frame_id=frame)})


def pose_message(time: float, pose: Any, deviation: float = 0.05) -> Any:
    place = SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())
    conversions.fill(place, conversions.pose_fields(tuple(map(float, pose))))
    covariance = conversions.covariance_fields(np.diag([deviation**2, deviation**2, 0.0025]))
    return stamped(time, pose=SimpleNamespace(pose=place, covariance=covariance))


def test_the_watcher_publishes_the_verdict() -> None:
    own, walls = watcher.Watcher(backend="numpy"), grid(25)
    bearings = np.linspace(-math.pi, math.pi, 48, endpoint=False)
    caster = gs.RayCaster(walls, range_max=8.0, backend="numpy")

    def step(time: float, truth: np.ndarray, pose: np.ndarray, **more: Any) -> bool:
        fields = vars(scan_of(48)) | {"ranges": caster.cast(truth[None], bearings)[0]}
        own.add_scan(stamped(time, **fields), np.eye(4))
        return own.add_pose(pose_message(time + 0.01, pose, **more))

    truth = np.array([1.0, 1.0, 0.2])
    assert not step(0.5, truth, truth) and own.status(0.6)["level"] == 3
    own.set_map(walls)
    for k in range(5):
        assert step(1.0 + k, truth + np.array([0.1 * k, 0.0, 0.0]), truth + np.array([0.1 * k, 0.0, 0.0]))
    status = own.status(5.5)
    assert status["level"] == 0 and status["message"] == "tracking"
    values = {each["key"]: each["value"] for each in status["values"]}
    assert float(values["p_lost"]) < 0.05 and values["verdict"] == "tracking"
    # Deviations of 5 cm at a risk of 5 %, widened.
    assert 0.1 < float(values["radius"]) < 0.4 and values["risk"] == "0.05"
    assert own.status(30.0)["level"] == 3
    # A wide pose, and one on the other side of the wall.
    assert step(6.0, truth, truth, deviation=0.8) and own.status(6.0)["level"] == 1
    own.reset()
    assert own.status(6.0)["level"] == 3
    for k in range(8):
        assert step(7.0 + k, truth + np.array([0.1 * k, 0.0, 0.0]), truth + np.array([1.8 + 0.1 * k, 1.5, 2.0]))
    status = own.status(15.0)
    assert status["level"] == 2 and status["message"].startswith("lost: ") and "likely cause" in status["message"]
    assert {"key": "cause", "value": "start"} in status["values"]
    assert {"key": "radius", "value": "inf"} in status["values"]
    # No scan of this time, and a scan that breaks a rule.
    assert not own.add_pose(pose_message(20.0, truth))
    own.add_scan(stamped(21.0, **(vars(scan_of(48)) | {"angle_increment": 0.0})), np.eye(4))
    assert "angle_increment" in own.problem
    with pytest.raises(ValueError, match="covariance: must be finite"):
        own.add_pose(pose_message(7.0, truth, deviation=math.nan))
    with pytest.raises(ValueError, match="frame_id: must be 'map', got 'odom'"):
        own.add_pose(stamped(7.0, "odom", pose=pose_message(7.0, truth).pose))


def test_the_watcher_reports_the_cause_of_most_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    own, names = watcher.Watcher(backend="numpy"), "map map start map start start start"
    causes = (SimpleNamespace(cause=name, text=name) for name in names.split())
    monitor = SimpleNamespace(update=lambda *_: gs.PoseVerdict(0.9, "lost", 0.1), diagnose=lambda: next(causes))
    monkeypatch.setattr(own, "_monitor_of", lambda *_: monitor)
    own.set_map(grid())
    found = []
    for k in range(7):
        own.add_scan(stamped(float(k), **vars(scan_of(8))), np.eye(4))
        assert own.add_pose(pose_message(float(k), (1.0, 1.0, 0.0)))
        found.append(own.status(float(k))["values"][-1]["value"])
    assert found == ["map"] * 6 + ["start"]


# ------------------------------------------------------------------------------------------------ starts and scans


@pytest.mark.parametrize("change, text", [
    (dict(x=math.nan), "position.x"), (dict(variance=math.nan), "covariance: must be finite"),
    (dict(variance=-1.0), "covariance: must be positive semidefinite"), (dict(frame="odom"), "frame_id"),
    (dict(w=0.0), "orientation: must be a rotation"), (dict(turn=0.5), "must be level"),
])  # fmt: skip
def test_a_bad_first_pose_is_refused(change: dict[str, Any], text: str) -> None:
    values: dict[str, Any] = dict(x=1.0, variance=0.1, frame="map", w=1.0, turn=0.0) | change
    place = {"position": {"x": values["x"], "y": 0.0}, "orientation": {"x": values["turn"], "y": 0.0, "z": 0.0,
             "w": values["w"]}}  # fmt: skip
    covariance = np.diag([values["variance"]] * 6).ravel()
    message = {"header": {"frame_id": values["frame"]}, "pose": {"pose": place, "covariance": covariance}}
    with pytest.raises(ValueError, match=text):
        conversions.start_of(message, "/map")


def test_a_laser_upside_down_has_beams_that_run_clockwise() -> None:
    scanner, fields = conversions.laser_scan(scan_of(4), np.diag([1.0, -1.0, -1.0, 1.0]), (None, None))
    np.testing.assert_allclose(scanner.bearings, [math.pi, math.pi / 2, 0.0, -math.pi / 2])
    assert fields["angle_increment"] < 0


@pytest.mark.parametrize("low, high, limits, expected", [
    (0.1, math.inf, (None, 30.0), (0.1, 30.0)), (0.1, math.nan, (None, 30.0), (0.1, 30.0)),
    (0.1, 3e38, (None, 30.0), (0.1, 30.0)), (0.1, 0.0, (None, 30.0), (0.1, 30.0)),
    (0.1, 8.0, (None, 30.0), (0.1, 8.0)), (math.nan, 8.0, (0.2, 30.0), (0.2, 8.0)),
    (math.inf, 8.0, (0.2, 30.0), (0.2, 8.0)), (0.1, 8.0, (0.2, 6.0), (0.2, 6.0)), (9.0, 8.0, (0.0, None), (0.0, 8.0)),
])  # fmt: skip
def test_limits_narrow_or_replace_those_of_a_scan(low: float, high: float, limits: Any, expected: Any) -> None:
    message = scan_of(4)
    message.range_min, message.range_max = low, high
    scanner, _ = conversions.laser_scan(message, np.eye(4), limits)
    assert (scanner.range_min, scanner.range_max) == expected


def test_diagnostics_before_and_without_scans() -> None:
    now = [0.0]
    own = localizer.Localizer(from_nav2({"max_particles": 500}), backend="numpy", clock=lambda: now[0])
    assert own.status({})["message"] == "no map yet"
    own.set_map(grid())
    own.begin()
    status = own.status({"received": 3}, "why", "robot1/amcl")
    assert (status["level"], status["message"]) == (1, "no estimate since the start: why")
    assert (status["name"], status["hardware_id"]) == ("robot1/amcl: filter", "robot1/amcl")
    assert status["values"][1] == {"key": "scans received", "value": "3"}
    now[0] = 5.1
    assert own.status({}, "why")["message"] == "no scan for 5 s: why" and own.status({})["level"] == 3


def test_a_device_that_is_absent_is_an_error_before_the_first_scan() -> None:
    with pytest.raises(ValueError, match="nosuch"):
        localizer.Localizer(from_nav2({"max_particles": 500}), backend="nosuch").warm_up()
    localizer.Localizer(from_nav2({"max_particles": 500}), backend="numpy").warm_up()


@pytest.mark.parametrize("values", [{"max_particles": 600}, {"laser_model_type": "beam", "max_particles": 600}])
def test_the_first_scan_compiles_nothing(monkeypatch: pytest.MonkeyPatch, needs: Any, values: dict[str, Any]) -> None:
    needs("opencl")
    kind, made = type(get_backend("opencl")), set()

    def compiled(self: Any, kernel: str, flags: frozenset[str], real: Any = kind.compile) -> Any:
        made.add((kernel, flags))
        return real(self, kernel, flags)

    monkeypatch.setattr(kind, "compile", compiled)
    own = localizer.Localizer(from_nav2(values), backend="opencl")
    own.warm_up()
    warm = set(made)
    own.set_map(grid())
    own.start_at((1.0, 1.3, 0.0), np.diag([0.01, 0.01, 0.01]))
    for k in range(2):
        assert own.update(scan_of(90), (0.3 * k, 0.0, 0.0), AHEAD)
    own.start_anywhere()
    assert own.update(scan_of(90), (0.6, 0.0, 0.0), AHEAD)
    assert warm and made == warm


# ------------------------------------------------------------------------------------------------------ parameters


def test_parameters_by_the_names_of_nav2() -> None:
    values = conversions.defaults() | {"max_particles": 700, "save_pose_rate": 0.5, "max_beams": 30,
                                      "set_initial_pose": True, "initial_pose.x": 2, "use_sim_time": True}  # fmt: skip
    options, without = conversions.options_of(values)
    assert options.particles == (500, 700) and options.initial_pose == (2.0, 0.0, 0.0)
    assert without == ("max_beams", "save_pose_rate")


@pytest.mark.parametrize("change, text", [
    ({"mount": [1.0]}, "mount"), ({"scan_patience": 0}, "scan_patience"), ({"risk": 0.001}, "risk"),
    ({"backend": 3}, "backend"), ({"z_hit": -1.0}, "z_hit"), ({"map_file": "no.yaml"}, "no.yaml"),
    ({"laser_model_type": "x"}, "laser_model_type"),
])  # fmt: skip
def test_parameters_that_break_a_rule(change: dict[str, Any], text: str) -> None:
    with pytest.raises((TypeError, ValueError, OSError), match=text):
        conversions.options_of(conversions.defaults() | change)


# ------------------------------------------------------------------------------------------------------- the queue


@pytest.fixture
def queued() -> Any:
    """Return a queue over scans that are their times, its clock, its known transforms and what it delivered."""
    now, known, out = [0.0], set(), []

    def look_up(scan: int) -> str:
        if scan not in known:
            raise TransformError(f"none at {scan}", early=scan > max(known, default=0))
        return f"t{scan}"

    return ScanQueue(look_up, lambda *pair: out.append(pair), most=3, clock=lambda: now[0]), now, known, out


def test_scans_are_delivered_in_their_order(queued: Any) -> None:
    queue, _, known, out = queued
    for scan in (1, 2, 3):
        queue.add(scan, scan)
    known |= {1, 2, 3}
    queue.check()
    assert out == [(1, "t1"), (2, "t2"), (3, "t3")] and queue.dropped == 0


def test_a_scan_from_before_the_transforms_is_dropped(queued: Any) -> None:
    queue, _, known, out = queued
    queue.add(1, 1)
    known |= {2}
    queue.add(2, 2)
    assert out == [(2, "t2")] and queue.dropped == 1 and queue.reason == "the transforms begin after the scan"


def test_patience_and_length(queued: Any) -> None:
    queue, now, known, out = queued
    for scan in range(5):
        now[0] = 0.3 * scan
        queue.add(scan, scan)
    assert len(queue) == 3 and queue.dropped == 2 and "more than 3" in queue.reason
    now[0] = 1.61
    queue.check()
    assert len(queue) == 2 and queue.dropped == 3 and queue.reason == "no transform within 1 s: none at 2"
    queue.clear()
    queue.add(5, 5)
    now[0] = 100.0  # a busy node reads what came before it drops scans
    queue.check()
    known |= {3, 4, 5}
    queue.check()
    assert out == [(5, "t5")]


def test_scans_whose_stamps_go_back_replace_later_ones(queued: Any) -> None:
    queue, _, known, out = queued
    queue.add(1000, 1000)
    queue.add(5, 5)
    assert len(queue) == 1 and queue.dropped == 1 and queue.reason == "the stamps of scans went back"
    known |= {5}
    queue.check()
    assert out == [(5, "t5")]
