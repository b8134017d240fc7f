"""The parts of the nodes that need no ROS: conversions and the localiser."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from support.ros_messages import grid, scan_of

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.logs.records import planar
from gpusense.ros import conversions, localizer
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

    def state(self) -> FakeFilter:
        return self

    def restore(self, state: FakeFilter) -> None:
        self.calls.append(("restore", state))


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
    assert len(FakeFilter.made) == 2 and FakeFilter.made[1].calls[0] == ("restore", made)
    assert np.isfinite(FakeFilter.made[1].calls[-1][1]).sum() == 90
    own.set_map(grid())
    assert len(FakeFilter.made) == 2
    own.set_map(grid(5))
    assert own.update(scan_of(90), (5.0, 0.0, 0.0), AHEAD)
    again = FakeFilter.made[2].calls
    assert [call[0] for call in again] == ["restore", "predict", "correct"] and again[0][1] is FakeFilter.made[1]
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
        message = scan_of(conversions.PLACES)
        message.angle_min, message.angle_increment = -1.0 + 0.1 * k, 2.0 / conversions.PLACES
        assert own.update(message, (1.0 * k, 0.0, 0.0), np.eye(4))
    first, second = FakeFilter.made
    assert np.isfinite(first.calls[-1][1]).all()
    # Readings of 2 are at bearings of 2 rad.
    read = second.model.scanner.bearings[np.isfinite(second.calls[-1][1])]
    assert read.min() == pytest.approx(-0.9, abs=0.005) and read.max() == pytest.approx(1.1, abs=0.005)


def test_a_mount_that_moves_moves_the_scanner(own: localizer.Localizer) -> None:
    """Also among scans of varying beams; a body on springs changes nothing."""
    laser, count = AHEAD.copy(), [90, 90, 90, 60, 60]
    for k, ahead in enumerate((0.1, 0.104, 0.3, 0.3, 0.5)):
        laser[0, 3] = ahead
        assert own.update(scan_of(count[k]), (1.0 * k, 0.0, 0.0), laser)
    assert [each.model.scanner.mount[0] for each in FakeFilter.made] == [0.1, 0.3, 0.3, 0.5]
    assert [each.model.scanner.count for each in FakeFilter.made] == [90, 90, 1440, 1440]
    assert [each.calls[0][0] for each in FakeFilter.made] == ["uniform", "restore", "restore", "restore"]


def test_a_map_that_cannot_be_used_leaves_the_filter(own: localizer.Localizer, monkeypatch: Any) -> None:
    assert own.update(scan_of(9), (0.0, 0.0, 0.0), AHEAD)
    before, walls = own.filter, own.grid
    monkeypatch.setattr(FakeFilter, "restore", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        own.set_map(grid(5))
    for _ in range(2):
        # A scan that the filter cannot be made for is tried again.
        with pytest.raises(ZeroDivisionError):
            own.update(scan_of(30), (1.0, 0.0, 0.0), AHEAD)
    assert own.filter is before and own.grid is walls
    monkeypatch.undo()
    monkeypatch.setattr("gpusense.localization.filter.ParticleFilter", FakeFilter)
    assert own.update(scan_of(30), (1.0, 0.0, 0.0), AHEAD) and own.filter is not before


def test_maps_of_other_sizes_keep_the_particles() -> None:
    own = localizer.Localizer(from_nav2({"sigma_hit": 0.1, "max_particles": 600}), backend="numpy")
    own.set_map(grid())
    own.start_at((1.0, 1.3, 0.2), np.diag([0.01, 0.01, 0.01]))
    assert own.update(scan_of(9), (0.0, 0.0, 0.0), AHEAD)
    particles, weights = own.cloud()
    for shape in ((60, 50), (20, 20), (8, 8)):
        own.set_map(gs.OccupancyGrid(np.pad(np.zeros(shape, np.int8), 1, constant_values=100), 0.1))
        np.testing.assert_array_equal(own.cloud()[0], particles)
        np.testing.assert_array_equal(own.cloud()[1], weights)
    assert own.update(scan_of(9), (0.3, 0.0, 0.0), AHEAD)


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


def test_the_search_for_the_cause_rests_ten_times_its_duration(own: localizer.Localizer, monkeypatch: Any) -> None:
    now, searches, words = [0.0], [], ["lost"]

    def search(self: Any, *_: Any) -> str:
        now[0] += 2.0
        searches.append(self.counted)
        return f"cause {self.counted}"

    def estimate(self: Any) -> Any:
        return SimpleNamespace(pose=np.zeros(3), verdict=words[0], p_lost=1.0, explained=0.0, particles=1,
                               effective_sample_size=1.0, protection_level=lambda _: 1.0)  # fmt: skip

    monkeypatch.setattr(localizer.Localizer, "_likely_cause", search)
    monkeypatch.setattr(FakeFilter, "estimate", estimate)
    own = localizer.Localizer(own.options, backend="numpy", clock=lambda: now[0])
    own.set_map(grid())

    def message(k: int, verdict: str, time: float) -> Any:
        now[0], words[0] = time, verdict
        assert own.update(scan_of(9), (1.0 * k, 0.0, 0.0), AHEAD)
        return own.status({})["message"]

    assert message(0, "lost", 0.0) == "lost: cause 1" == message(1, "lost", 10.0) == message(2, "lost", 21.9)
    # While it rests, the cause of another verdict is unknown.
    assert message(3, "uncertain", 21.9) == "uncertain" and message(4, "tracking", 21.9) == "tracking"
    assert message(5, "lost", 22.0) == "lost: cause 6" and searches == [1, 6]
    own.start_again()
    assert message(6, "lost", 30.0) == "lost" and message(7, "lost", 50.0) == "lost: cause 8"


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
    for k in range(30):
        assert own.update(scan_of(90, k), (0.6 + 0.3 * k, 0.0, 0.0), AHEAD)
    own.status({})
    assert {"match_scans", "judge_beams"} <= {kernel for kernel, _ in made}
    assert own.estimate.verdict != "tracking"
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
