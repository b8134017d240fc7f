"""Rules of the book's likelihoods, which the weights of other programs replace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Scanner


@dataclass(frozen=True)
class Likelihood:
    """Rules of the book's likelihoods, for models without ``compat``."""

    name: ClassVar[Any] = None
    # Default parameters of both models.
    beam: ClassVar[BeamParameters] = BeamParameters()
    field: ClassVar[LikelihoodFieldParameters] = LikelihoodFieldParameters.tracking()
    # Of the beam model: first term of the sum over readings, space outside the grid, unknown cells, default caster.
    constant_term: ClassVar[float] = 0.0
    outside: ClassVar[str] = "free"
    unknown: ClassVar[str] = "free"
    caster: ClassVar[str] = "exact"
    is_peer: ClassVar[bool] = False

    @property
    def cubes(self) -> bool:
        """Whether the likelihood field sums cubes of densities instead of logarithms."""
        return False

    @property
    def field_constant(self) -> float:
        """First term of the likelihood field's sum over readings."""
        return 1.0 if self.cubes else 0.0

    @property
    def overlaid(self) -> bool:
        """True if some cells of the likelihood field have a fixed density."""
        return False

    @property
    def neighbors(self) -> int:
        """Radius of the neighbourhood that determines a cell's state in a mask [cells]."""
        return 0

    def readings(self, ranges: np.ndarray, scanner: Scanner, field: bool) -> np.ndarray:
        """Return readings unchanged."""
        return ranges

    def without_readings(self, constant: float, first: float, *, cubes: bool) -> float:
        """Return the log-likelihood of a scan without evaluated readings.

        ``constant``: sum of its constant terms; ``cubes``: true if the model sums cubes, without constant terms.
        """
        with np.errstate(divide="ignore"):
            return float(np.log(first)) if cubes else constant

    def obstacles(self, grid: OccupancyGrid, unknown: str) -> np.ndarray:
        """Return the (H, W) mask of the cells that stop a beam; do not write to it."""
        return grid.obstacles("occupied" if unknown == "occupied" else "free")

    def field_obstacles(self, grid: OccupancyGrid, unknown: str) -> np.ndarray:
        """Return the (H, W) mask of the likelihood field's obstacles; do not write to it."""
        return self.obstacles(grid, unknown)
