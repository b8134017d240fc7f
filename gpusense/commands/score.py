"""Run ``gpusense score``: rank the logged poses of a recorded log among particles, on one backend or several."""

from __future__ import annotations

import argparse
import contextlib
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpusense._util.progress import is_terminal, progress
from gpusense.commands.arguments import (
    BACKEND_HELP,
    add_json,
    add_seed,
    not_negative_number,
    number,
    output_path,
    positive_number,
    whole_number,
)
from gpusense.commands.output import TableStream, print_json
from gpusense.evaluation.machine import machine, machine_line

if TYPE_CHECKING:
    from gpusense.evaluation.agreement import Agreement, Model
    from gpusense.evaluation.scoring import BackendScore, LogScoring, ScanScore
    from gpusense.logs import Scan
    from gpusense.world.grid import OccupancyGrid
    from gpusense.world.parameters import BeamParameters
    from gpusense.world.scanner import Scanner

NAME = "score"
HELP = "Score particles with the scans of a recorded log, and rank the logged poses among them."

DIFFERENT = 1

_EPILOG = """\
Each scan is scored for N particles: the logged pose, half of the others around it, half uniform over the free cells.
The percentile is the share of the other particles that score worse than the logged pose, ties counting half. The
weighted mean excludes the logged pose. Default parameters are those of BeamParameters and LikelihoodFieldParameters.
A temperature of 0.1 compensates for beams that are not independent: more particles then share the weight.

A row is printed as soon as its scan is scored. Ctrl-C ends the run with the results so far.

Exit codes: 0 success, 1 two backends rank the particles differently by more than rounding explains, 2 bad input,
130 interrupted.

example:
  gpusense score --map map.yaml --log run.log.gz --model field --particles 20000
  gpusense score --map map.yaml --log run.log.gz --parameters fitted/parameters.yaml
  gpusense score --map map.yaml --log run.log.gz --every 2 --offset 1 --backend opencl --backend numpy --limit 3"""

# Columns of the table, and their widths.
_COLUMNS = {
    "scan": 5, "backend": 10, "rank": 7, "percentile": 10, "error [m]": 9, "error [rad]": 11, "effective": 9,
    "beams": 5,
}  # fmt: skip
_SHARED = ("z_hit", "z_max", "z_rand", "sigma_hit")
_SPECIFIC = {"beam": ("z_short", "lambda_short"), "field": ("max_distance", "interpolation")}
_MEANING = {
    "z_hit": "weight of a correct range with noise",
    "z_max": "weight of 'no return'",
    "z_rand": "weight of a random reading; the weights must sum to 1",
    "sigma_hit": "deviation of a correct range, or of an end point from a wall [m]",
    "z_short": "weight of an unexpected obstacle; beam model only",
    "lambda_short": "rate of unexpected obstacles along a beam [1/m]; beam model only",
    "max_distance": "largest distance to an obstacle that counts [m]; field only",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.epilog = _EPILOG
    add = parser.add_argument
    add("--map", required=True, type=Path, metavar="YAML", help="a map_server map")
    add("--log", required=True, type=Path, metavar="FILE", help="a log (CARMEN) with corrected poses, plain or .gz")
    add("--model", choices=("beam", "field"), default="beam", help="measurement model (default: %(default)s)")
    add("--backend", action="append", metavar="DEVICE",
        help=f"{BACKEND_HELP}; may be repeated to compare rankings (default: auto)")  # fmt: skip
    add("--precision", choices=("float32", "float64"), default="float32", help="precision (default: %(default)s)")
    add("--particles", type=whole_number(low=2), default=20_000, metavar="N", help="per scan (default: %(default)s)")
    add("--sigma-position", type=not_negative_number, default=0.5, metavar="M",
        help="deviation of the particles around the logged pose, in x and in y [m] (default: %(default)s)")  # fmt: skip
    add("--sigma-heading", type=not_negative_number, default=0.25, metavar="RAD",
        help="deviation of their heading [rad] (default: %(default)s)")  # fmt: skip
    add("--every", type=whole_number(low=1), default=1, metavar="E",
        help="every E-th scan, from --offset on; '--every 2 --offset 1' are the odd ones (default: 1)")  # fmt: skip
    add("--offset", type=whole_number(low=0), default=0, metavar="O", help="index of the first scan (default: 0)")
    add("--limit", type=whole_number(low=1), metavar="S", help="largest number of scans (default: all)")
    add("--range-max", type=positive_number, metavar="M",
        help="readings of at least this are 'no return' [m] (default: the log's reading for 'no return')")  # fmt: skip
    add("--beams", type=whole_number(low=1), metavar="B", help="thin each scan evenly to B beams (default: all)")
    add("--temperature", type=positive_number, default=1.0, metavar="T",
        help="factor of log-likelihoods in (0, 1] (default: %(default)s, the plain product over beams)")  # fmt: skip
    group = parser.add_argument_group("parameters of the model")
    group.add_argument("--parameters", type=Path, metavar="YAML",
        help="a file with beam_model, such as 'gpusense fit --out' writes; beam model only")  # fmt: skip
    for name, meaning in _MEANING.items():
        group.add_argument(_option(name), type=number, metavar="X", help=meaning)
    group.add_argument("--interpolation", choices=("nearest", "bilinear"), help="look-up of the field; field only")
    add_seed(parser)
    add_json(parser)
    add("--plot", type=output_path(".png", ".pdf", ".svg"), metavar="FILE",
        help="draw map, logged and estimated poses, and errors")  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Score the scans and print the results; after Ctrl-C those so far."""
    from gpusense.evaluation.scoring import LogScoring, ParticleSampler, logged_scans
    from gpusense.world.map_files import read_map

    sampler = ParticleSampler(args.particles, args.sigma_position, args.sigma_heading, args.seed)
    grid = read_map(args.map)
    scans = logged_scans(args.log, range_max=args.range_max, every=args.every, offset=args.offset, limit=args.limit)
    models = make_models(args, grid, scans[0][1].scanner)
    scoring = LogScoring(models, sampler)
    try:
        _score(args, models, scans, scoring)
    except KeyboardInterrupt:
        scores, agreements = scoring.results()
        if scores:
            _report(args, models, scores, agreements, len(scans))
        raise
    scores, agreements = scoring.results()
    _report(args, models, scores, agreements, len(scans))
    if args.plot is not None:
        _draw(args.plot, grid, scores[0])
        if not args.json:
            print(f"drawn: {args.plot}")
    return 0 if all(agreement.same for agreement in agreements) else DIFFERENT


def _score(args: argparse.Namespace, models: list[Model], scans: list[tuple[int, Scan]], scoring: LogScoring) -> None:
    """Score the scans, and print a row for each as it comes."""
    # Rows on a terminal show the progress.
    shown = not args.json and is_terminal(sys.stdout)
    optional = (*(("backend",) if len(models) == 1 else ()), "beams", "effective", "error [rad]")
    table = TableStream(_COLUMNS, left=("backend",), optional=optional)
    with contextlib.nullcontext(lambda text: None) if shown else progress(len(scans)) as step:
        for index, scan in scans:
            step(f"scan {index}")
            scores = scoring.add(index, scan)
            if not args.json:
                for model, score in zip(models, scores, strict=True):
                    table.add(_row(model.device.selection, score))


def _row(backend: str, scan: ScanScore) -> dict[str, str]:
    position, heading = (_text(value, "none: all -inf") for value in (scan.error_position, scan.error_heading))
    values = (str(scan.index), backend, f"{scan.rank:g}", f"{scan.percentile:.3f}", position, heading,
              _text(scan.effective), str(scan.beams))  # fmt: skip
    return dict(zip(_COLUMNS, values, strict=True))


def _report(
    args: argparse.Namespace,
    models: list[Model],
    scores: list[BackendScore],
    agreements: list[Agreement],
    chosen: int,
) -> None:
    """Print the results of all scans, or of those before an interrupt."""
    if args.json:
        print_json(_document(args, models, scores, agreements) | {"scans_chosen": chosen})
        return
    _print(args, models, scores, agreements)
    if len(scores[0].scans) < chosen:
        print(f"\ninterrupted: results of {len(scores[0].scans)} of {chosen} scans")


def _draw(path: Path, grid: OccupancyGrid, score: BackendScore) -> None:
    from gpusense.plots.drawing import save
    from gpusense.plots.scores import scores_figure

    save(scores_figure(grid, score), path)


def make_models(args: argparse.Namespace, grid: OccupancyGrid, scanner: Scanner) -> list[Model]:
    """Make the model on each backend, each device once.

    Raises:
        ValueError: a backend is absent, or a parameter breaks its rule or belongs to the other model.
    """
    from gpusense.models.scan.beam import BeamModel
    from gpusense.models.scan.field import LikelihoodFieldModel
    from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters

    options = {name: getattr(args, name) for name in (*_SHARED, *_SPECIFIC["beam"], *_SPECIFIC["field"])}
    changes = {name: value for name, value in options.items() if value is not None}
    for name in changes:
        if name not in (*_SHARED, *_SPECIFIC[args.model]):
            raise ValueError(f"{_option(name)}: must be a parameter of the {args.model} model, got another model's")
    beam = BeamParameters()
    if args.parameters is not None:
        if args.model != "beam":
            raise ValueError(f"--parameters: must be left out with the field, got {args.parameters}")
        beam = read_beam_parameters(args.parameters)
    models: dict[str, Model] = {}
    for backend in args.backend or ["auto"]:
        common = {
            "backend": backend, "precision": args.precision, "temperature": args.temperature, "beams": args.beams,
        }  # fmt: skip
        model: Model
        if args.model == "beam":
            model = BeamModel(grid, scanner, beam.replace(**changes), **common)
        else:
            model = LikelihoodFieldModel(grid, scanner, LikelihoodFieldParameters().replace(**changes), **common)
        models.setdefault(model.device.selection, model)
    return list(models.values())


def read_beam_parameters(path: Path) -> BeamParameters:
    """Read the mapping ``beam_model`` of a YAML file.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: the file lacks the mapping, or a parameter breaks its rule.
    """
    from gpusense._util import checks
    from gpusense._util.files import read_mapping
    from gpusense.world.parameters import BeamParameters

    values = read_mapping(checks.existing_file(path)).get("beam_model")
    if not isinstance(values, dict):
        raise ValueError(f"{path}: must hold a mapping beam_model, got {checks.show(values)}")
    try:
        return BeamParameters.from_dict(values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: beam_model: {error}") from None


def _document(
    args: argparse.Namespace, models: list[Model], scores: list[BackendScore], agreements: list[Agreement]
) -> dict[str, Any]:
    from gpusense.evaluation.scoring import summary

    options = {name: value for name, value in vars(args).items() if name not in ("run", "command", "json")}
    return {
        "options": options,
        "parameters": models[0].parameters.to_dict(),
        "range_max": models[0].scanner.range_max,
        "backends": [asdict(score) | {"summary": summary(score)} for score in scores],
        "agreement": [asdict(agreement) | {"same_ranking": agreement.same} for agreement in agreements],
        "machine": machine(),
    }


def _print(
    args: argparse.Namespace, models: list[Model], scores: list[BackendScore], agreements: list[Agreement]
) -> None:
    from gpusense.evaluation.scoring import summary

    values = ", ".join(f"{name} {value}" for name, value in models[0].parameters.to_dict().items())
    print(f"\n{args.model} model, {args.precision}: {values}, range_max {models[0].scanner.range_max} m")
    for score in scores:
        s = {name: _text(value) for name, value in summary(score).items()}
        print(
            f"\n{score.device.selection} ({score.device.name}): {s['scans']} scans, {score.particles} particles each\n"
            f"  rank of the logged pose: median {s['rank_median']}\n"
            f"  percentile of the logged pose: median {s['percentile_median']}, least {s['percentile_min']}\n"
            f"  error of the weighted mean: median {s['error_position_median']} m and {s['error_heading_median']} rad, "
            f"90 % below {s['error_position_90']} m and {s['error_heading_90']} rad\n"
            f"  effective sample size: median {s['effective_median']}; scans with every particle at -inf: "
            f"{s['degenerate']}\n  {s['particle_beams_per_second']} particle-beams/s"
        )
    for agreement in agreements:
        print(f"\n{_verdict(agreement)}")
    print(f"\n{machine_line()}")


def _verdict(a: Agreement) -> str:
    if a.same:
        verdict = "the same ranking" if a.same_order == a.scans else "the same ranking to within rounding"
    else:
        verdict = "ANOTHER RANKING"
    return (
        f"{a.left} and {a.right}: {verdict}\n"
        f"  the logged pose has the same rank in {a.same_rank} of {a.scans} scans, no two particles change places "
        f"in {a.same_order}; least rank correlation {a.spearman:.9f}\n"
        f"  largest difference {a.difference:.3g} nats; particles that change places are at most {a.gap:.3g} nats "
        f"apart; rounding explains {a.allowed:.3g}"
    )


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _text(value: float | None, absent: str = "-") -> str:
    return absent if value is None else f"{value:.4g}"
