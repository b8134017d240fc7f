"""Run ``gpusense fit``: fit the beam model's parameters to a log in a map, or to pairs of ranges."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gpusense as gs
from gpusense._util.files import write_whole
from gpusense._util.progress import progress
from gpusense.commands import output
from gpusense.commands.arguments import Options, output_folder, refuse, whole_number
from gpusense.commands.output import length, rounded
from gpusense.commands.scans import add_log, read_chosen_steps, read_scans
from gpusense.evaluation import log_steps, range_data, trajectory_files
from gpusense.world import hit_shapes

if TYPE_CHECKING:
    from gpusense.evaluation.range_data import HeldOut, RangeData

FIRST = ("map", "log", "reference", "holdout", "out")
SHARED = ("reference", "pairs", "backend", "seed", "verbose")
CODES = {1: "the fit did not converge"}

DESCRIPTION = """\
How good is a range finder? gpusense fit estimates the six parameters of the beam model from your sensor's data: weight
and deviation of correct ranges (z_hit, sigma_hit), weight and rate of unexpected obstacles (z_short, lambda_short),
weight of 'no return' (z_max) and of random readings (z_rand). It needs readings with expected ranges: either a map and
a log with good poses, at which expected ranges are cast, or a file of pairs."""

EPILOG = """\
A file of pairs has a line per reading: the reading z, a comma, the expected range z*, and optionally another comma
and the angle of incidence in radians. A first line without numbers is a header; files may be gzipped. inf means 'no
return', nan a missing reading.

--holdout excludes every other block (one scan of a log, 100 pairs of a file; see --block) from the fit, and scores
these blocks with the fitted parameters and with the defaults of nav2_amcl and Beluga. All standard errors are over
blocks, because errors within a scan are correlated. --incidence also scores the fit by angles of incidence.

A map made from the same scans hides their errors. Fit with other scans: for a map of the even scans, use --every 2
--offset 1.

--out writes parameters.yaml (for 'gpusense localize --parameters' and for nav2's amcl) and pictures: readings.png,
density.png, trace.png, surface.png, and incidence.png for fitted angles of incidence.

Ctrl-C ends the fit and prints the best parameters so far.

examples:
  gpusense fit --map map.yaml --log run.log.gz --every 2 --offset 1 --holdout \\
      --fit-motion --out fitted
  gpusense fit --pairs readings.csv --range-max 8 --range-bias"""

_PAIRS_BLOCK = 100


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("--map YAML", "a map_server map; needs --log", Path)
    add_log(add, "a log with corrected poses, or any with --reference; needs --map", required=False)
    add("--pairs CSV", "a file of columns separated by commas instead: reading [m], expected range [m] and, if known, "
        "angle of incidence [rad]; needs --range-max", Path)  # fmt: skip
    add("--method", "optimiser; em-book is table 6.2 as printed",
        ("em", "em-book", "gradient", "hill_climb", "genetic"), "em")  # fmt: skip
    add("--range-bias", "also fit an offset of all correct ranges")
    add("--sigma-growth", "also fit a deviation of correct ranges that grows with range")
    add("--hit", "shape of correct ranges; student fits a Student t", tuple(hit_shapes.SHAPES), "normal")
    add("--fit-motion", "also learn the noise of the log's odometry from its poses")
    add("--incidence BINS", "also fit parameters for BINS bins of the angle of incidence", whole_number(low=1, high=90))
    add("--restarts N", "further random starts", whole_number(low=0, high=10_000), 0)
    add("--holdout", "hold out every other block, and score it with other programs' defaults")
    add("--block B", f"neighbouring scans or pairs per block (default: 1 scan, {_PAIRS_BLOCK} pairs)",
        whole_number(low=1))  # fmt: skip
    add("--out DIR", "folder for parameters.yaml and pictures, created if absent", output_folder(".png"))


def run(args: argparse.Namespace) -> int:
    """Fit the parameters, print the result and write the files; after Ctrl-C print the best parameters so far."""
    _check_sources(args)
    data, motion, partial = _read(args), _motion(args), PartialFit()
    try:
        result = _fit(args, data, motion, partial)
    except KeyboardInterrupt:
        partial.print(json=args.json)
        raise
    files = _write(args.out, result) if args.out is not None else []
    if args.json:
        output.report(_document(result, files), args)
        if is_doubtful(result.fit):
            sys.stderr.write(f"gpusense: {DOUBT}\n")
    else:
        print_fit(args, result, files)
    return int(not result.fit.converged)


def _check_sources(args: argparse.Namespace) -> None:
    if args.pairs is not None:
        of_log = ("map", "log", "reference", "topic", "mount", "frame", "odometry_from")
        refuse(args, of_log, "must be left out with --pairs")
        if args.fit_motion:
            raise ValueError("--fit-motion: must have a --log with odometry, got --pairs")
        if args.range_max is None:
            raise ValueError("--range-max: must be given with --pairs, got none")
    for name in ("map", "log"):
        if args.pairs is None and getattr(args, name) is None:
            raise ValueError(f"--{name}: must be given unless --pairs is, got none")
    if args.range_min is not None and args.range_max is not None and args.range_min >= args.range_max:
        raise ValueError(f"--range-min: must be < --range-max = {args.range_max}, got {args.range_min}")


def _read(args: argparse.Namespace) -> RangeData:
    chosen = {"every": args.every, "offset": args.offset, "limit": args.limit}
    range_min = args.range_min or 0.0
    if args.pairs is not None:
        data = range_data.data_of_pairs(
            args.pairs, args.range_max, range_min=range_min, block=args.block or _PAIRS_BLOCK, **chosen
        )
        if args.incidence and data.incidence is None:
            raise ValueError(f"--incidence: must have pairs with a third column, the angle, got two in {args.pairs}")
        return data
    grid = gs.read_map(args.map)
    scans = read_scans(args)
    with progress(-(-len(scans) // range_data.SCANS)) as step:
        return range_data.data_of_log(
            grid, scans, backend=args.backend, range_min=range_min, block=args.block or 1,
            incidence=bool(args.incidence), step=step,
        )  # fmt: skip


def _fit(args: argparse.Namespace, data: RangeData, motion: gs.MotionFit | None, partial: PartialFit) -> FitResult:
    data, rest = data.halves() if args.holdout else (data, None)
    sensor = {"range_max": data.range_max, "range_min": data.range_min, "backend": args.backend}
    known = data.block[data.kinds != gs.Reading.MISSING]
    blocks = data.block if len(set(known.tolist())) > 1 else None
    fit = gs.fit_beam_parameters(
        data.ranges, data.expected, **sensor, method=args.method, seed=args.seed, restarts=args.restarts,
        range_bias=args.range_bias, sigma_growth=args.sigma_growth, hit=args.hit, progress=True, callback=partial.see,
        blocks=blocks,
    )  # fmt: skip
    partial.fit = fit
    incidence = None
    if data.incidence is not None and args.incidence:
        incidence = gs.fit_incidence_parameters(
            data.ranges, data.expected, data.incidence, **sensor, bins=args.incidence, range_bias=args.range_bias,
            hit=args.hit, blocks=blocks,
        )  # fmt: skip
    compared = []
    if rest is not None:
        compared = range_data.compare_held_out(
            fit.parameters, rest, readings=fit.hits + fit.max_readings, incidence=incidence
        )
    return FitResult(data, fit, incidence, compared, 0 if rest is None else len(rest.ranges), motion)


def _motion(args: argparse.Namespace) -> gs.MotionFit | None:
    """Learn the noise of the odometry from the chosen scans; None if it is not requested."""
    if not args.fit_motion:
        return None
    steps = read_chosen_steps(args)
    if args.reference is not None:
        steps = log_steps.with_references(steps, *trajectory_files.read_tum(args.reference))
    return gs.fit_odometry_motion(*log_steps.references_to_learn_from(steps))


def _document(result: FitResult, files: list[Path]) -> dict[str, Any]:
    return {
        "range_max": result.data.range_max, "readings": len(result.data.ranges),
        "blocks": len(set(result.data.block.tolist())), "fit": result.fit.to_dict(),
        "incidence": result.incidence and result.incidence.to_dict(), "motion": result.motion,
        "held_out_readings": result.held_out_readings, "held_out": result.held_out, "files": files,
    }  # fmt: skip


def _write(folder: Path, result: FitResult) -> list[Path]:
    """Write the files of a fit, each atomically, and return their paths."""
    from gpusense.plots import fits
    from gpusense.plots.drawing import save

    folder.mkdir(parents=True, exist_ok=True)
    text, file = parameters_yaml(result).encode(), folder / "parameters.yaml"
    write_whole(file, lambda stream: stream.write(text))
    data, parameters, distances = result.data, result.fit.parameters, fits.distances_of(result.data)
    figures = {
        "readings.png": fits.readings_figure(data, distances),
        "density.png": fits.density_figure(data, parameters, distances),
        "trace.png": fits.trace_figure(result.fit.trace, result.fit.method),
        "surface.png": fits.surface_figure(data, parameters),
    }
    if result.incidence is not None:
        figures["incidence.png"] = fits.incidence_figure(result.incidence)
    for name, figure in figures.items():
        save(figure, folder / name)
    return [file, *(folder / name for name in figures)]


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
    fit: gs.BeamFit
    incidence: gs.IncidenceFit | None
    held_out: list[HeldOut]
    held_out_readings: int
    motion: gs.MotionFit | None = None


@dataclass
class PartialFit:
    """Results before an interrupt.

    Attributes:
        parameters: The likeliest parameters so far; None before the first iteration.
        fit: The fit, after its end.
    """

    log_likelihood: float = -math.inf
    parameters: gs.BeamParameters | None = None
    fit: gs.BeamFit | None = None

    def see(self, iteration: int, log_likelihood: float, parameters: gs.BeamParameters) -> None:
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


def is_doubtful(fit: gs.BeamFit) -> bool:
    """Return whether readings are far from their expected ranges."""
    p, unexplained = fit.parameters, fit.outliers > _MOST_UNEXPLAINED * (fit.hits + fit.max_readings)
    return p.z_hit < _LEAST_HIT or p.sigma_hit > _MOST_DEVIATION or unexplained


def _print_bias(fit: gs.BeamFit) -> None:
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


def _print_motion(fit: gs.MotionFit) -> None:
    path = f"{fit.travelled:.1f} m and {fit.turned:.1f} rad"
    print()
    output.fact("odometry", f"{fit.motion}, from {fit.steps} steps ({path}) with {fit.references} reference poses")
    if fit.undetermined:
        output.fact("", f"at most the default, because the log does not determine them: {', '.join(fit.undetermined)}")


def parameters_yaml(result: FitResult) -> str:
    """Format the fitted parameters as YAML for gpusense and for nav2_amcl."""
    import yaml

    def block(name: str, mapping: dict[str, Any]) -> str:
        # PyYAML writes no tuples.
        plain = {key: list(value) if isinstance(value, tuple) else value for key, value in mapping.items()}
        return str(yaml.safe_dump({name: plain}, sort_keys=False)).rstrip()

    fit, values = result.fit, result.fit.parameters.to_dict()
    values = {name: value if isinstance(value, str) else float(value) for name, value in values.items()}
    lines = [
        f"# gpusense fit: {fit.hits} ranges and {fit.max_readings} readings without return; {fit.status}",
        "# For gpusense: gs.BeamParameters.from_dict(...) takes the mapping beam_model.",
        block("beam_model", values),
    ]
    if result.incidence is not None:
        lines.append("# For gpusense: gs.IncidenceParameters.from_dict(...).")
        lines.append(block("incidence_model", result.incidence.parameters.to_dict()))
    if result.motion is not None:
        lines += [
            "# For 'gpusense localize --parameters': OdometryMotion. nav2_amcl lacks least, sideways and systematic:",
            "# alpha alone is too little noise there.",
            block("odometry_motion", result.motion.motion.to_dict()),
        ]
    own = ("range_bias", "sigma_growth", *hit_shapes.SHAPE_PARAMETERS)
    shared = {name: value for name, value in values.items() if name not in own}
    nav2 = {"laser_model_type": "beam", **shared, "laser_max_range": float(result.data.range_max)}
    lines += [
        "# For nav2_amcl: paste below amcl's ros__parameters. Its beam model sums cubes of densities that are not",
        "# normalised, so the likeliest parameters need not be the best ones there. laser_likelihood_max_dist belongs",
        "# to its likelihood field, which this fit does not cover. It has no range_bias, and normal hits only.",
        block("amcl", {"ros__parameters": nav2}),
    ]
    return "\n".join(lines) + "\n"
