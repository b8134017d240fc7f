"""Report of ``gpusense score``: text or JSON."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from gpusense.commands.output import counted, print_json
from gpusense.evaluation.machine import machine, machine_line

if TYPE_CHECKING:
    from gpusense.evaluation.agreement import Agreement, Model
    from gpusense.evaluation.fitness import Fitness
    from gpusense.evaluation.scoring import BackendScore


def print_report(
    args: argparse.Namespace,
    models: list[Model],
    scores: list[BackendScore],
    agreements: list[Agreement],
    fitness: Fitness,
    chosen: int,
) -> None:
    """Print the results of all scans, or of the scans before an interrupt."""
    if args.json:
        more = {
            "scans_chosen": chosen,
            "fitness": asdict(fitness) | {"fits": fitness.fits, "verdict": fitness.verdict},
        }
        print_json(_document(args, models, scores, agreements) | more)
        return
    pose = pose_name(args)
    _print(args, models, scores, pose)
    for agreement in agreements:
        print(f"\n{_verdict(agreement, pose)}")
    print(f"\nverdict: {_fitness(fitness, pose)}\n\n{machine_line()}")
    if len(scores[0].scans) < chosen:
        print(f"\ninterrupted: results of {len(scores[0].scans)} of {chosen} scans")


def pose_name(args: argparse.Namespace) -> str:
    """Return the report's name of a scan's pose, which comes from the log or from ``--reference``."""
    return "logged pose" if args.reference is None else "reference pose"


def _document(
    args: argparse.Namespace, models: list[Model], scores: list[BackendScore], agreements: list[Agreement]
) -> dict[str, Any]:
    from gpusense.evaluation.scoring import summary

    options = {name: value for name, value in vars(args).items() if name not in ("run", "command", "json")}
    return {
        "options": options,
        "parameters": models[0].parameters.to_dict(),
        "temperature": models[0].temperature,
        "range_max": models[0].scanner.range_max,
        "backends": [asdict(score) | {"summary": summary(score)} for score in scores],
        "agreement": [asdict(agreement) | {"same_ranking": agreement.same} for agreement in agreements],
        "machine": machine(),
    }


def _print(args: argparse.Namespace, models: list[Model], scores: list[BackendScore], pose: str) -> None:
    from gpusense.evaluation.scoring import summary

    values = ", ".join(f"{name} {value}" for name, value in models[0].parameters.to_dict().items())
    print(f"\n{args.model} model, {args.precision}: {values}, range_max {models[0].scanner.range_max} m")
    how = "calibrated from the scans" if args.temperature == "auto" else "given"
    print(f"temperature {models[0].temperature:.4g}, {how}")
    for score in scores:
        s = {name: number_text(value) for name, value in summary(score).items()}
        print(
            f"\n{score.device.selection} ({score.device.name}): {counted(len(score.scans), 'scan')}, "
            f"{score.particles} particles each\n"
            f"  rank of the {pose}: median {s['rank_median']}\n"
            f"  percentile of the {pose}: median {s['percentile_median']}, least {s['percentile_min']}\n"
            f"  error of the weighted mean: median {s['error_position_median']} m and {s['error_heading_median']} rad, "
            f"90 % below {s['error_position_90']} m and {s['error_heading_90']} rad\n"
            f"  effective sample size: median {s['effective_median']}; scans with every particle at -inf: "
            f"{s['degenerate']}\n  {s['particle_beams_per_second']} particle-beams/s of whole calls, NumPy in and out"
        )


def _verdict(a: Agreement, pose: str) -> str:
    if a.same:
        verdict = "the same ranking" if a.same_order == a.scans else "the same ranking to within rounding"
    else:
        verdict = "ANOTHER RANKING"
    return (
        f"{a.left} and {a.right}: {verdict}\n"
        f"  the {pose} has the same rank in {a.same_rank} of {a.scans} scans, no two particles change places "
        f"in {a.same_order}; least rank correlation {a.spearman:.9f}\n"
        f"  largest difference {a.difference:.3g} nats; particles that change places are at most {a.gap:.3g} nats "
        f"apart; rounding explains {a.allowed:.3g}"
    )


def _fitness(fitness: Fitness, pose: str) -> str:
    """Return the verdict of a log's poses with its evidence."""
    if fitness.p_lost is None:
        return "none, no scan has a reading to judge by"
    explained, better = (
        "-" if share is None else f"{100 * share:.0f} %" for share in (fitness.explained, fitness.better)
    )
    share = (
        f"the {pose}s explain {explained} of the beams of a scan, and are likelier than {better} of poses anywhere; "
        f"p_lost {fitness.p_lost:.2g}"
    )
    if fitness.fits:
        return f"the log fits the map: {share}"
    if fitness.verdict == "uncertain":
        return f"UNCERTAIN: {share}; {fitness.evidence.text}"
    return f"WRONG MAP: {share}; {fitness.evidence.text}; is this the map of the log, and are its poses on the map?"


def number_text(value: float | None, absent: str = "-") -> str:
    """Return a number with four digits, or ``absent`` for None."""
    return absent if value is None else f"{value:.4g}"
