"""Run ``gpusense score``: rank the poses of a log among particles."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import gpusense as gs
from gpusense.commands import output
from gpusense.commands.arguments import Options, picture, scan_model, temperature, whole_number
from gpusense.commands.output import counted, degrees, draw, grouped, length
from gpusense.commands.scans import add_log, read_scans
from gpusense.commands.signals import working
from gpusense.evaluation import scoring
from gpusense.localization.defaults import DEFAULTS

if TYPE_CHECKING:
    from gpusense.evaluation.scoring import Fitness, LogScore, Model

FIRST = ("map", "log", "reference", "parameters", "plot")
SHARED = ("reference", "choice", "model", "backend", "seed", "verbose")
CODES = {0: "the log fits the map", 1: "it does not or the verdict is uncertain"}


EPILOG = """\
Each scan is scored for N particles: the logged pose, half of the others around it (0.5 m and 0.25 rad), half
uniform over the free cells.
The percentile is the share of the other particles that score worse than the logged pose, ties counting half. The
weighted mean excludes the logged pose. BeamParameters and LikelihoodFieldParameters define the default parameters.
Beams of a scan are not independent, so the temperature multiplies their sum. By default it is calibrated: from the
correlation of beams at the logged poses of the first 100 chosen scans. --temperature 1 is the plain product.

The verdict is whether the logged poses explain the beams of their scans. On a wrong map beams pass through walls: the
message states their share and the place of most of them. Cases in between are uncertain.

--json lists all scans. examples:
  gpusense score --map map.yaml --log run.log.gz --model field --particles 20000
  gpusense score --map map.yaml --log run.log.gz \\
      --parameters fitted/parameters.yaml"""


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("--map YAML", "a map_server map", Path, required=True)
    add_log(add, "a log with corrected poses, or any with --reference")
    add("--particles N", "per scan", whole_number(low=2), 20_000)
    add("--temperature T", "factor of log-likelihoods in (0, 1], or auto: calibrated from the chosen scans",
        temperature, DEFAULTS.temperature)  # fmt: skip
    add("--plot FILE", "draw map, logged and estimated poses, and errors", picture)


def run(args: argparse.Namespace) -> int:
    """Score the scans and print the results; after Ctrl-C, the results so far."""
    from gpusense.plots.runs import scores_figure

    sampler = scoring.ParticleSampler(args.particles, seed=args.seed)
    grid = gs.read_map(args.map)
    scans = read_scans(args)
    scanner, factor = scans[0][1].scanner, args.temperature
    if factor == "auto":
        factor = scoring.temperature_of_log(scan_model(args, grid, scanner), scans)
    model = scan_model(args, grid, scanner, temperature=factor)
    scores, fitness = scoring.LogScoring(model, sampler), scoring.FitnessOfLog(model)
    with working(scores, len(scans)) as step:
        for index, scan in scans:
            step(f"scan {index}")
            fitness.add(scan, scores.add(index, scan).better)
    score, fit = scores.result(), fitness.result()
    _report(args, model, score, fit, len(scans))
    draw(args.plot, lambda: scores_figure(grid, score, pose_name(args)))
    if not args.json:
        output.files(args.plot)
    return int(not fit.fits)


def _report(args: argparse.Namespace, model: Model, score: LogScore, fitness: Fitness, chosen: int) -> None:
    """Print the results of all scans, or of the scans before an interrupt."""
    if args.json:
        facts = {
            "parameters": model.parameters.to_dict(), "temperature": model.temperature,
            "range_max": model.scanner.range_max, **asdict(score), "summary": scoring.summary(score),
            "scans_chosen": chosen, "fitness": asdict(fitness) | {"fits": fitness.fits, "verdict": fitness.verdict},
        }  # fmt: skip
        output.report(facts, args)
        return
    output.result(_fitness(fitness, pose_name(args)))
    _print(score, args.model, pose_name(args))
    output.interrupted(len(score.scans), chosen)
    values = ", ".join(f"{name} {value}" for name, value in model.parameters.to_dict().items())
    how = "calibrated from the scans" if args.temperature == "auto" else "given"
    s = {name: number_text(value) for name, value in scoring.summary(score).items()}
    output.details(
        args,
        f"{args.model} model, {args.precision}: {values}, range_max {model.scanner.range_max:.6g} m\n"
        f"temperature {model.temperature:.4g}, {how}\n"
        f"effective sample size: median {s['effective_median']}; scans with all particles at -inf: {s['degenerate']}; "
        f"{s['particle_beams_per_second']} particle-beams/s of whole calls, NumPy in and out",
    )


def pose_name(args: argparse.Namespace) -> str:
    """Return the report's name for the scans' poses, from the log or from ``--reference``."""
    return "logged pose" if args.reference is None else "reference pose"


def _print(score: LogScore, model: str, pose: str) -> None:
    """Print the model, the rank of the true pose, and the error of the weighted mean."""
    s = scoring.summary(score)
    output.fact("model", f"{model}, on {score.device.selection} ({score.device.name}): "
                f"{counted(len(score.scans), 'scan')}, {grouped(score.particles)} particles each")  # fmt: skip
    output.fact("rank", f"of the {pose} among them: median {number_text(s['rank_median'])}, better than "
                f"{number_text(s['percentile_median'])} % in the median, {number_text(s['percentile_min'])} % at "
                "least")  # fmt: skip
    if s["error_position_median"] is None:
        output.fact("error", "none: every particle is impossible in every scan")
    else:
        output.fact("error", f"of the weighted mean: median {length(s['error_position_median'])} and "
                    f"{degrees(s['error_heading_median'])} degrees, 90 % below "
                    f"{length(s['error_position_90'])} and {degrees(s['error_heading_90'])} "
                    "degrees")  # fmt: skip


def _fitness(fitness: Fitness, pose: str) -> str:
    """Return the verdict of a log's poses with its evidence."""
    if fitness.p_lost is None:
        return "NO VERDICT: no scan has a reading to judge by"
    explained, better = (
        "-" if share is None else f"{100 * share:.0f} %" for share in (fitness.explained, fitness.better)
    )
    share = (
        f"the {pose}s explain {explained} of the beams of a scan, and are likelier than {better} of poses anywhere; "
        f"p_lost {fitness.p_lost:.2g}"
    )
    if fitness.fits:
        return f"FITS THE MAP: {share}"
    if fitness.verdict == "uncertain":
        return f"UNCERTAIN: {share}; {fitness.evidence.text}"
    return f"WRONG MAP: {share}; {fitness.evidence.text}; is this the map of the log, and are its poses on the map?"


def number_text(value: float | None) -> str:
    """Return a number with four digits, "-" for None."""
    return "-" if value is None else f"{value:.4g}"
