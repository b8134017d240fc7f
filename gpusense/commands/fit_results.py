"""Results of ``gpusense fit``, complete or partial after an interrupt."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gpusense.commands.output import print_json

if TYPE_CHECKING:
    from gpusense.evaluation.held_out import HeldOut
    from gpusense.evaluation.range_data import RangeData
    from gpusense.learning.beam.incidence import IncidenceFit
    from gpusense.learning.beam.result import BeamFit
    from gpusense.localization.motion_fit import MotionFit
    from gpusense.world.parameters import BeamParameters


@dataclass(frozen=True)
class FitResult:
    """Result of the command.

    Attributes:
        data: The readings of the fit.
        fit: The fit.
        incidence: The fit by angles of incidence, or None.
        held_out: The comparison on held-out readings; empty without ``--holdout``.
        held_out_readings: Number of held-out readings.
        motion: The noise of the odometry, or None.
    """

    data: RangeData
    fit: BeamFit
    incidence: IncidenceFit | None
    held_out: list[HeldOut]
    held_out_readings: int
    motion: MotionFit | None = None


@dataclass
class PartialFit:
    """Results before an interrupt.

    Attributes:
        iteration, log_likelihood, parameters: The likeliest parameters so far; None before the first iteration.
        fit: The fit, after its end.
    """

    iteration: int = 0
    log_likelihood: float = -math.inf
    parameters: BeamParameters | None = None
    fit: BeamFit | None = None

    def see(self, iteration: int, log_likelihood: float, parameters: BeamParameters) -> None:
        """Record an iteration of the search."""
        if log_likelihood > self.log_likelihood:
            self.iteration, self.log_likelihood, self.parameters = iteration, log_likelihood, parameters

    def print(self, *, json: bool) -> None:
        """Print the results, if any."""
        best = self.parameters if self.fit is None else self.fit.parameters
        if best is None:
            return
        if json:
            fit = None if self.fit is None else self.fit.to_dict()
            print_json({"interrupted": True, "parameters": best.to_dict(), "fit": fit})
        elif self.fit is not None:
            print(f"{self.fit}\ninterrupted: this fit had ended, the rest had not")
        else:
            values = "\n".join(f"  {name:12} {value:.6g}" for name, value in best.to_dict().items())
            print(f"interrupted: best parameters up to iteration {self.iteration}, before convergence\n{values}")
            print(f"log-likelihood {self.log_likelihood:.3f}")
