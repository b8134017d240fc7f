"""Read the parameters of nav2_amcl's node from its YAML file, without ROS."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast

from gpusense._util import checks
from gpusense._util.documents import read_mapping
from gpusense.localization.motion import MotionModel, OdometryMotion, OmniMotion
from gpusense.localization.nav2_file import (
    ROS_1,
    START_NAMES,
    Matrix,
    first_covariance,
    first_pose,
    nodes_of,
    parameters_of,
)
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.peers.weights import Amcl, BeamWeights, FieldWeights
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Scanner

if TYPE_CHECKING:
    from gpusense.localization.filter import ParticleFilter

LaserModel = Literal["beam", "likelihood_field", "likelihood_field_prob"]

# Defaults of nav2_amcl 1.5.0's node, with the parameters' types.
DEFAULTS: dict[str, Any] = {
    "alpha1": 0.2, "alpha2": 0.2, "alpha3": 0.2, "alpha4": 0.2, "alpha5": 0.2,
    "base_frame_id": "base_footprint", "beam_skip_threshold": 0.3, "do_beamskip": False,
    "global_frame_id": "map", "odom_frame_id": "odom",
    "lambda_short": 0.1, "laser_likelihood_max_dist": 2.0, "laser_max_range": 100.0, "laser_min_range": -1.0,
    "laser_model_type": "likelihood_field", "max_beams": 60, "max_particles": 2000, "min_particles": 500,
    "map_topic": "map", "pf_err": 0.05, "pf_z": 0.99, "recovery_alpha_fast": 0.0, "recovery_alpha_slow": 0.0,
    "resample_interval": 1, "robot_model_type": "nav2_amcl::DifferentialMotionModel", "scan_topic": "scan",
    "set_initial_pose": False, "sigma_hit": 0.2, "tf_broadcast": True, "transform_tolerance": 1.0,
    "update_min_a": 0.2, "update_min_d": 0.25, "z_hit": 0.5, "z_max": 0.05, "z_rand": 0.5, "z_short": 0.05,
}  # fmt: skip
_SKIPS, _RECOVERY = "beam_skip_threshold", ("recovery_alpha_slow", "recovery_alpha_fast")
_MODELS = ("beam", "likelihood_field", "likelihood_field_prob")
_ROBOTS = {
    "nav2_amcl::DifferentialMotionModel": "differential", "nav2_amcl::OmniMotionModel": "omni",
    "differential": "differential", "omnidirectional": "omni", "differential_drive": "differential",
    "omnidirectional_drive": "omni",
}  # fmt: skip


@dataclass(frozen=True)
class Nav2Options:
    """Options of nav2_amcl's node, read by :func:`from_nav2`.

    Example:
        >>> import gpusense as gs
        >>> options = gs.compat.from_nav2({"laser_model_type": "beam", "z_hit": 0.8, "max_particles": 5000})
        >>> options.particles, options.alpha[:4], round(options.parameters.z_hit, 3)
        ((500, 5000), (0.2, 0.2, 0.2, 0.2), 0.571)
    """

    model: LaserModel
    """The laser model: ``"beam"``, ``"likelihood_field"`` or ``"likelihood_field_prob"``."""
    weights: BeamWeights | FieldWeights
    """The file's parameters of the model, for ``compat="amcl"``; weights need not sum to 1."""
    parameters: BeamParameters | LikelihoodFieldParameters
    """Parameters of the model with weights that sum to 1, from ``beam_model`` in a file of ``gpusense fit``."""
    alpha: tuple[float, float, float, float, float]
    """Noise of the odometry: alpha1 to alpha5 (for omnidirectional robots), completed by ``odometry_motion``."""
    odometry: OdometryMotion | None
    """Noise from ``gpusense fit --fit-motion``; None in other files and for omnidirectional robots."""
    motion: Literal["differential", "omni"]
    """The kind of robot."""
    particles: tuple[int, int]
    """Least and most particles."""
    pf_err: float
    """Error of KLD sampling."""
    pf_z: float
    """Quantile of KLD sampling, as nav2_amcl reads it."""
    resample_interval: int
    """Corrections between resamplings."""
    recovery: tuple[float, float]
    """Decay rates of the slow and the fast average weight; 0 switches recovery off."""
    beam_skip: float | None
    """beam_skip_threshold if do_beamskip is true: the share of the particles that must explain a beam."""
    update_min: tuple[float, float]
    """Least translation along x or y [m] and least turn [rad] before the next correction."""
    max_beams: int
    """Most beams of a scan that nav2_amcl uses."""
    range_limits: tuple[float | None, float | None]
    """laser_min_range and laser_max_range [m]; None keeps the scan's limit."""
    frames: tuple[str, str, str]
    """Frames of the map, the odometry and the robot's base."""
    topics: tuple[str, str]
    """Topics of the map and the scans."""
    tf_broadcast: bool
    """Whether to send the transform from map to odometry."""
    transform_tolerance: float
    """Time added to the transform's stamp [s]."""
    initial_pose: tuple[float, float, float] | None
    """The robot's first pose (x, y, yaw) [m, m, rad], or None."""
    initial_covariance: Matrix | None
    """(3, 3) covariance of the first pose, from Beluga's ``initial_pose.covariance_x`` and so on, or None."""
    ignored: tuple[str, ...]
    """Names of other parameters in the file, without effect here."""

    def make_model(
        self, grid: OccupancyGrid, scanner: Scanner, *, compat: bool = False, **options: Any
    ) -> BeamModel | LikelihoodFieldModel:
        """Make the measurement model.

        Args:
            grid: The map.
            scanner: The scanner.
            compat: True for nav2_amcl's weights, by ``weights``; False for the book's log p, by ``parameters``.
            options: Options of :class:`BeamModel` or :class:`LikelihoodFieldModel`, such as ``backend``.

        Raises:
            TypeError, ValueError: As these classes do.
        """
        chosen: Any = self.weights if compat else self.parameters
        if compat:
            options["compat"] = Amcl(prob=self.model == "likelihood_field_prob")
        kind: Any = BeamModel if self.model == "beam" else LikelihoodFieldModel
        return cast("BeamModel | LikelihoodFieldModel", kind(grid, scanner, chosen, **options))

    def make_motion(self) -> MotionModel:
        """Make the motion model from the fitted noise, or else from ``alpha`` and the defaults of gpusense."""
        if self.motion == "omni":
            return OmniMotion(self.alpha)
        return OdometryMotion(self.alpha[:4]) if self.odometry is None else self.odometry

    def make_filter(self, models: Any, **options: Any) -> ParticleFilter:
        """Make a particle filter with motion, number of particles, recovery and beam skipping.

        Recovery is "augmented", with gpusense's rates, if both numbers of ``recovery`` are positive.

        Args:
            models: A measurement model, or several.
            options: Further options of :class:`ParticleFilter`, or replacements of the file's.

        Raises:
            TypeError, ValueError: As the class does.
        """
        from gpusense.localization.filter import ParticleFilter

        chosen: dict[str, Any] = dict(
            motion=self.make_motion(), particles=self.particles, beam_skip=self.beam_skip,
            recovery="augmented" if all(self.recovery) else None,
        )  # fmt: skip
        return ParticleFilter(models, **(chosen | options))


def from_nav2(source: str | os.PathLike[str] | Mapping[str, Any], *, node: str | None = None) -> Nav2Options:
    """Read the parameters of nav2_amcl's node from a YAML file or a mapping, without ROS.

    A missing parameter takes the node's default. A dotted name (``initial_pose.x``) and a mapping (``initial_pose: {x:
    ...}``) are equivalent. The file is read as plain data and never executed. The book's parameters keep the
    proportions of the weights. In a file of ``gpusense fit``, ``beam_model`` (with offset and growth) becomes
    ``parameters``, and ``odometry_motion`` becomes ``odometry``.

    Args:
        source: The file of parameters, or its content: a mapping with ``amcl: ros__parameters:`` in any namespace, or
            the mapping of the parameters themselves.
        node: Name of the node, with or without its namespaces, such as ``"/robot1/amcl"``; None for the only amcl.
            Names in the file match as in ROS 2: ``*`` is one level, ``**`` any number, and the exact name wins.

    Returns:
        The options: model, parameters, motion, particles, gates, frames.

    Raises:
        FileNotFoundError: The file is missing.
        TypeError: A value has the wrong type; the message names the parameter.
        ValueError: A value breaks its rule, the file has parameters for no such node or for several, or uses amcl's
            names of ROS 1.

    Warns:
        UserWarning: A wildcard in the file overrides the exact name in ROS 2, or a name of ROS 1 has no effect there.

    Example:
        >>> import gpusense as gs
        >>> gs.compat.from_nav2({"amcl": {"ros__parameters": {"update_min_d": 0.1}}}).update_min
        (0.1, 0.2)
    """
    content, name = _content(source)
    found = parameters_of(content, name, node, (*DEFAULTS, *START_NAMES))
    robot = _ROBOTS[
        checks.choice("robot_model_type", found.get("robot_model_type", DEFAULTS["robot_model_type"]), tuple(_ROBOTS))
    ]
    odometry = _odometry(content, name) if robot == "differential" else None
    if odometry is not None:
        found = {f"alpha{k}": value for k, value in enumerate(odometry.alpha, 1)} | found
    values = {key: _value(name, key, found.get(key, default), default) for key, default in DEFAULTS.items()}
    model = checks.choice("laser_model_type", values["laser_model_type"], _MODELS)
    weights = _weights(model, values)
    fitted = content.get("beam_model") if model == "beam" else None
    near, far = values["laser_min_range"], values["laser_max_range"]
    return Nav2Options(
        model=cast(LaserModel, model),
        weights=weights,
        parameters=_normalized(weights) if fitted is None else BeamParameters.from_dict(fitted),
        alpha=cast(Any, tuple(checks.real(f"alpha{k}", values[f"alpha{k}"], low=0) for k in range(1, 6))),
        odometry=odometry,
        motion=cast(Any, robot),
        particles=_particles(values),
        pf_err=checks.real("pf_err", values["pf_err"], above=0),
        pf_z=checks.real("pf_z", values["pf_z"], above=0),
        resample_interval=checks.integer("resample_interval", values["resample_interval"], low=1),
        recovery=cast(Any, tuple(checks.real(key, values[key], low=0, high=1) for key in _RECOVERY)),
        beam_skip=checks.real(_SKIPS, values[_SKIPS], above=0, below=1) if values["do_beamskip"] else None,
        update_min=(values["update_min_d"], values["update_min_a"]),
        max_beams=checks.integer("max_beams", values["max_beams"], low=1),
        range_limits=(near if near >= 0 else None, far if far > 0 else None),
        frames=(values["global_frame_id"], values["odom_frame_id"], values["base_frame_id"]),
        topics=(values["map_topic"], values["scan_topic"]),
        tf_broadcast=values["tf_broadcast"],
        transform_tolerance=values["transform_tolerance"],
        initial_pose=first_pose(name, found) if values["set_initial_pose"] else None,
        initial_covariance=first_covariance(name, found) if values["set_initial_pose"] else None,
        ignored=tuple(sorted(key for key in found if key not in DEFAULTS and key not in START_NAMES)),
    )


def has_parameters(content: Mapping[Any, Any]) -> bool:
    """Return whether a file contains parameters of ROS nodes, or amcl's parameters without a node."""
    flat = (*DEFAULTS, *ROS_1)
    inner = content.get("amcl")
    return any(key in content or (isinstance(inner, Mapping) and key in inner) for key in flat) or any(
        True for _ in nodes_of(content)
    )


def _content(source: str | os.PathLike[str] | Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
    """Return the mapping of a file or of a user, and its name in messages."""
    if isinstance(source, Mapping):
        return source, "source"
    file = checks.existing_file(checks.path("source", source))
    return read_mapping(file), str(file)


def _value(name: str, key: str, value: object, default: object) -> Any:
    """Return a parameter's value as the type of its default."""
    place = f"{name}: {key}"
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise TypeError(f"{place}: must be true or false, got {checks.show(value)}")
        return value
    if isinstance(default, str):
        if not isinstance(value, str):
            raise TypeError(f"{place}: must be a string, got {checks.show(value)}")
        return value
    return checks.integer(place, value) if isinstance(default, int) else checks.real(place, value)


def _odometry(content: Mapping[str, Any], name: str) -> OdometryMotion | None:
    """Return the noise from gpusense fit, or None."""
    if "odometry_motion" not in content:
        return None
    try:
        return OdometryMotion.from_dict(content["odometry_motion"])
    except (TypeError, ValueError) as error:
        raise type(error)(f"{name}: odometry_motion: {error}") from None


def _particles(values: Mapping[str, Any]) -> tuple[int, int]:
    """Return the least and the largest number of particles."""
    least, most = (checks.integer(key, values[key], low=1) for key in ("min_particles", "max_particles"))
    if least > most:
        raise ValueError(f"min_particles: must be <= max_particles = {most}, got {least}")
    return least, most


def _weights(model: str, v: Mapping[str, Any]) -> BeamWeights | FieldWeights:
    if model == "beam":
        return BeamWeights(v["z_hit"], v["z_short"], v["z_max"], v["z_rand"], v["sigma_hit"], v["lambda_short"])
    # nav2_amcl's likelihood fields ignore z_max.
    return FieldWeights(
        z_hit=v["z_hit"], z_max=0.0, z_rand=v["z_rand"], sigma_hit=v["sigma_hit"],
        max_distance=v["laser_likelihood_max_dist"],
    )  # fmt: skip


def _normalized(weights: BeamWeights | FieldWeights) -> BeamParameters | LikelihoodFieldParameters:
    """Return the book's parameters with weights in the same proportion."""
    values = weights.to_dict()
    names = [name for name in values if name.startswith("z_")]
    total = sum(values[name] for name in names)
    if not total > 0:
        raise ValueError(f"{' + '.join(names)}: must be > 0, got {total}")
    values |= {name: values[name] / total for name in names}
    return BeamParameters.from_dict(values) if isinstance(weights, BeamWeights) else (
        LikelihoodFieldParameters.from_dict(values)
    )  # fmt: skip
