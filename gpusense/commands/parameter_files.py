"""Files of parameters: ``gpusense fit`` writes them, other commands read them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gpusense.commands.fit import Result
    from gpusense.world.parameters import BeamParameters


def read_beam_parameters(path: Path) -> BeamParameters:
    """Read the mapping ``beam_model`` of a YAML file.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: the file lacks the mapping, or a parameter breaks its rule.
    """
    from gpusense.world.parameters import BeamParameters

    values = _content(path).get("beam_model")
    return _made(path, "beam_model", values, BeamParameters.from_dict)


def read_localization(path: Path) -> tuple[BeamParameters | None, dict[str, Any]]:
    """Read the mappings ``beam_model`` and ``odometry_motion`` of a YAML file.

    Returns:
        The parameters of the beam model, or None; arguments of :class:`OdometryMotion`, none without the mapping.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: the file has neither, or a parameter breaks its rule.
    """
    from gpusense._util import checks
    from gpusense.localization.motion import OdometryMotion

    content = _content(path)
    if not content.keys() & {"beam_model", "odometry_motion"}:
        raise ValueError(f"{path}: must hold a mapping beam_model or odometry_motion, got {checks.show(list(content))}")
    beam = read_beam_parameters(path) if "beam_model" in content else None
    if "odometry_motion" not in content:
        return beam, {}
    values = content["odometry_motion"]
    _made(path, "odometry_motion", values, OdometryMotion.from_dict)
    return beam, values


def _content(path: Path) -> dict[Any, Any]:
    from gpusense._util import checks
    from gpusense._util.documents import read_mapping

    return read_mapping(checks.existing_file(path))


def _made(path: Path, name: str, values: Any, make: Any) -> Any:
    """Return what is made of a mapping of a file.

    Raises:
        ValueError: it is no mapping, or a parameter breaks its rule.
    """
    from gpusense._util import checks

    if not isinstance(values, dict):
        raise ValueError(f"{path}: must hold a mapping {name}, got {checks.show(values)}")
    try:
        return make(values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {name}: {error}") from None


def parameters_yaml(result: Result) -> str:
    """Format the fitted parameters as YAML for gpusense and for nav2_amcl."""
    import yaml

    def block(name: str, mapping: dict[str, Any]) -> str:
        return str(yaml.safe_dump({name: mapping}, sort_keys=False)).rstrip()

    values = {name: float(value) for name, value in result.fit.parameters.to_dict().items()}
    lines = [
        f"# gpusense fit: {result.fit.hits} ranges and {result.fit.max_readings} readings without return; "
        f"{result.fit.status}",
        "# For gpusense: gs.BeamParameters.from_dict(...) takes the mapping beam_model.",
        block("beam_model", values),
    ]
    if result.incidence is not None:
        lines.append("# For gpusense: gs.IncidenceParameters.from_dict(...).")
        lines.append(block("incidence_model", result.incidence.parameters.to_dict()))
    if result.motion is not None:
        lines.append(
            "# For 'gpusense localize --params': OdometryMotion. nav2_amcl lacks least, sideways and systematic:"
        )
        lines.append("# alpha alone is too little noise there.")
        lines.append(block("odometry_motion", _plain(asdict(result.motion.motion))))
    own = ("range_bias", "sigma_growth")
    shared = {name: value for name, value in values.items() if name not in own}
    nav2 = {"laser_model_type": "beam", **shared, "laser_max_range": float(result.data.range_max)}
    lines += [
        "# For nav2_amcl: paste below amcl's ros__parameters. Its beam model sums cubes of densities that are not",
        "# normalised, so the likeliest parameters need not be the best ones there. laser_likelihood_max_dist belongs",
        "# to its likelihood field, which this fit does not cover. It has no range_bias.",
        block("amcl", {"ros__parameters": nav2}),
    ]
    return "\n".join(lines) + "\n"


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Return a mapping with lists in place of tuples."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
