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
    from gpusense.grid import OccupancyGrid
    from gpusense.landmarks import LandmarkMap
    from gpusense.logs import Odometry, Scan, read_log
    from gpusense.map_io import read_map, write_map
    from gpusense.models.beam import BeamModel
    from gpusense.models.caster import CasterMethod, RayCaster
    from gpusense.models.field import LikelihoodFieldModel
    from gpusense.models.landmark import LandmarkModel
    from gpusense.parameters import BeamParameters, IncidenceParameters, LandmarkParameters, LikelihoodFieldParameters
    from gpusense.prepare import distance_transform
    from gpusense.scanner import Reading, Scanner, classify
    from gpusense.weights import Weights, normalize_weights, resample

_HOME = {
    "BeamModel": "gpusense.models.beam",
    "BeamParameters": "gpusense.parameters",
    "CasterMethod": "gpusense.models.caster",
    "Device": "gpusense.backends",
    "IncidenceParameters": "gpusense.parameters",
    "LandmarkMap": "gpusense.landmarks",
    "LandmarkModel": "gpusense.models.landmark",
    "LandmarkParameters": "gpusense.parameters",
    "LikelihoodFieldModel": "gpusense.models.field",
    "LikelihoodFieldParameters": "gpusense.parameters",
    "OccupancyGrid": "gpusense.grid",
    "Odometry": "gpusense.logs",
    "RayCaster": "gpusense.models.caster",
    "Reading": "gpusense.scanner",
    "Scan": "gpusense.logs",
    "Scanner": "gpusense.scanner",
    "Weights": "gpusense.weights",
    "classify": "gpusense.scanner",
    "devices": "gpusense.backends",
    "distance_transform": "gpusense.prepare",
    "normalize_weights": "gpusense.weights",
    "read_log": "gpusense.logs",
    "read_map": "gpusense.map_io",
    "resample": "gpusense.weights",
    "write_map": "gpusense.map_io",
}

__all__ = [
    "BeamModel",
    "BeamParameters",
    "CasterMethod",
    "Device",
    "IncidenceParameters",
    "LandmarkMap",
    "LandmarkModel",
    "LandmarkParameters",
    "LikelihoodFieldModel",
    "LikelihoodFieldParameters",
    "OccupancyGrid",
    "Odometry",
    "RayCaster",
    "Reading",
    "Scan",
    "Scanner",
    "Weights",
    "__version__",
    "classify",
    "devices",
    "distance_transform",
    "normalize_weights",
    "read_log",
    "read_map",
    "resample",
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
