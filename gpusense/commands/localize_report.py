"""Reports of ``gpusense localize``: files, and the results as text or JSON."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpusense.commands.output import print_json
from gpusense.commands.scans import scan_times
from gpusense.evaluation.machine import machine, machine_line

if TYPE_CHECKING:
    from gpusense.evaluation.tracking import Track
    from gpusense.localization.filter import ParticleFilter
    from gpusense.plots.viewer import Recording


# Figures that are not a single number.
_NO_NUMBER = ("rank_histogram", "verdict", "evidence")


def report(
    args: argparse.Namespace, pf: ParticleFilter, track: Track, chosen: int, recording: Recording | None
) -> dict[str, Any]:
    """Write the files, and print the results of all scans, or of the scans before an interrupt.

    Args:
        args: Options of the command.
        pf: The filter after the last scan.
        track: Estimates of the scans so far.
        chosen: Number of scans chosen by the options.
        recording: Recording for the viewer, or None.

    Returns:
        The figures of :func:`gpusense.evaluation.tracking.summary`.

    Raises:
        OSError, ValueError: a file cannot be written.
    """
    from gpusense.evaluation.tracking import summary
    from gpusense.evaluation.trajectory_files import write_tum

    result = summary(track)
    found = None if result["verdict"] == "tracking" else pf.diagnose()
    result["evidence"] = None if found is None else asdict(found) | {"text": found.text}
    if args.tum is not None:
        times, indices = scan_times([step.scan.time for step in track.steps])
        first = 0 if args.tum_from == "start" else _left_out(track)
        write_tum(args.tum, times[first:], track.poses[first:], indices=indices)
    if args.plot is not None:
        _draw(args.plot, pf, track)
    if recording is not None:
        recording.write(track, args.record)
    if args.json:
        options = {name: value for name, value in vars(args).items() if name not in ("run", "command", "json")}
        poses = [[step.index, *pose.tolist()] for step, pose in zip(track.steps, track.poses, strict=True)]
        document = {"options": options, "filter": repr(pf), "summary": result, "scans_chosen": chosen}
        times = [step.scan.time for step in track.steps]
        print_json(document | {"poses": poses, "times": times, "machine": machine()})
        return result
    _print(pf, result, chosen, track)
    for path in (args.tum, args.plot, args.record):
        if path is not None:
            print(f"written: {path}")
    return result


def _left_out(track: Track) -> int:
    """Return the number of scans before the filter has converged, and print it unless it is 0."""
    first = len(track.poses) if track.converged is None else track.converged
    if first:
        rule = f"the first {first} of {len(track.poses)} scans, before the verdict is 'tracking', are left out"
        print(f"gpusense: --tum: {rule}; --tum-from start writes them", file=sys.stderr)
    return first


def _print(pf: ParticleFilter, result: dict[str, Any], chosen: int, track: Track) -> None:
    """Print the summary."""
    s = {name: "-" if value is None else f"{value:.4g}" for name, value in result.items() if name not in _NO_NUMBER}
    print(f"{pf!r}\n")
    if result["scans"] < chosen:
        print(f"interrupted: results of {result['scans']} of {chosen} scans")
    print(f"scans                 {s['scans']}, temperature {s['temperature']}")
    deviations = [math.sqrt(max(value, 0.0)) for value in track.covariances[-1].diagonal()]
    print(f"last pose             {_three(track.poses[-1])}; deviations {_three(deviations)}")
    if result["scans"] > 1 and not result["odometry_moves"]:
        print("odometry              does not move: the log has none, or the robot stands")
    if 0 < result["references"] < result["scans"]:
        print(f"reference             poses of {result['references']} scans")
    if result["references_repeat_odometry"]:
        print(
            "reference             none: the logged poses are the odometry's own\n"
            f"distance from these   median {s['error_median']} m, 95 % below {s['error_95']} m"
        )
    elif result["error_median"] is not None:
        at = "never" if result["converged_at"] is None else f"after {result['converged_at']} scans"
        print(
            f"position error        median {s['error_median']} m, 95 % below {s['error_95']} m\n"
            f"heading error         median {s['heading_median']} rad, 95 % below {s['heading_95']} rad\n"
            f"error of one step     median {s['relative_median']} m, 95 % below {s['relative_95']} m\n"
            f"within 1 m, 20 deg    {at}\n"
            f"coverage              {s['coverage_50']} of the 50 %, {s['coverage_80']} of the 80 % and "
            f"{s['coverage_95']} of the 95 % regions; median NEES {s['nees_median']} (2.37 is right)\n"
            f"width of 95 %         {s['width_95']} m, {s['width_heading_95']} rad\n"
            f"ranks of references   {_ranks(result['rank_histogram'])} % in tenths (10 each is right)"
        )
    print(
        f"effective sample size median {s['effective_sample_size_median']}\n"
        f"ms per scan           predict {s['ms_predict']}, score {s['ms_score']}, resample {s['ms_resample']}, "
        f"estimate {s['ms_estimate']}\n\n"
        f"verdict: {_verdict(result, deviations)}\n\n{machine_line()}",
    )
    sys.stdout.flush()


def _three(values: Any) -> str:
    return "{:.3f} m, {:.3f} m, {:.3f} rad".format(*values)


def _ranks(histogram: list[float]) -> str:
    return " ".join(f"{100 * share:.0f}" for share in histogram)


def _verdict(result: dict[str, Any], deviations: list[float]) -> str:
    """Return the verdict with its evidence, and the likely cause if there is one."""
    p_lost = f"p_lost {result['p_lost']:.2g}"
    # A spread-out cloud is uncertain even without a reading.
    if result["explained_at_end"] is None and result["p_lost"] <= 0.5:
        return f"none, no scan at the end has a reading to judge by; {result['verdict']}, {p_lost}"
    if result["verdict"] == "tracking":
        share = f"{100 * result['explained_at_end']:.0f} % of the beams of the last scans agree with the map"
        return f"not lost (tracking), {p_lost}: {share}"
    evidence = result["evidence"]["text"]
    if result["verdict"] == "lost":
        return f"LOST, {p_lost}: {evidence}"
    wide = f"the particles lie {max(deviations[:2]):.1f} m and {deviations[2]:.2f} rad apart; "
    return f"UNCERTAIN, {p_lost}: {wide if result['p_lost'] > 0.5 else ''}{evidence}"


def _draw(path: Path, pf: ParticleFilter, track: Track) -> None:
    from gpusense.plots.drawing import save
    from gpusense.plots.tracks import track_figure

    save(track_figure(pf, track), path)
