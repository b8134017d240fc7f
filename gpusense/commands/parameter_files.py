"""Read files of parameters, which ``gpusense fit`` writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gpusense as gs
from gpusense._util import checks
from gpusense._util.documents import read_mapping
from gpusense.localization import nav2 as nav2_options

if TYPE_CHECKING:
    from gpusense.localization.nav2 import Nav2Options


def read_parameters(path: Path, name: str) -> gs.BeamParameters | gs.LikelihoodFieldParameters:
    """Read the mapping ``beam_model`` or ``likelihood_field`` of a YAML file."""
    make = gs.BeamParameters.from_dict if name == "beam_model" else gs.LikelihoodFieldParameters.from_dict
    values = read_mapping(checks.existing_file(path)).get(name)
    made: gs.BeamParameters | gs.LikelihoodFieldParameters = _made(path, name, values, make)
    return made


@dataclass(frozen=True)
class Localization:
    """Parameters for a localisation, from a file.

    Attributes:
        noise: Arguments of :class:`OdometryMotion`; may be empty.
        nav2: Options of nav2_amcl's node from a file of nav2, or None.
    """

    sensor: gs.BeamParameters | gs.LikelihoodFieldParameters | None
    noise: dict[str, Any]
    nav2: Nav2Options | None = None


def read_localization(path: Path, node: str | None = None) -> Localization:
    """Read ``beam_model`` and ``odometry_motion`` of a YAML file, or the parameters of nav2_amcl's ``node``."""
    content = read_mapping(checks.existing_file(path))
    models = [name for name in ("beam_model", "likelihood_field") if name in content]
    if nav2_options.has_parameters(content) and not models and "odometry_motion" not in content:
        try:
            options = nav2_options.from_nav2(path, node=node)
        except (TypeError, ValueError) as error:
            text = str(error)
            raise ValueError(text if text.startswith((str(path), "node: ")) else f"{path}: {text}") from None
        return Localization(options.parameters, {}, options)
    if node is not None:
        raise ValueError(f"--node: must come with a file of nav2's parameters, got {path}")
    if len(models) > 1:
        raise ValueError(f"{path}: must hold one of beam_model and likelihood_field, got both")
    if not models and "odometry_motion" not in content:
        rule = "must hold a mapping beam_model, likelihood_field or odometry_motion, or amcl's ros__parameters"
        raise ValueError(f"{path}: {rule}, got {checks.show(list(content))}")
    sensor = read_parameters(path, models[0]) if models else None
    values = content.get("odometry_motion", {})
    _made(path, "odometry_motion", values, gs.OdometryMotion.from_dict)
    return Localization(sensor, values)


def _made(path: Path, name: str, values: Any, make: Any) -> Any:
    """Build an object from a mapping of a file."""
    if not isinstance(values, dict):
        raise ValueError(f"{path}: must hold a mapping {name}, got {checks.show(values)}")
    try:
        return make(values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {name}: {error}") from None
