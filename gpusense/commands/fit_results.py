"""Results of ``gpusense fit``, complete or partial after an interrupt."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

from gpusense.commands import output
from gpusense.commands.output import length, rounded
from gpusense.evaluation.range_data import HeldOut, RangeData
from gpusense.learning.beam.incidence import IncidenceFit
from gpusense.learning.fitted import BeamFit
from gpusense.localization.motion_fit import MotionFit
from gpusense.world.parameters import BeamParameters

# A fit with less weight of correct ranges, a larger deviation of them [m], or more unexplained readings is doubtful.
_LEAST_HIT, _MOST_DEVIATION, _MOST_UNEXPLAINED = 0.3, 0.5, 0.25
# Largest share of unexplained readings of six recorded lasers in maps of their scans, see docs/learning.md.
_USUAL_UNEXPLAINED = 0.11
# An offset matters from this number of standard errors on, and from this share of sigma_hit.
_SURE, _NOTABLE = 3.0, 0.2
DOUBT = "readings are not near their expected ranges: map, poses or expected ranges may be wrong"
_UNITS = {"sigma_hit": "m", "lambda_short": "1/m", "range_bias": "m"}


@dataclass(frozen=True)
class FitResult:
    """Result of the command.

    Attributes:
        held_out: The comparison on held-out readings; empty without ``--holdout``.
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
        parameters: The likeliest parameters so far; None before the first iteration.
        fit: The fit, after its end.
    """

    log_likelihood: float = -math.inf
    parameters: BeamParameters | None = None
    fit: BeamFit | None = None

    def see(self, iteration: int, log_likelihood: float, parameters: BeamParameters) -> None:
        """Record an iteration of the search."""
        if log_likelihood > self.log_likelihood:
            self.log_likelihood, self.parameters = log_likelihood, parameters

    def print(self, *, json: bool) -> None:
        """Print the results, if any."""
        best = self.parameters if self.fit is None else self.fit.parameters
        if best is None:
            return
        if json:
            fit = None if self.fit is None else self.fit.to_dict()
            output.document({"interrupted": True, "parameters": best.to_dict(), "fit": fit})
            return
        state = "before convergence" if self.fit is None else "this fit had ended, the rest had not"
        output.result(f"INTERRUPTED, {state}: the likeliest parameters, log-likelihood {self.log_likelihood:.3f}")
        for name, value in best.to_dict().items():
            output.fact(name, f"{value:.6g}" if isinstance(value, float) else str(value))


def print_fit(args: argparse.Namespace, result: FitResult, files: list[Path]) -> None:
    """Print the verdict, the parameters with their errors, advice, and the written files."""
    fit, p = result.fit, result.fit.parameters
    readings = fit.hits + fit.max_readings
    unexplained, doubtful = fit.outliers / readings if readings else 0.0, is_doubtful(fit)
    verdict = "NOT CONVERGED" if not fit.converged else "DOUBTFUL" if doubtful else "FITTED"
    output.result(
        f"{verdict}: {100 * p.z_hit:.0f} % of the readings are correct, with a deviation of "
        f"{length(p.sigma_hit)}; {100 * unexplained:.2g} % are unexplained"
    )
    source = "the expected ranges" if args.pairs is not None else "the poses or the map"
    if doubtful:
        output.fact("doubt", DOUBT)
    elif unexplained > _USUAL_UNEXPLAINED:
        output.fact("many", f"recorded lasers leave 5 to 11 % unexplained; look for people, or places where {source} "
                    "are wrong, in readings.png (--out)")  # fmt: skip
    if not fit.converged or fit.held:
        output.fact("status", fit.status)
    _print_bias(fit)
    errors = fit.standard_errors | ({"range_bias": fit.range_bias_error} if fit.bias_fitted else {})
    output.parameters(p, errors, _UNITS)
    if result.incidence is not None:
        print(f"\n{result.incidence}")
    if result.motion is not None:
        _print_motion(result.motion)
    if result.held_out:
        _print_held_out(result)
    if files:
        print()
    output.files(*files)
    output.details(args, f"{fit}\nrange_max {result.data.range_max:.6g} m, {len(result.data.ranges)} readings")


def is_doubtful(fit: BeamFit) -> bool:
    """Return whether readings are far from their expected ranges."""
    p, unexplained = fit.parameters, fit.outliers > _MOST_UNEXPLAINED * (fit.hits + fit.max_readings)
    return p.z_hit < _LEAST_HIT or p.sigma_hit > _MOST_DEVIATION or unexplained


def _print_bias(fit: BeamFit) -> None:
    """Print the offset of correct ranges, and the option that takes it into the parameters if it matters."""
    bias, error, sigma = fit.range_bias, fit.range_bias_error, fit.parameters.sigma_hit
    if fit.bias_fitted or not math.isfinite(bias) or not math.isfinite(error):
        return
    if abs(bias) > _SURE * error and abs(bias) > _NOTABLE * sigma:
        sides = "long" if bias > 0 else "short"
        output.fact("bias", f"ranges are {length(abs(bias))} too {sides} (error {length(error)}): --range-bias takes "
                    "this into the parameters; walls that the map draws too thick look the same")  # fmt: skip


def _print_held_out(result: FitResult) -> None:
    print(f"\nheld out: {result.held_out_readings} readings, mean log-likelihood of a reading [nats]")
    columns = ("parameters", "log-likelihood", "gain of the fit", "std. error")
    rows = [(row.name, f"{row.per_beam:.4f}", *rounded(row.gain, row.gain_error)) for row in result.held_out]
    output.table(columns, rows, right=columns[1:])
    for row in result.held_out:
        if row.impossible:
            output.fact("", f"{row.name}: {row.impossible} held-out readings are impossible; softened: half a reading "
                        "added to each cause, with which the other rows are compared")  # fmt: skip


def _print_motion(fit: MotionFit) -> None:
    path = f"{fit.travelled:.1f} m and {fit.turned:.1f} rad"
    print()
    output.fact("odometry", f"{fit.motion}, from {fit.steps} steps ({path}) with {fit.references} reference poses")
    if fit.undetermined:
        output.fact("", f"at most the default, because the log does not determine them: {', '.join(fit.undetermined)}")
