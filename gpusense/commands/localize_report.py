"""Report ``gpusense localize``: write files, and print results as text or JSON."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gpusense as gs
from gpusense.commands import output
from gpusense.commands.judge import print_stretches, stretch_rows
from gpusense.commands.output import degrees, draw, length
from gpusense.commands.scans import write_trajectory
from gpusense.evaluation import judging, tracking
from gpusense.localization import run_causes, scan_motion, spread

if TYPE_CHECKING:
    from gpusense.evaluation.tracking import Track
    from gpusense.plots.viewer import Animation, Recording

    Recorder = Recording | Animation

# Results other than a single number.
_NO_NUMBER = ("rank_histogram", "verdict", "evidence")
_PARTS = ("predict", "correct", "estimate")


def report(
    args: argparse.Namespace, pf: gs.ParticleFilter, track: Track, chosen: int, recorders: dict[Path, Recorder]
) -> dict[str, Any]:
    """Write the files, print the results of the scans (before an interrupt), and return their summary."""
    from gpusense.plots.runs import track_figure

    result, stretches = tracking.summary(track), judging.stretches_of_track(track)
    found = _diagnosis(pf, track, tracks=result["verdict"] == "tracking")
    result["evidence"] = None if found is None else asdict(found) | {"text": found.text}
    first = 0 if args.tum_from == "start" else len(track.poses) if track.converged is None else track.converged
    times = [step.scan.time for step in track.steps]
    write_trajectory(args.tum, times, track.poses, first)
    draw(args.plot, lambda: track_figure(pf, track))
    for path, recorder in recorders.items():
        recorder.write(track, path)
    if args.json:
        poses = [[step.index, *pose.tolist()] for step, pose in zip(track.steps, track.poses, strict=True)]
        document = {"filter": repr(pf), "summary": result, "scans_chosen": chosen}
        document |= {"poses": poses, "times": times, "stretches": stretch_rows(stretches), "risk": tracking.RISK}
        output.report(document, args)
        return result
    _print(pf, result, chosen, track)
    if len(stretches) > 1:
        print_stretches(stretches, track.steps[0].scan.time, tracking.RISK)
    output.files(args.plot, *recorders, args.tum)
    if args.tum is not None and first:
        output.fact("", f"without the first {first} of {len(track.poses)} scans, before the verdict is 'tracking'; "
                    "--tum-from start writes them")  # fmt: skip
    output.details(args, _details(pf, result))
    return result


def _diagnosis(pf: gs.ParticleFilter, track: Track, *, tracks: bool) -> gs.Diagnosis | None:
    """Return the evidence of a run; for a run that tracks, only if its odometry, mount or times are wrong."""
    moments = [
        scan_motion.Moment(step.scan.ranges, pose, step.odometry, step.scan.time, step.sensor)
        for step, pose in zip(track.steps, track.poses, strict=True)
    ]
    found = run_causes.diagnose_run(pf.models, moments, search=not tracks)
    if tracks:
        return found if found.cause in run_causes.CAUSES_OF_RUNS else None
    # The last scan alone may show more: people, a far turned mount.
    return pf.diagnose() if found.cause in ("none", "unknown") else found


def _print(pf: gs.ParticleFilter, result: dict[str, Any], chosen: int, track: Track) -> None:
    """Print the verdict with the error in one line, and then the last pose and the errors."""
    deviations = [math.sqrt(max(value, 0.0)) for value in track.covariances[-1].diagonal()]
    known = result["error_median"] is not None and not result["references_repeat_odometry"]
    settled = result["settled_median"] if known else None
    error = "" if settled is None else f"; median error {length(settled)}"
    output.result(_verdict(result, deviations) + error)
    output.interrupted(result["scans"], chosen)
    if result["verdict"] == "tracking" and result["evidence"] is not None:
        output.fact("but", result["evidence"]["text"])
    (x, y, theta), (dx, dy, turn) = track.poses[-1], deviations
    output.fact("last pose", f"{x:.2f} m, {y:.2f} m, {math.degrees(theta):.1f} degrees; deviations {length(dx)}, "
                f"{length(dy)}, {degrees(turn)} degrees")  # fmt: skip
    milliseconds = float(f"{sum(result[f'ms_{part}'] for part in _PARTS):.2g}")
    output.fact("scans", f"{result['scans']}, {milliseconds:g} ms each")
    if result["scans"] > 1 and not result["odometry_moves"]:
        output.fact("odometry", "does not move: absent, unreadable, at other times than the scans, or the robot stands")
    if result["references_repeat_odometry"]:
        away = length(result["error_median"])
        output.fact("reference", f"none: the logged poses are the odometry's own, {away} away in the median")
    elif known:
        _print_errors(result)
    sys.stdout.flush()


def _print_errors(result: dict[str, Any]) -> None:
    """Print the errors of poses, separately before and after convergence."""
    some = "" if result["references"] == result["scans"] else f" (reference poses of {result['references']} scans)"
    if result["converged_at"] is None:
        output.fact("error", f"never within 1 m and 20 degrees for long; median {length(result['error_median'])}{some}")
        return
    start = result["converged_at"]
    since = f"from scan {start} on: " if start else ""
    turns = f"{degrees(result['settled_heading_median'])} and {degrees(result['settled_heading_95'])}"
    output.fact("error", f"{since}median {length(result['settled_median'])}, 95 % below {length(result['settled_95'])}"
                f"; heading {turns} degrees{some}")  # fmt: skip
    if start:
        output.fact("", f"before: median {length(result['early_median'])}")


def _details(pf: gs.ParticleFilter, result: dict[str, Any]) -> str:
    """Return calibration, times and options of the filter."""
    s = {name: "-" if value is None else f"{value:.3g}" for name, value in result.items() if name not in _NO_NUMBER}
    lines = []
    if result["error_median"] is not None and not result["references_repeat_odometry"]:
        ranks = " ".join(f"{100 * share:.0f}" for share in result["rank_histogram"])
        lines = [
            f"error of one step     median {s['relative_median']} m, 95 % below {s['relative_95']} m",
            f"coverage              {s['coverage_50']} of the 50 %, {s['coverage_80']} of the 80 % and "
            f"{s['coverage_95']} of the 95 % regions; median NEES {s['nees_median']} (2.37 is right)",
            f"width of 95 %         {s['width_95']} m, {s['width_heading_95']} rad",
            f"ranks of references   {ranks} % in tenths (10 each is right)",
        ]
    return "\n".join([
        *lines, f"effective sample size median {s['effective_sample_size_median']}; temperature {s['temperature']}",
        f"ms per scan           predict {s['ms_predict']}, correct {s['ms_correct']}, estimate {s['ms_estimate']}",
        repr(pf),
    ])  # fmt: skip


def _verdict(result: dict[str, Any], deviations: list[float]) -> str:
    """Return the verdict with its evidence, and the likely cause if any."""
    verdict = f"{result['verdict'].upper()} (p_lost {result['p_lost']:.2g})"
    # A spread-out cloud is uncertain even without a reading.
    if result["explained_at_end"] is None and result["p_lost"] <= 0.5:
        return f"NO VERDICT: no scan at the end has a reading to judge by; {result['verdict']}"
    if result["verdict"] == "tracking":
        return f"{verdict}: {100 * result['explained_at_end']:.0f} % of the beams of the last scans agree with the map"
    evidence = result["evidence"]["text"]
    if result["verdict"] == "lost":
        return f"{verdict}: {evidence}"
    doubt = _doubt(deviations, result["evidence"]["cause"] == "none")
    return f"{verdict}: {doubt}; {evidence}" if doubt else f"{verdict}: {evidence}"


def _doubt(deviations: list[float], agrees: bool) -> str:
    """Return why a pose is uncertain despite its evidence: wide particles, or places that look alike."""
    position, heading = max(deviations[:2]), deviations[2]
    if position > spread.WIDE or heading > spread.WIDE_TURN:
        return f"the particles lie {position:.1f} m and {math.degrees(heading):.0f} degrees apart"
    return "the scans so far fit other places as well: drive on" if agrees else ""
