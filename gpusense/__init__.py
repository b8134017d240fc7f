"""gpusense: probabilistic range-sensor models at GPU speed on any vendor's GPU.

``P(z | x, m)``, the probability of a measurement z at pose x in map m, for thousands to millions of particles per scan.
Terms and formulas are those of Thrun, Burgard and Fox, *Probabilistic Robotics* (2005). Importing the package loads
NumPy alone; backends and drawing are loaded when they are asked for.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gpusense._version import __version__

if TYPE_CHECKING:
    from gpusense.backends import Device, devices
    from gpusense.bound import BoundCall
    from gpusense.discrete import DiscreteBeamModel, DiscreteCauses, DiscreteFit
    from gpusense.grid import OccupancyGrid
    from gpusense.landmarks import LandmarkMap
    from gpusense.learning.fit import fit_beam_parameters
    from gpusense.learning.incidence import IncidenceFit, fit_incidence_parameters
    from gpusense.learning.landmark_result import LandmarkFit
    from gpusense.learning.landmarks import fit_landmark_parameters
    from gpusense.learning.result import BeamFit
    from gpusense.learning.suspicious import suspicious_landmarks
    from gpusense.logs import Odometry, Scan, read_log
    from gpusense.map_io import read_map, write_map
    from gpusense.models.absolute import HeadingModel, PositionModel
    from gpusense.models.beacons import BeaconModel
    from gpusense.models.beam import BeamModel
    from gpusense.models.bumper import BumperModel
    from gpusense.models.caster import CasterMethod, RayCaster
    from gpusense.models.field import LikelihoodFieldModel
    from gpusense.models.landmark import LandmarkModel
    from gpusense.models.several import log_likelihoods
    from gpusense.normals import surface_normals
    from gpusense.parameters import BeamParameters, IncidenceParameters, LandmarkParameters, LikelihoodFieldParameters
    from gpusense.positions.bearings import triangulate, triangulate_triangle
    from gpusense.positions.both import locate
    from gpusense.positions.fix import PositionFix
    from gpusense.positions.ranges import trilaterate
    from gpusense.prepare import distance_transform
    from gpusense.scanner import Reading, Scanner, classify
    from gpusense.sensor_parameters import BeaconParameters, BumperParameters, HeadingParameters, PositionParameters
    from gpusense.weights import Weights, normalize_weights, resample

_HOME = {
    "BeaconModel": "gpusense.models.beacons",
    "BeaconParameters": "gpusense.sensor_parameters",
    "BeamFit": "gpusense.learning.result",
    "BeamModel": "gpusense.models.beam",
    "BeamParameters": "gpusense.parameters",
    "BoundCall": "gpusense.bound",
    "BumperModel": "gpusense.models.bumper",
    "BumperParameters": "gpusense.sensor_parameters",
    "CasterMethod": "gpusense.models.caster",
    "Device": "gpusense.backends",
    "DiscreteBeamModel": "gpusense.discrete",
    "DiscreteCauses": "gpusense.discrete",
    "DiscreteFit": "gpusense.discrete",
    "HeadingModel": "gpusense.models.absolute",
    "HeadingParameters": "gpusense.sensor_parameters",
    "IncidenceFit": "gpusense.learning.incidence",
    "IncidenceParameters": "gpusense.parameters",
    "LandmarkFit": "gpusense.learning.landmark_result",
    "LandmarkMap": "gpusense.landmarks",
    "LandmarkModel": "gpusense.models.landmark",
    "LandmarkParameters": "gpusense.parameters",
    "LikelihoodFieldModel": "gpusense.models.field",
    "LikelihoodFieldParameters": "gpusense.parameters",
    "OccupancyGrid": "gpusense.grid",
    "Odometry": "gpusense.logs",
    "PositionFix": "gpusense.positions.fix",
    "PositionModel": "gpusense.models.absolute",
    "PositionParameters": "gpusense.sensor_parameters",
    "RayCaster": "gpusense.models.caster",
    "Reading": "gpusense.scanner",
    "Scan": "gpusense.logs",
    "Scanner": "gpusense.scanner",
    "Weights": "gpusense.weights",
    "classify": "gpusense.scanner",
    "devices": "gpusense.backends",
    "distance_transform": "gpusense.prepare",
    "fit_beam_parameters": "gpusense.learning.fit",
    "fit_incidence_parameters": "gpusense.learning.incidence",
    "fit_landmark_parameters": "gpusense.learning.landmarks",
    "locate": "gpusense.positions.both",
    "log_likelihoods": "gpusense.models.several",
    "normalize_weights": "gpusense.weights",
    "read_log": "gpusense.logs",
    "read_map": "gpusense.map_io",
    "resample": "gpusense.weights",
    "surface_normals": "gpusense.normals",
    "suspicious_landmarks": "gpusense.learning.suspicious",
    "triangulate": "gpusense.positions.bearings",
    "triangulate_triangle": "gpusense.positions.bearings",
    "trilaterate": "gpusense.positions.ranges",
    "write_map": "gpusense.map_io",
}

__all__ = [
    "BeaconModel",
    "BeaconParameters",
    "BeamFit",
    "BeamModel",
    "BeamParameters",
    "BoundCall",
    "BumperModel",
    "BumperParameters",
    "CasterMethod",
    "Device",
    "DiscreteBeamModel",
    "DiscreteCauses",
    "DiscreteFit",
    "HeadingModel",
    "HeadingParameters",
    "IncidenceFit",
    "IncidenceParameters",
    "LandmarkFit",
    "LandmarkMap",
    "LandmarkModel",
    "LandmarkParameters",
    "LikelihoodFieldModel",
    "LikelihoodFieldParameters",
    "OccupancyGrid",
    "Odometry",
    "PositionFix",
    "PositionModel",
    "PositionParameters",
    "RayCaster",
    "Reading",
    "Scan",
    "Scanner",
    "Weights",
    "__version__",
    "classify",
    "devices",
    "distance_transform",
    "fit_beam_parameters",
    "fit_incidence_parameters",
    "fit_landmark_parameters",
    "locate",
    "log_likelihoods",
    "normalize_weights",
    "read_log",
    "read_map",
    "resample",
    "surface_normals",
    "suspicious_landmarks",
    "triangulate",
    "triangulate_triangle",
    "trilaterate",
    "write_map",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its module on first use."""
    if name not in _HOME:
        raise AttributeError(f"module 'gpusense' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
