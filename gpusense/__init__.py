"""gpusense: probabilistic range-sensor models at GPU speed on any vendor's GPU.

``P(z | x, m)``, the probability of a measurement z at pose x in map m, for thousands to millions of particles per scan.
Terms and formulas are those of Thrun, Burgard and Fox, *Probabilistic Robotics* (2005). Importing the package loads
NumPy alone; backends and drawing are loaded when they are asked for.
"""

from __future__ import annotations

import importlib
from typing import Any

from gpusense._util import pictures
from gpusense._version import __version__ as __version__

# The public names by their modules. Type checkers read the stub of this package, made from this table: run
# ``PYTHONPATH=tests python -m support.public_names`` after a change.
_NAMES = {
    "backends": ("Device", "devices"),
    "chaining.chain": ("chain_scans",),
    "chaining.result": ("ScanChain",),
    "evaluation.integrity": ("Integrity", "integrity"),
    "evaluation.judging": ("Judgement", "Stretch", "judge_trajectory"),
    "features.extract": ("extract_features",),
    "features.feature_map": ("FeatureMap",),
    "features.landmarks": ("landmarks_of_map", "map_features"),
    "features.result": ("Features",),
    "learning.beam.fit": ("fit_beam_parameters",),
    "learning.beam.incidence": ("IncidenceFit", "fit_incidence_parameters"),
    "learning.discrete.probabilities": ("DiscreteCauses",),
    "learning.discrete.table": ("DiscreteBeamModel",),
    "learning.fitted": ("BeamFit", "DiscreteFit", "LandmarkFit", "PointFit"),
    "learning.landmark.fit": ("fit_landmark_parameters",),
    "learning.landmark.pairs": ("suspicious_landmarks",),
    "learning.point.absolute": ("fit_heading_parameters", "fit_position_parameters"),
    "learning.point.beacons": ("fit_beacon_parameters",),
    "learning.point.bumper": ("fit_bumper_parameters",),
    "localization.diagnosis": ("Diagnosis",),
    "localization.estimates": ("Estimate",),
    "localization.filter": ("ParticleFilter",),
    "localization.monitor": ("PoseMonitor", "PoseVerdict"),
    "localization.motion": ("OdometryMotion", "OmniMotion", "VelocityMotion", "odometry_turns"),
    "localization.motion_fit": ("MotionFit", "fit_odometry_motion"),
    "world.pose_algebra": ("compose_poses", "invert_poses", "mean_pose", "pose_difference", "wrap_angle"),
    "localization.state": ("FilterState",),
    "localization.temperature": ("calibrate_temperature",),
    "localization.weights": ("Weights", "normalize_weights", "resample"),
    "logs": ("Odometry", "Scan", "check_mount", "read_log"),
    "mapping.build": ("build_map",),
    "matching.locate": ("locate_scan",),
    "matching.location": ("Location", "PoseMode"),
    "matching.match": ("match_scan",),
    "matching.match_map": ("MapMatch", "match_map"),
    "matching.pose_likelihood": ("PoseLikelihood", "pose_likelihood"),
    "matching.result": ("ScanMatch",),
    "models.landmark.lines": ("LineModel",),
    "models.landmark.model": ("LandmarkModel",),
    "models.point.absolute": ("HeadingModel", "PositionModel"),
    "models.point.beacons": ("BeaconModel",),
    "models.point.bumper": ("BumperModel",),
    "models.scan.beam": ("BeamModel",),
    "models.scan.bound": ("BoundCall",),
    "models.scan.caster": ("RayCaster",),
    "models.scan.field": ("LikelihoodFieldModel",),
    "models.scan.joint_scoring": ("log_likelihoods",),
    "positions.bearings": ("triangulate", "triangulate_triangle"),
    "positions.fix": ("PositionFix",),
    "positions.ranges": ("locate", "trilaterate"),
    "tables.crowd": ("Shapes",),
    "tables.distances": ("distance_transform",),
    "tables.normals": ("surface_normals",),
    "tables.worlds": ("Worlds",),
    "world.grid": ("OccupancyGrid",),
    "world.landmarks": ("LandmarkMap", "LineMap"),
    "world.map_files": ("read_map", "write_map"),
    "world.parameters": ("BeamParameters", "IncidenceParameters", "LandmarkParameters", "LikelihoodFieldParameters"),
    "world.plausible": ("PlausibilityWarning",),
    "world.scanner": ("Reading", "Scanner", "classify"),
    "world.deskew": ("deskew_scan",),
    "world.sensor_parameters": (
        "BeaconParameters",
        "BumperParameters",
        "HeadingParameters",
        "LineParameters",
        "PositionParameters",
    ),
}
# Public modules.
_MODULES = ("casters", "compat", "plots", "sweep", "worlds")

_HOME = {name: module for module, names in _NAMES.items() for name in names}

__all__ = sorted([*_HOME, "__version__"])


def __getattr__(name: str) -> Any:
    """Load a public name from its module on first use."""
    if name in _MODULES:
        return importlib.import_module(f"gpusense.{name}")
    if name not in _HOME:
        import difflib

        close = difflib.get_close_matches(name, __dir__(), n=1)
        raise AttributeError(
            f"module 'gpusense' has no attribute {name!r}" + (f"; did you mean {close[0]!r}?" if close else "")
        )
    value = getattr(importlib.import_module(f"gpusense.{_HOME[name]}"), name)
    globals()[name] = value
    return value


# ``plots`` lies above the rooms whose results have pictures: only this module may name both.
pictures.register(
    "pose likelihood",
    lambda result, path: importlib.import_module("gpusense.plots.pose_densities").pose_likelihood_figure(result, path),
)


def __dir__() -> list[str]:
    return sorted([*__all__, *_MODULES])
