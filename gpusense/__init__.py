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
    from gpusense.learning.beam.fit import fit_beam_parameters
    from gpusense.learning.beam.incidence import IncidenceFit, fit_incidence_parameters
    from gpusense.learning.beam.result import BeamFit
    from gpusense.learning.discrete.causes import DiscreteCauses, DiscreteFit
    from gpusense.learning.discrete.table import DiscreteBeamModel
    from gpusense.learning.landmark.fit import fit_landmark_parameters
    from gpusense.learning.landmark.result import LandmarkFit
    from gpusense.learning.landmark.suspicious import suspicious_landmarks
    from gpusense.localization.weights import Weights, normalize_weights, resample
    from gpusense.logs import Odometry, Scan, read_log
    from gpusense.models.landmark.model import LandmarkModel
    from gpusense.models.point.absolute import HeadingModel, PositionModel
    from gpusense.models.point.beacons import BeaconModel
    from gpusense.models.point.bumper import BumperModel
    from gpusense.models.scan.beam import BeamModel
    from gpusense.models.scan.bound import BoundCall
    from gpusense.models.scan.caster import CasterMethod, RayCaster
    from gpusense.models.scan.field import LikelihoodFieldModel
    from gpusense.models.scan.several import log_likelihoods
    from gpusense.positions.bearings import triangulate, triangulate_triangle
    from gpusense.positions.fix import PositionFix
    from gpusense.positions.locate import locate
    from gpusense.positions.ranges import trilaterate
    from gpusense.tables.distances import distance_transform
    from gpusense.tables.normals import surface_normals
    from gpusense.world.grid import OccupancyGrid
    from gpusense.world.landmarks import LandmarkMap
    from gpusense.world.map_files import read_map, write_map
    from gpusense.world.parameters import (
        BeamParameters,
        IncidenceParameters,
        LandmarkParameters,
        LikelihoodFieldParameters,
    )
    from gpusense.world.scanner import Reading, Scanner, classify
    from gpusense.world.sensor_parameters import (
        BeaconParameters,
        BumperParameters,
        HeadingParameters,
        PositionParameters,
    )

_HOME = {
    "BeaconModel": "gpusense.models.point.beacons",
    "BeaconParameters": "gpusense.world.sensor_parameters",
    "BeamFit": "gpusense.learning.beam.result",
    "BeamModel": "gpusense.models.scan.beam",
    "BeamParameters": "gpusense.world.parameters",
    "BoundCall": "gpusense.models.scan.bound",
    "BumperModel": "gpusense.models.point.bumper",
    "BumperParameters": "gpusense.world.sensor_parameters",
    "CasterMethod": "gpusense.models.scan.caster",
    "Device": "gpusense.backends",
    "DiscreteBeamModel": "gpusense.learning.discrete.table",
    "DiscreteCauses": "gpusense.learning.discrete.causes",
    "DiscreteFit": "gpusense.learning.discrete.causes",
    "HeadingModel": "gpusense.models.point.absolute",
    "HeadingParameters": "gpusense.world.sensor_parameters",
    "IncidenceFit": "gpusense.learning.beam.incidence",
    "IncidenceParameters": "gpusense.world.parameters",
    "LandmarkFit": "gpusense.learning.landmark.result",
    "LandmarkMap": "gpusense.world.landmarks",
    "LandmarkModel": "gpusense.models.landmark.model",
    "LandmarkParameters": "gpusense.world.parameters",
    "LikelihoodFieldModel": "gpusense.models.scan.field",
    "LikelihoodFieldParameters": "gpusense.world.parameters",
    "OccupancyGrid": "gpusense.world.grid",
    "Odometry": "gpusense.logs",
    "PositionFix": "gpusense.positions.fix",
    "PositionModel": "gpusense.models.point.absolute",
    "PositionParameters": "gpusense.world.sensor_parameters",
    "RayCaster": "gpusense.models.scan.caster",
    "Reading": "gpusense.world.scanner",
    "Scan": "gpusense.logs",
    "Scanner": "gpusense.world.scanner",
    "Weights": "gpusense.localization.weights",
    "classify": "gpusense.world.scanner",
    "devices": "gpusense.backends",
    "distance_transform": "gpusense.tables.distances",
    "fit_beam_parameters": "gpusense.learning.beam.fit",
    "fit_incidence_parameters": "gpusense.learning.beam.incidence",
    "fit_landmark_parameters": "gpusense.learning.landmark.fit",
    "locate": "gpusense.positions.locate",
    "log_likelihoods": "gpusense.models.scan.several",
    "normalize_weights": "gpusense.localization.weights",
    "read_log": "gpusense.logs",
    "read_map": "gpusense.world.map_files",
    "resample": "gpusense.localization.weights",
    "surface_normals": "gpusense.tables.normals",
    "suspicious_landmarks": "gpusense.learning.landmark.suspicious",
    "triangulate": "gpusense.positions.bearings",
    "triangulate_triangle": "gpusense.positions.bearings",
    "trilaterate": "gpusense.positions.ranges",
    "write_map": "gpusense.world.map_files",
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


# Public modules.
_MODULES = ("casters", "compat", "plots", "worlds")


def __getattr__(name: str) -> Any:
    """Load a public name from its module on first use."""
    if name in _MODULES:
        return importlib.import_module(f"gpusense.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'gpusense' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, *_MODULES])
