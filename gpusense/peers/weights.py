"""Compute the weights of nav2_amcl and Beluga, for ``compat="amcl"`` and ``compat="beluga"``.

``BeamModel(..., compat="amcl")`` and ``LikelihoodFieldModel(..., compat="beluga")`` return the logarithm of the factor
that these programs apply to a particle's weight. These factors are not likelihoods:

========  ======================  =====================================================================
peer      model                   weight
========  ======================  =====================================================================
amcl      beam                    ``1 + sum p^3``, the normal and the exponential density not normalised
amcl      likelihood field        ``1 + sum p^3``, the normal density not normalised
amcl      likelihood field, prob  ``product p``, the normal density not normalised
beluga    beam                    ``sum p^3``, book table 6.1 with both normalisers
beluga    likelihood field        ``1 + sum p^3``, the normal density normalised for an unbounded range
beluga    likelihood field, prob  ``product p``, the normal density normalised for an unbounded range
========  ======================  =====================================================================

*Readings.* amcl: a reading of at most range_min, including -inf, is a max reading, and NaN is ignored. Its beam model
scores a reading of exactly range_max as ``z_hit exp(...) + z_max``, and a longer one as ``z_hit exp(...)``, 0 for +inf;
its likelihood field ignores both. Beluga ignores readings outside [range_min, range_max], including +inf. Its beam
model scores a reading of exactly range_max as ``z_hit p_hit + z_max``; its likelihood field treats it as a range.

*Cells.* 0 is free and 100 is occupied. All other values (-1, and intermediate occupancies of maps in mode ``scale``)
stop beams in the beam models, but are no obstacles in the likelihood fields. ``occupied_threshold`` has no effect.

*Beams* of the beam models follow Bresenham's lines, see ``gpusense.casters.Bresenham``. amcl's lines extend one cell
beyond the ray's end, and distances between cells may exceed range_max; the map's edge stops them, and a particle off
the map measures 0. Beluga's ranges are range_max beyond the map's edge and for a particle off the map.

*Likelihood fields.* An end point off the map counts as ``max_distance`` for amcl and as a density of ``1 / range_max``
for Beluga. Cells hold float32 numbers: amcl's distances, Beluga's densities.

*Not reproduced:* errors of the peers' distance transforms; amcl's shift of map look-ups by half a cell, equivalent to
an origin half a cell lower in x and y; Beluga's beams from the robot's origin instead of the sensor's.

Versions: nav2_amcl 1.5.0 and Beluga 2.1.1, with the default parameters of their nodes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gpusense._util import checks
from gpusense.world.grid import OccupancyGrid
from gpusense.world.likelihood import Likelihood
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.range_causes import RandomDensity
from gpusense.world.scanner import Scanner

_OCCUPIED, _UNKNOWN = 100, -1
# Mark of a cell of fixed density in a likelihood field's mask.
OVERLAID = 2


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


@dataclass(frozen=True)
class Peer(Likelihood, ABC):
    """Weights of another program, reproduced by ``compat``.

    Args:
        prob: True if the likelihood field is the peer's ``likelihood_field_prob``, a product of densities.
    """

    prob: bool = False

    beam: ClassVar[BeamWeights] = BeamWeights()
    field: ClassVar[FieldWeights] = FieldWeights()
    unknown = "occupied"
    caster = "bresenham"
    is_peer = True

    def __post_init__(self) -> None:
        checks.boolean("prob", self.prob)

    @property
    def cubes(self) -> bool:
        """See Likelihood."""
        return not self.prob

    def obstacles(self, grid: OccupancyGrid, unknown: str) -> np.ndarray:
        """See Likelihood.obstacles; cells that are neither free nor occupied are unknown."""
        return grid.cells != 0 if unknown == "occupied" else grid.cells == _OCCUPIED

    @abstractmethod
    def field_values(
        self, squared: np.ndarray, p: LikelihoodFieldParameters, resolution: float, range_max: float
    ) -> np.ndarray:
        """Return densities at squared distances [cells^2] from the nearest obstacle."""

    @abstractmethod
    def beyond(self, p: LikelihoodFieldParameters, range_max: float) -> float:
        """Return the density of end points off the map."""

    def terms(self, density: np.ndarray | float) -> np.ndarray:
        """Return the terms of the likelihood field's sum."""
        with np.errstate(divide="ignore"):
            return np.log(density) if self.prob else np.asarray(density) ** 3


@dataclass(frozen=True)
class Amcl(Peer):
    """Weights of nav2_amcl 1.5.0.

    Args:
        prob: True if the likelihood field is ``likelihood_field_prob`` without beam skipping, a product of densities.

    Raises:
        TypeError: ``prob`` is neither True nor False.

    Example:
        >>> import gpusense as gs
        >>> grid = gs.OccupancyGrid([[0] * 20 + [100]], resolution=0.1)
        >>> weights = gs.compat.Amcl(prob=True)
        >>> model = gs.LikelihoodFieldModel(grid, gs.Scanner([0.0], range_max=4.0), compat=weights, backend="numpy")
        >>> round(float(model.log_likelihood([(0.05, 0.05, 0.0)], [2.0])[0]), 3)
        -0.47
    """

    name = "amcl"
    constant_term = 1.0
    outside = "occupied"

    def readings(self, ranges: np.ndarray, scanner: Scanner, field: bool) -> np.ndarray:
        """Convert readings to the peer's classes: NaN and inf are ignored, all other readings are ranges.

        Returns:
            float64 readings of the same shape.
        """
        nearest, farthest = _limits(scanner, ranges.dtype)
        max_reading = (ranges <= nearest) | (ranges == farthest)
        z = np.where(max_reading, scanner.range_max, ranges.astype(np.float64))
        return np.where(z >= scanner.range_max, np.inf, z) if field else z

    def field_values(
        self, squared: np.ndarray, p: LikelihoodFieldParameters, resolution: float, range_max: float
    ) -> np.ndarray:
        """See Peer.field_values; distances are float32 numbers, of at most max_distance in whole cells."""
        cells = np.sqrt(squared)
        distance = np.where(cells > int(p.max_distance / resolution), p.max_distance, cells * resolution)
        return _unnormalised(distance.astype(np.float32).astype(np.float64), p, range_max)

    def beyond(self, p: LikelihoodFieldParameters, range_max: float) -> float:
        return float(_unnormalised(np.array(p.max_distance), p, range_max))


@dataclass(frozen=True)
class Beluga(Peer):
    """Weights of Beluga 2.1.1 with the defaults of its node ``beluga_amcl``.

    Args:
        prob: True if the likelihood field is ``likelihood_field_prob``, a product of densities.
        model_unknown_space: True if unknown cells have the density ``1 / range_max`` in the likelihood field, if that
            exceeds the density at ``max_distance``; with ``only_obstacle_boundaries`` so do occupied cells without a
            free neighbour.
        only_obstacle_boundaries: True if only occupied cells next to a free cell are obstacles of the likelihood
            field. None is the node's default: True, but False with ``prob``, which does not receive the option.

    Raises:
        TypeError: An option has the wrong type.

    Example:
        >>> import gpusense as gs
        >>> grid = gs.OccupancyGrid([[0] * 20 + [-1]], resolution=0.1)
        >>> weights = gs.compat.Beluga(model_unknown_space=True)
        >>> model = gs.LikelihoodFieldModel(grid, gs.Scanner([0.0], range_max=4.0), compat=weights, backend="numpy")
        >>> round(float(model.log_likelihood([(0.05, 0.05, 0.0)], [2.0])[0]), 4)
        0.0155
    """

    model_unknown_space: bool = False
    only_obstacle_boundaries: bool | None = None

    name = "beluga"
    # Defaults of the library's headers; the node overrides them.
    library: ClassVar[BeamWeights] = BeamWeights(z_short=0.5, z_rand=0.05)

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.boolean("model_unknown_space", self.model_unknown_space)
        if self.only_obstacle_boundaries is not None:
            checks.boolean("only_obstacle_boundaries", self.only_obstacle_boundaries)

    @property
    def boundaries(self) -> bool:
        """Return whether only occupied cells next to a free cell are obstacles of the likelihood field."""
        return not self.prob if self.only_obstacle_boundaries is None else self.only_obstacle_boundaries

    @property
    def overlaid(self) -> bool:
        """See Likelihood."""
        return self.model_unknown_space

    @property
    def neighbors(self) -> int:
        """See Likelihood."""
        return int(self.boundaries)

    def readings(self, ranges: np.ndarray, scanner: Scanner, field: bool) -> np.ndarray:
        """See Amcl.readings; readings outside [range_min, range_max] are ignored."""
        nearest, farthest = _limits(scanner, ranges.dtype)
        inside = (ranges >= nearest) & (ranges <= farthest)
        z = np.where(ranges == farthest, scanner.range_max, ranges.astype(np.float64))
        return np.where(inside, z, np.nan)

    def field_obstacles(self, grid: OccupancyGrid, unknown: str) -> np.ndarray:
        """See Likelihood.field_obstacles; with model_unknown_space, OVERLAID marks cells of a fixed density."""
        occupied = self.obstacles(grid, unknown)
        obstacles = occupied & _beside(grid.cells == 0) if self.boundaries else occupied
        if not self.model_unknown_space:
            return obstacles
        overlaid = (grid.cells == _UNKNOWN) | (occupied & ~obstacles)
        return np.where(overlaid, np.uint8(OVERLAID), obstacles.astype(np.uint8))

    def field_values(
        self, squared: np.ndarray, p: LikelihoodFieldParameters, resolution: float, range_max: float
    ) -> np.ndarray:
        """See Peer.field_values; squared distances and densities are float32 numbers."""
        farthest = np.float32(p.max_distance * p.max_distance)
        return _normalised(np.minimum((squared * resolution * resolution).astype(np.float32), farthest), p, range_max)

    def beyond(self, p: LikelihoodFieldParameters, range_max: float) -> float:
        return float(np.float32(RandomDensity(range_max).peak(1)))

    def overlay(self, p: LikelihoodFieldParameters, range_max: float) -> float:
        """Return the density of OVERLAID cells from Beluga's squared distance for ``1 / range_max``."""
        farthest = np.float32(p.max_distance * p.max_distance)
        rand = RandomDensity(range_max)
        share = (rand.peak(1) - rand.peak(p.z_rand)) / _amplitude(p) if p.z_hit > 0 else 0.0
        # A mixture without a normal part has no such distance.
        background = np.float32(-2 * p.sigma_hit * p.sigma_hit * math.log(share)) if share > 0 else farthest
        return float(_normalised(np.minimum(background, farthest), p, range_max))


PEERS: dict[str, Peer] = {"amcl": Amcl(), "beluga": Beluga()}
LIKELIHOOD = Likelihood()


def choose(compat: object) -> Likelihood:
    """Return the peer that ``compat`` names, or ``compat`` if it is a peer; the book's likelihood for None."""
    if isinstance(compat, (Amcl, Beluga)):
        return compat
    return LIKELIHOOD if compat is None else PEERS[checks.choice("compat", compat, tuple(PEERS))]


def check_weights(parameters: BeamParameters | LikelihoodFieldParameters, compat: object) -> None:
    """Check that peers' weights come with ``compat``, and ``compat`` with normal hits."""
    if compat is not None and parameters.hit != "normal":
        raise ValueError(f"hit: must be 'normal' with compat, as in that program, got {parameters.hit!r}")
    if compat is None and isinstance(parameters, (BeamWeights, FieldWeights)):
        raise ValueError(f"parameters: weights must sum to 1 unless compat is given, got {checks.show(parameters)}")


def _limits(scanner: Scanner, kind: np.dtype) -> tuple[np.floating, np.floating]:
    """Return the scanner's limits, rounded to the type of the readings."""
    real = kind.type if kind.kind == "f" else np.float64
    with np.errstate(over="ignore"):
        return real(scanner.range_min), real(scanner.range_max)


def _beside(free: np.ndarray) -> np.ndarray:
    """Return the mask of cells that have one of four neighbours in ``free``."""
    near = np.zeros_like(free)
    near[1:] |= free[:-1]
    near[:-1] |= free[1:]
    near[:, 1:] |= free[:, :-1]
    near[:, :-1] |= free[:, 1:]
    return near


def _unnormalised(distance: np.ndarray, p: LikelihoodFieldParameters, range_max: float) -> np.ndarray:
    """Return nav2_amcl's density at distances [m]."""
    normal = np.exp(-(distance * distance) / (2 * p.sigma_hit * p.sigma_hit))
    return np.asarray(p.z_hit * normal + RandomDensity(range_max).peak(p.z_rand))


def _amplitude(p: LikelihoodFieldParameters) -> float:
    return p.z_hit / (p.sigma_hit * math.sqrt(2 * math.pi))


def _normalised(squared: np.ndarray, p: LikelihoodFieldParameters, range_max: float) -> np.ndarray:
    """Return Beluga's density at squared distances [m^2], rounded to float32."""
    normal = np.exp(-np.asarray(squared, np.float64) / (2 * p.sigma_hit * p.sigma_hit))
    return np.asarray((_amplitude(p) * normal + RandomDensity(range_max).peak(p.z_rand)).astype(np.float32), np.float64)
