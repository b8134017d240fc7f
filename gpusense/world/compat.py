"""Parameters and reading rules of nav2_amcl and Beluga, for ``compat="amcl"`` and ``compat="beluga"``.

``BeamModel(..., compat="amcl")`` and ``LikelihoodFieldModel(..., compat="beluga")`` return the logarithm of the factor
by which these programs multiply a particle's weight. These factors are no likelihoods:

========  ======================  =====================================================================
peer      model                   weight
========  ======================  =====================================================================
amcl      beam                    ``1 + sum p^3``, the normal and the exponential density not normalised
amcl      likelihood field        ``1 + sum p^3``, the normal density not normalised
beluga    beam                    ``sum p^3``, book table 6.1 with both normalisers
beluga    likelihood field        ``1 + sum p^3``, the normal density normalised for an unbounded range
========  ======================  =====================================================================

Readings are classed as the peer does. amcl: a reading of at most range_min (-inf too) counts as a max reading, and NaN
is left out. Its beam model scores a max reading as ``z_hit exp(...) + z_max``; its likelihood field leaves it out.
Beluga: a reading outside [range_min, range_max] is left out, +inf too. Its beam model scores a reading of exactly
range_max as ``z_hit p_hit + z_max``; to its likelihood field this reading is a range.

Beams of the beam models follow Bresenham's lines. Unknown cells stop them and, for amcl, so does the map's edge. An end
point outside the map counts as ``max_distance`` for amcl and as a density of ``1 / range_max`` for Beluga. Errors of
the peers' map look-ups are not reproduced: distances are exact, and cells are not shifted by half a cell.

Source: nav2_amcl (``sensors/laser``) and Beluga (``sensor/beam_model.hpp``, ``likelihood_field_model_base.hpp``).
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
    """Parameters of the peers' likelihood fields, whose weights need not sum to 1; the defaults are nav2_amcl's.

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


@dataclass(frozen=True)
class Likelihood:
    """The book's likelihoods: the rules of models without ``compat``.

    Attributes:
        name: None.
        beam: Default parameters of the beam model.
        field: Default parameters of the likelihood field.
        constant_term: First term of the beam model's sum over readings.
        outside: ``"free"`` or ``"occupied"``: state of space outside the grid for the beam model.
        cubes: Whether weights are sums of cubes, in place of products of densities.
        field_constant: First term of the likelihood field's sum over readings.
        caster: Default caster of the beam model.
        unknown: ``"free"`` or ``"occupied"``: state of unknown cells for the beam model.
    """

    name: str | None
    beam: BeamParameters
    field: LikelihoodFieldParameters
    constant_term: float
    outside: str

    cubes: ClassVar[bool] = False
    field_constant: ClassVar[float] = 0.0
    caster: ClassVar[str] = "exact"
    unknown: ClassVar[str] = "free"

    def readings(self, ranges: np.ndarray, scanner: Scanner, field: bool) -> np.ndarray:
        """Return readings as they are."""
        return ranges

    def without_readings(self, constant: float, first: float) -> float:
        """Return the sum of a scan without evaluated readings, from its constant term and the first term of sums."""
        return constant


@dataclass(frozen=True)
class Peer(Likelihood):
    """A program whose weights ``compat`` reproduces.

    Attributes:
        name: ``"amcl"`` or ``"beluga"``.
        beam: Default parameters of the peer's beam model.
        field: Default parameters of the peer's likelihood field.
        constant_term: First term of the beam model's sum over readings.
        outside: ``"free"`` or ``"occupied"``: state of space outside the grid for the beam model.
    """

    name: str
    beam: BeamWeights
    field: FieldWeights

    cubes = True
    field_constant = 1.0
    caster = "bresenham"
    unknown = "occupied"

    def without_readings(self, constant: float, first: float) -> float:
        """See Likelihood.without_readings; a sum of cubes has no constant terms."""
        with np.errstate(divide="ignore"):
            return float(np.log(first))

    def readings(self, ranges: np.ndarray, scanner: Scanner, field: bool) -> np.ndarray:
        """Convert readings to the peer's classes: NaN is left out, +inf is a max reading, all others are ranges.

        Args:
            ranges: Readings of any shape and value [m].
            scanner: The scanner.
            field: Whether the readings are for the likelihood field, not for the beam model.

        Returns:
            float64 readings of the same shape.
        """
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


LIKELIHOOD = Likelihood(None, BeamParameters(), LikelihoodFieldParameters(), 0.0, "free")


def choose(compat: object) -> Likelihood:
    """Return the peer that ``compat`` names; the book's likelihood for None.

    Raises:
        TypeError: ``compat`` is neither None nor a string.
        ValueError: ``compat`` names no peer.
    """
    return LIKELIHOOD if compat is None else PEERS[checks.choice("compat", compat, tuple(PEERS))]


def check_weights(parameters: BeamParameters | LikelihoodFieldParameters, compat: object) -> None:
    """Check that parameters whose weights need not sum to 1 are used with ``compat`` only.

    Raises:
        ValueError: ``parameters`` are a peer's weights and ``compat`` is None.
    """
    if compat is None and isinstance(parameters, (BeamWeights, FieldWeights)):
        raise ValueError(f"parameters: weights must sum to 1 unless compat is given, got {checks.show(parameters)}")
