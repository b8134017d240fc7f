"""Parameters of the models of nav2_amcl and Beluga."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters


@dataclass(frozen=True)
class BeamWeights(BeamParameters):
    """Parameters of the peers' beam models; weights need not sum to 1. The defaults are those of both nodes.

    Raises:
        TypeError: A value is not a real number.
        ValueError: A value breaks its field's rule.
    """

    z_hit: float = 0.5
    z_short: float = 0.05
    z_max: float = 0.05
    z_rand: float = 0.5
    sigma_hit: float = 0.2
    lambda_short: float = 0.1

    _sum_is_one: ClassVar[bool] = False


@dataclass(frozen=True)
class FieldWeights(LikelihoodFieldParameters):
    """Parameters of the peers' likelihood fields; weights need not sum to 1. The defaults are those of both nodes.

    Raises:
        TypeError: A value is not a real number.
        ValueError: A value breaks its field's rule.
    """

    z_hit: float = 0.5
    z_max: float = 0.0
    z_rand: float = 0.5
    sigma_hit: float = 0.2
    max_distance: float = 2.0

    _sum_is_one: ClassVar[bool] = False
