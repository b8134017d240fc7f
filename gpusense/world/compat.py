"""The weights that nav2_amcl and Beluga give a scan, for those who come from there: no likelihoods, and said so.

``BeamModel(..., compat="amcl")`` and ``LikelihoodFieldModel(..., compat="beluga")`` return the logarithm of the factor
by which these programs multiply a particle's weight:

========  ======================  =====================================================================
peer      model                   weight
========  ======================  =====================================================================
amcl      beam                    ``1 + sum p^3``, the normal and the exponential density not normalised
amcl      likelihood field        ``1 + sum p^3``, the normal density not normalised
beluga    beam                    ``sum p^3``, book table 6.1 with both normalisers
beluga    likelihood field        ``1 + sum p^3``, the normal density normalised for an unbounded range
========  ======================  =====================================================================

Readings are theirs, too. amcl: at range_min or below (-inf too) counts as a max reading, NaN is left out; a max
reading is scored by the beam model as ``z_hit exp(...) + z_max`` and left out by the likelihood field. Beluga: what is
not in [range_min, range_max] is left out, +inf too; a reading of exactly range_max is ``z_hit p_hit + z_max`` to the
beam model and a range to the likelihood field. Beams of the beam models go along Bresenham's lines; unknown cells stop
them, and so does, for amcl, the map's edge. An end point outside the map counts as ``max_distance`` for amcl and as a
density of ``1 / range_max`` for Beluga. What is not reproduced are errors of their map look-ups: distances are exact,
and cells are not shifted by half of one.

Source: read in nav2_amcl (``sensors/laser``) and Beluga (``sensor/beam_model.hpp``,
``likelihood_field_model_base.hpp``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gpusense._util import checks
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Scanner


@dataclass(frozen=True)
class BeamWeights(BeamParameters):
    """Parameters of the peers' beam models, whose weights need not sum to 1; the defaults are nav2_amcl's.

    Raises:
        TypeError: a value is not a real number.
        ValueError: a value breaks its field's rule.
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
    """Parameters of the peers' likelihood fields, whose weights need not sum to 1; the defaults are nav2_amcl's.

    Raises:
        TypeError: a value is not a real number.
        ValueError: a value breaks its field's rule.
    """

    z_hit: float = 0.5
    z_max: float = 0.0
    z_rand: float = 0.5
    sigma_hit: float = 0.2
    max_distance: float = 2.0

    _sum_is_one: ClassVar[bool] = False


@dataclass(frozen=True)
class Peer:
    """What a program does with a scan.

    Attributes:
        name: ``"amcl"`` or ``"beluga"``.
        beam: Default parameters of its beam model.
        field: Default parameters of its likelihood field.
        beam_lead: What the beam model's sum begins with.
        outside: What lies outside the grid for the beam model.
    """

    name: str
    beam: BeamWeights
    field: FieldWeights
    beam_lead: float
    outside: str

    def readings(self, ranges: np.ndarray, scanner: Scanner, field: bool) -> np.ndarray:
        """Readings as the program takes them: NaN is left out, range_max stays a reading, +inf is a max reading."""
        z = ranges.astype(np.float64)
        top = scanner.range_max
        if self.name == "amcl":
            z[z <= scanner.range_min] = np.inf
            return np.where(z >= top, np.inf if field else top, z)
        return np.where((z >= scanner.range_min) & (z <= top), z, np.nan)


PEERS = {
    "amcl": Peer("amcl", BeamWeights(), FieldWeights(), 1.0, "occupied"),
    "beluga": Peer("beluga", BeamWeights(z_short=0.5, z_rand=0.05), FieldWeights(max_distance=100.0), 0.0, "free"),
}


def choose(compat: object) -> Peer | None:
    """The peer of a name; None for none.

    Raises:
        TypeError: neither None nor a string.
        ValueError: no peer's name.
    """
    return None if compat is None else PEERS[checks.choice("compat", compat, tuple(PEERS))]


def check_weights(parameters: BeamParameters | LikelihoodFieldParameters, compat: object) -> None:
    """Refuse weights that need not sum to 1 where a likelihood is computed.

    Raises:
        ValueError: such weights without ``compat=``.
    """
    if compat is None and isinstance(parameters, (BeamWeights, FieldWeights)):
        raise ValueError(f"parameters: weights must sum to 1 unless compat is given, got {checks.show(parameters)}")
