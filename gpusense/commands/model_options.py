"""Options that choose a beam model or a likelihood field, and the parameters that they select."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from gpusense.commands.arguments import number

if TYPE_CHECKING:
    from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters

_SHARED = ("z_hit", "z_max", "z_rand", "sigma_hit", "hit", "hit_dof")
_SPECIFIC = {"beam": ("z_short", "lambda_short"), "field": ("max_distance", "interpolation")}
_MEANING = {
    "z_hit": "weight of a correct range with noise",
    "z_max": "weight of 'no return'",
    "z_rand": "weight of a random reading; the weights must sum to 1",
    "sigma_hit": "deviation of a correct range, or of an end point from a wall [m]",
    "hit_dof": "degrees of freedom of --hit student, 1 to 1e6",
    "z_short": "weight of an unexpected obstacle; beam model only",
    "lambda_short": "rate of unexpected obstacles along a beam [1/m]; beam model only",
    "max_distance": "largest distance to an obstacle that counts [m]; field only",
}


def add_model(parser: argparse.ArgumentParser) -> None:
    """Add ``--model`` and ``--precision``."""
    add = parser.add_argument
    add("--model", choices=("beam", "field"), default="beam", help="measurement model (default: %(default)s)")
    add("--precision", choices=("float32", "float64"), default="float32", help="precision (default: %(default)s)")


def add_parameters(parser: argparse.ArgumentParser) -> None:
    """Add the group of the model's parameters."""
    from gpusense.world.hit_shapes import SHAPES

    group = parser.add_argument_group("parameters of the model")
    group.add_argument("--parameters", "--params", type=Path, metavar="YAML",
        help="a file with beam_model, such as 'gpusense fit --out' writes; beam model only")  # fmt: skip
    for name, meaning in _MEANING.items():
        group.add_argument(_option(name), type=number, metavar="X", help=meaning)
    group.add_argument("--hit", choices=tuple(SHAPES), help="shape of a correct range")
    group.add_argument("--interpolation", choices=("nearest", "bilinear"), help="look-up of the field; field only")


def parameters_of(args: argparse.Namespace) -> BeamParameters | LikelihoodFieldParameters:
    """Return the parameters of the model that the options choose."""
    from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters

    options = {name: getattr(args, name) for name in (*_SHARED, *_SPECIFIC["beam"], *_SPECIFIC["field"])}
    changes = {name: value for name, value in options.items() if value is not None}
    for name in changes:
        if name not in (*_SHARED, *_SPECIFIC[args.model]):
            raise ValueError(f"{_option(name)}: must be a parameter of the {args.model} model, got another model's")
    if args.model == "field":
        if args.parameters is not None:
            raise ValueError(f"--parameters: must be left out with the field, got {args.parameters}")
        return LikelihoodFieldParameters().replace(**changes)
    beam = BeamParameters()
    if args.parameters is not None:
        from gpusense.commands.parameter_files import read_beam_parameters

        beam = read_beam_parameters(args.parameters)
    return beam.replace(**changes)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
