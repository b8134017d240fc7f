"""Parameters of nav2_amcl's node."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import gpusense as gs

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
    from gpusense.commands.fit import parameters_yaml

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
