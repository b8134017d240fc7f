"""Parameters of nav2_amcl's node, and the example package of ROS 2 without ROS."""

from __future__ import annotations

import ast
import importlib
import math
import re
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from support.paths import ROOT

import gpusense as gs

PACKAGE = ROOT / "examples" / "ros2" / "gpusense_localization"
from_nav2 = gs.compat.from_nav2


def test_defaults_are_those_of_the_node() -> None:
    options = from_nav2({"amcl": {"ros__parameters": {}}})
    assert options.model == "likelihood_field" and options.weights == gs.compat.FieldWeights()
    assert options.parameters == gs.LikelihoodFieldParameters(z_hit=0.5, z_rand=0.5, sigma_hit=0.2)
    assert options.alpha == (0.2,) * 5 and options.particles == (500, 2000) and options.motion == "differential"
    assert options.update_min == (0.25, 0.2) and options.recovery == (0.0, 0.0) and options.resample_interval == 1
    assert options.range_limits == (None, 100.0) and options.initial_pose is None and options.ignored == ()
    assert options.odometry is None and options.beam_skip is None
    assert options.make_motion() == gs.OdometryMotion((0.2,) * 4)


FILE = """
/robot:
  amcl:
    ros__parameters:
      laser_model_type: beam
      z_hit: 1.2
      z_short: 0.2
      z_max: 0.2
      z_rand: 0.4
      lambda_short: 1
      robot_model_type: nav2_amcl::OmniMotionModel
      recovery_alpha_slow: 0.001
      recovery_alpha_fast: 0.1
      set_initial_pose: true
      initial_pose: {x: 1.5, y: -2, yaw: 0.5}
      do_beamskip: false
controller_server:
  ros__parameters: {z_hit: 9.0}
"""


def test_a_file(tmp_path: Path) -> None:
    file = tmp_path / "nav2.yaml"
    file.write_text(FILE)
    options = from_nav2(file)
    assert options.weights == gs.compat.BeamWeights(1.2, 0.2, 0.2, 0.4, 0.2, 1.0)
    assert options.parameters.to_dict() == pytest.approx(gs.BeamParameters(0.6, 0.1, 0.1, 0.2, 0.2, 1.0).to_dict())
    assert (options.motion, options.recovery, options.initial_pose) == ("omni", (0.001, 0.1), (1.5, -2.0, 0.5))
    assert options.ignored == () and options.beam_skip is None and options.make_motion() == gs.OmniMotion((0.2,) * 5)
    grid, scanner = gs.OccupancyGrid([[0] * 20 + [100]], 0.1), gs.Scanner([0.0], range_max=4.0)
    ours = options.make_model(grid, scanner, backend="numpy")
    own = gs.BeamModel(grid, scanner, options.parameters, backend="numpy")
    theirs = options.make_model(grid, scanner, compat=True, backend="numpy")
    peers = gs.BeamModel(grid, scanner, options.weights, compat="amcl", backend="numpy")
    poses = [(0.35, 0.05, 0.0), (0.55, 0.05, 0.1)]
    for one, two in ((ours, own), (theirs, peers)):
        np.testing.assert_array_equal(one.log_likelihood(poses, [1.5]), two.log_likelihood(poses, [1.5]))


def test_what_the_command_fit_wrote(tmp_path: Path) -> None:
    from gpusense.commands.parameter_files import parameters_yaml

    rng = np.random.default_rng(0)
    expected = rng.uniform(1, 9, 4000)
    fit = gs.fit_beam_parameters(expected + 0.04 + rng.normal(0, 0.1, 4000), expected, 10.0, range_bias=True,
                                 backend="numpy")  # fmt: skip
    motion = gs.OdometryMotion((0.1, 0.2, 0.3, 0.4), 0.01, (0.03, 0.02), (0.01, 0.02, 0.03), 0.05)
    noise = SimpleNamespace(motion=motion)
    result: Any = SimpleNamespace(fit=fit, incidence=None, motion=noise, data=SimpleNamespace(range_max=10.0))
    file = tmp_path / "parameters.yaml"
    file.write_text(parameters_yaml(result))
    options = from_nav2(file)
    assert options.model == "beam" and options.parameters == fit.parameters and options.parameters.range_bias > 0
    assert options.range_limits == (None, 10.0) and options.alpha == (0.1, 0.2, 0.3, 0.4, 0.2)
    assert options.odometry == options.make_motion() == motion and options.ignored == ()
    assert from_nav2({"beam_model": fit.parameters.to_dict()}).parameters == fit.parameters


def test_the_noise_that_the_command_fit_wrote() -> None:
    noise = {"odometry_motion": {"alpha": [0.1, 0.2, 0.3, 0.4], "reverse": 0.0}}
    assert from_nav2(noise).make_motion() == gs.OdometryMotion((0.1, 0.2, 0.3, 0.4), 0.0)
    own = from_nav2(noise | {"amcl": {"ros__parameters": {"alpha2": 0.9}}})
    assert own.alpha == (0.1, 0.9, 0.3, 0.4, 0.2) and own.make_motion() == from_nav2(noise).odometry
    omni = from_nav2(noise | {"amcl": {"ros__parameters": {"robot_model_type": "nav2_amcl::OmniMotionModel"}}})
    assert omni.odometry is None and omni.make_motion() == gs.OmniMotion((0.2,) * 5)
    for values, error in ({"speed": 1}, ValueError), ({"alpha": [1]}, ValueError), ([1], TypeError):
        with pytest.raises(error, match="source: odometry_motion: "):
            from_nav2({"odometry_motion": values})


def test_a_filter_has_the_options_of_the_file() -> None:
    values = {"do_beamskip": True, "beam_skip_threshold": 0.4, "beam_skip_distance": 0.5, "max_particles": 900}
    options = from_nav2(values | {"recovery_alpha_slow": 0.001, "recovery_alpha_fast": 0.1})
    assert options.beam_skip == 0.4 and options.ignored == ("beam_skip_distance",)
    grid, scanner = gs.OccupancyGrid([[0] * 20 + [100]], 0.1), gs.Scanner([0.0], range_max=4.0)
    pf = options.make_filter(options.make_model(grid, scanner, backend="numpy"), seed=3, particles=700)
    assert pf.motion == options.make_motion() and pf.options.beam_skip == 0.4 and pf.options.recovery == "augmented"
    assert (pf.options.seed, pf.options.least, pf.options.most) == (3, 700, 700)
    assert from_nav2({"beam_skip_threshold": 2.0}).beam_skip is None


def test_dotted_names_and_mappings_are_the_same() -> None:
    start = {"x": 1.5, "y": -2.0, "yaw": 0.5, "covariance_x": 0.25, "covariance_y": 0.5, "covariance_xy": 0.1}
    nested = from_nav2({"set_initial_pose": True, "initial_pose": start})
    dotted = from_nav2({"set_initial_pose": True} | {f"initial_pose.{name}": value for name, value in start.items()})
    mixed = {"set_initial_pose": True, "initial_pose": {"x": 1.5}, "initial_pose.y": -2, "initial_pose.yaw": 0.5}
    assert nested == dotted and nested.initial_pose == from_nav2(mixed).initial_pose == (1.5, -2.0, 0.5)
    assert nested.initial_covariance == ((0.25, 0.1, 0.0), (0.1, 0.5, 0.0), (0.0, 0.0, 0.0))
    assert from_nav2(mixed).initial_covariance is None and from_nav2({"initial_pose.x": 1, "z_hit": 1}).ignored == ()
    everywhere = {"/**": {"ros__parameters": {"initial_pose.x": 3.0}}}
    own = {"amcl": {"ros__parameters": {"set_initial_pose": True, "initial_pose": {"y": 4.0, "z": 1.0}}}}
    options = from_nav2(everywhere | own)
    assert options.initial_pose == (3.0, 4.0, 0.0) and options.ignored == ("initial_pose.z",)
    assert from_nav2({"z_hit": 0.5, "laser": {"front": {"x": 1}}}).ignored == ("laser.front.x",)


BELUGA = """
amcl:
  ros__parameters:
    robot_model_type: differential_drive
    set_initial_pose: true
    initial_pose.x: 0.0
    initial_pose.y: 2.0
    initial_pose.yaw: 0.25
    initial_pose.covariance_x: 0.25
    initial_pose.covariance_y: 0.25
    initial_pose.covariance_yaw: 0.0685
"""


def test_the_form_of_belugas_file(tmp_path: Path) -> None:
    (tmp_path / "params.yaml").write_text(BELUGA)
    options = from_nav2(tmp_path / "params.yaml")
    assert options.initial_pose == (0.0, 2.0, 0.25) and options.ignored == ()
    np.testing.assert_array_equal(options.initial_covariance, np.diag([0.25, 0.25, 0.0685]))


V, T = ValueError, TypeError
CASES: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({}, V, "source: must hold amcl's ros__parameters, got the keys []"),
    ({"bt": {"ros__parameters": {}}}, V, "source: must hold amcl's ros__parameters, got the keys ['bt']"),
    ({"z_hit": "a"}, T, "source: z_hit: must be a real number, got 'a'"),
    ({"max_particles": 2.5}, T, "source: max_particles: must be an integer, got 2.5"),
    ({"max_particles": 100}, V, "min_particles: must be <= max_particles = 100, got 500"),
    ({"tf_broadcast": 1}, T, "source: tf_broadcast: must be true or false, got 1"),
    ({"scan_topic": 1}, T, "source: scan_topic: must be a string, got 1"),
    ({"alpha1": -0.1}, V, "alpha1: must be finite and >= 0, got -0.1"),
    ({"recovery_alpha_fast": 2.0}, V, "recovery_alpha_fast: must be finite and >= 0 and <= 1, got 2.0"),
    ({"laser_model_type": "sonar"}, V,
     "laser_model_type: must be one of 'beam', 'likelihood_field', 'likelihood_field_prob', got 'sonar'"),
    ({"z_hit": 0.0, "z_rand": 0.0}, V, "z_hit + z_max + z_rand: must be > 0, got 0.0"),
    ({"do_beamskip": True, "beam_skip_threshold": 1.0}, V,
     "beam_skip_threshold: must be finite and > 0 and < 1, got 1.0"),
    ({"z_hit": 1, "initial_pose": {"x": 1}, "initial_pose.x": 2}, V,
     "source: initial_pose.x: must have one value, got 1 and 2"),
    ({"set_initial_pose": True, "initial_pose.covariance_x": -1.0}, V,
     "source: initial_pose.covariance: must be positive semidefinite, got an eigenvalue of -1"),
    ({"set_initial_pose": True, "initial_pose.x": "a"}, T, "source: initial_pose.x: must be a real number, got 'a'"),
    ({"set_initial_pose": True, "initial_pose": 3}, T, "source: initial_pose: must be a mapping, got 3"),
]  # fmt: skip


@pytest.mark.parametrize("values, error, text", CASES)
def test_bad_parameters(values: dict[str, Any], error: type[Exception], text: str) -> None:
    with pytest.raises(error) as raised:
        from_nav2(values)
    assert str(raised.value) == text


def test_a_file_executes_nothing(tmp_path: Path) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text("amcl: !!python/object/apply:os.system ['exit 1']")
    with pytest.raises(ValueError, match="must be plain YAML"):
        from_nav2(file)


# ------------------------------------------------------------------------------------------------- the example


@pytest.fixture
def conversions(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(PACKAGE))
    return importlib.import_module("gpusense_localization.conversions")


@pytest.fixture
def localizer(conversions: ModuleType) -> ModuleType:
    return importlib.import_module("gpusense_localization.localizer")


def test_the_node_compiles_and_reads_its_own_parameters() -> None:
    for file in (PACKAGE / "gpusense_localization").glob("*.py"):
        ast.parse(file.read_text())
    assert from_nav2(PACKAGE / "config" / "amcl.yaml").ignored == ()


def test_the_readme_names_a_file_that_exists() -> None:
    (name,) = re.findall(r"parameters:=\$PWD/src/(\S+)", (PACKAGE / "README.md").read_text())
    assert (PACKAGE.parent / name).is_file()


def test_conversions(conversions: ModuleType) -> None:
    pose, odometry = (3.0, -1.0, 2.5), (0.4, 0.2, -1.2)
    fixed = conversions.map_to_odometry(pose, odometry)
    np.testing.assert_allclose(conversions.compose(fixed, odometry), pose, atol=1e-12)
    np.testing.assert_allclose(conversions.compose(pose, conversions.inverse(pose)), 0, atol=1e-12)
    turned = SimpleNamespace(**conversions.quaternion_of(2.5))
    assert conversions.yaw_of(turned) == pytest.approx(2.5)
    covariance = np.array([[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]])
    numbers = conversions.covariance_fields(covariance)
    assert len(numbers) == 36 and numbers[5] == 0.2 and numbers[35] == 3.0
    np.testing.assert_array_equal(conversions.covariance_of(numbers), covariance)
    message = SimpleNamespace(position=SimpleNamespace(x=0.0, y=0.0, z=9.0), orientation=SimpleNamespace(w=0.0))
    assert conversions.pose_of(conversions.fill(message, conversions.pose_fields(pose))) == pytest.approx(pose)
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


def scan_of(count: int) -> Any:
    return SimpleNamespace(angle_min=-math.pi, angle_increment=2 * math.pi / count, range_min=0.1, range_max=8.0,
                           ranges=np.full(count, 2.0))  # fmt: skip


def map_message() -> Any:
    origin = SimpleNamespace(position=SimpleNamespace(x=0.0, y=0.0), orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0,
                             w=1.0))  # fmt: skip
    info = SimpleNamespace(width=40, height=40, resolution=0.1, origin=origin)
    cells = np.zeros((40, 40), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    return SimpleNamespace(info=info, data=cells.ravel())


def test_the_localizer_drives_a_filter(localizer: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    FakeFilter.made = []
    monkeypatch.setattr("gpusense.localization.filter.ParticleFilter", FakeFilter)
    options = from_nav2({"max_particles": 900, "alpha1": 0.3, "recovery_alpha_slow": 0.01, "recovery_alpha_fast": 0.1})
    own = localizer.Localizer(options, backend="numpy")
    assert not own.update(scan_of(90), (0.0, 0.0, 0.0), (0.1, 0.0, 0.0))
    own.set_map(map_message())
    assert own.update(scan_of(90), (0.0, 0.0, 0.0), (0.1, 0.0, 0.0))
    assert not own.update(scan_of(90), (0.1, 0.0, 0.0), (0.1, 0.0, 0.0))
    assert own.update(scan_of(90), (0.3, 0.0, 0.0), (0.1, 0.0, 0.0))
    (made,) = FakeFilter.made
    assert [call[0] for call in made.calls] == ["uniform", "correct", "predict", "correct"]
    assert made.calls[2] == ("predict", (0.0, 0.0, 0.0), (0.3, 0.0, 0.0))
    assert made.options == dict(
        motion=gs.OdometryMotion((0.3, 0.2, 0.2, 0.2)), particles=(500, 900), seed=0, recovery="augmented",
        beam_skip=None,
    )  # fmt: skip
    np.testing.assert_allclose(localizer.map_to_odometry((1.0, 2.0, 0.5), (0.3, 0.0, 0.0)), own.map_to_odometry())
    for k, count in enumerate((91, 88, 90)):
        assert own.update(scan_of(count), (1.0 + k, 0.0, 0.0), (0.1, 0.0, 0.0))
    assert len(FakeFilter.made) == 2 and FakeFilter.made[1].calls[0][0] == "initialize"
    assert np.isfinite(FakeFilter.made[1].calls[-1][1]).sum() == 90
    own.set_map(map_message())
    assert own.update(scan_of(90), (5.0, 0.0, 0.0), (0.1, 0.0, 0.0))
    again = FakeFilter.made[2].calls
    assert [call[0] for call in again] == ["initialize", "predict", "correct"]
    np.testing.assert_array_equal(again[0][1]["mean"], (1.0, 2.0, 0.5))
    assert again[1] == ("predict", (3.0, 0.0, 0.0), (5.0, 0.0, 0.0))


def test_a_scan_that_breaks_a_rule_is_skipped(localizer: ModuleType) -> None:
    own = localizer.Localizer(from_nav2({"sigma_hit": 0.1}), backend="numpy")
    own.set_map(map_message())
    wrong = scan_of(60)
    wrong.range_max = math.inf
    assert not own.update(wrong, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) and "range_max" in own.problem
    assert own.filter is None and own.estimate is None
    assert own.update(scan_of(60), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) and own.problem is None


def test_a_scanner_of_as_many_beams_as_places_may_vary(localizer: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    FakeFilter.made = []
    monkeypatch.setattr("gpusense.localization.filter.ParticleFilter", FakeFilter)
    own = localizer.Localizer(from_nav2({"sigma_hit": 0.1}), backend="numpy")
    own.set_map(map_message())
    for k in range(2):
        message = scan_of(localizer.PLACES)
        message.angle_min, message.angle_increment = -1.0 + 0.1 * k, 2.0 / localizer.PLACES
        assert own.update(message, (1.0 * k, 0.0, 0.0), (0.0, 0.0, 0.0))
    first, second = FakeFilter.made
    assert np.isfinite(first.calls[-1][1]).all()
    # The readings of 2 rad lie at bearings of 2 rad.
    read = second.model.scanner.bearings[np.isfinite(second.calls[-1][1])]
    assert read.min() == pytest.approx(-0.9, abs=0.005) and read.max() == pytest.approx(1.1, abs=0.005)


@pytest.mark.skipif(not hasattr(gs, "ParticleFilter"), reason="this version has no particle filter")
def test_the_localizer_localises(localizer: ModuleType) -> None:
    own = localizer.Localizer(from_nav2({"sigma_hit": 0.1, "update_min_d": 0.05}), backend="numpy")
    own.set_map(map_message())
    own.start_at((1.0, 1.3, 0.2), np.diag([0.01, 0.01, 0.01]))
    caster = gs.RayCaster(own.grid, range_max=8.0, backend="numpy")
    for k in range(5):
        message = scan_of(60)
        truth = (1.05 + 0.1 * k, 1.25, 0.25)
        bearings = gs.Scanner.from_laser_scan(message).bearings
        message.ranges = caster.cast([truth], bearings)[0]
        assert own.update(message, (0.1 * k * math.cos(0.25), -0.1 * k * math.sin(0.25), 0.0), (0.0, 0.0, 0.0))
    assert np.hypot(*(np.asarray(own.estimate.pose)[:2] - truth[:2])) < 0.1


# ------------------------------------------------------------------------------------------------- the watching node


@pytest.fixture
def watcher(conversions: ModuleType) -> ModuleType:
    return importlib.import_module("gpusense_localization.watcher")


def stamped(time: float, **fields: Any) -> Any:
    stamp = SimpleNamespace(sec=int(time), nanosec=round((time - int(time)) * 1e9))
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp, frame_id="laser"), **fields)


def pose_message(conversions: ModuleType, time: float, pose: Any, deviation: float = 0.05) -> Any:
    place = SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())
    conversions.fill(place, conversions.pose_fields(tuple(map(float, pose))))
    covariance = conversions.covariance_fields(np.diag([deviation**2, deviation**2, 0.0025]))
    return stamped(time, pose=SimpleNamespace(pose=place, covariance=covariance))


def test_the_watcher_publishes_the_verdict(watcher: ModuleType, conversions: ModuleType) -> None:
    own, message = watcher.Watcher(backend="numpy"), map_message()
    message.data = message.data.reshape(40, 40)
    message.data[:25, 20] = 100
    message.data = message.data.ravel()
    grid = gs.OccupancyGrid.from_message(message)
    bearings = np.linspace(-math.pi, math.pi, 48, endpoint=False)
    caster = gs.RayCaster(grid, range_max=8.0, backend="numpy")

    def step(time: float, truth: np.ndarray, pose: np.ndarray, **more: Any) -> bool:
        fields = vars(scan_of(48)) | {"ranges": caster.cast(truth[None], bearings)[0]}
        own.add_scan(stamped(time, **fields), (0.0, 0.0, 0.0))
        return own.add_pose(pose_message(conversions, time + 0.01, pose, **more))

    truth = np.array([1.0, 1.0, 0.2])
    assert not step(0.5, truth, truth) and own.status(0.6)["level"] == 3
    own.set_map(message)
    for k in range(5):
        assert step(1.0 + k, truth + np.array([0.1 * k, 0.0, 0.0]), truth + np.array([0.1 * k, 0.0, 0.0]))
    status = own.status(5.5)
    assert status["level"] == 0 and status["message"] == "tracking"
    assert status["values"][0]["key"] == "p_lost" and float(status["values"][0]["value"]) < 0.05
    assert own.status(30.0)["level"] == 3
    # A wide pose, and one on the other side of the wall.
    assert step(6.0, truth, truth, deviation=0.8) and own.status(6.0)["level"] == 1
    own.reset()
    assert own.status(6.0)["level"] == 3
    for k in range(8):
        assert step(7.0 + k, truth + np.array([0.1 * k, 0.0, 0.0]), truth + np.array([1.8 + 0.1 * k, 1.5, 2.0]))
    status = own.status(15.0)
    assert status["level"] == 2 and status["message"].startswith("lost: ") and "likely cause" in status["message"]
    # No scan of this time, and a scan that breaks a rule.
    assert not own.add_pose(pose_message(conversions, 20.0, truth))
    own.add_scan(stamped(21.0, **(vars(scan_of(48)) | {"range_max": math.inf})), (0.0, 0.0, 0.0))
    assert "range_max" in own.problem
