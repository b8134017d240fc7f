"""Run ``gpusense judge``: judge the poses of any localiser in a recording."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import gpusense as gs
from gpusense.commands import output
from gpusense.commands.arguments import Options, Output, csv_file, picture, positive_number
from gpusense.commands.output import counted, draw, length, write_table
from gpusense.commands.scans import add_log, options_named, read_chosen_steps
from gpusense.commands.signals import working
from gpusense.evaluation import judging, log_steps, trajectory_files

if TYPE_CHECKING:
    from gpusense.evaluation.log_steps import Step
    from gpusense.models.scan.model import ScanModel

FIRST = ("map", "log", "poses", "plot", "truth")
SHARED = ("choice", "backend", "json")
CODES = {0: "the poses were not lost", 1: "they were, or no scan had a reading to judge by"}

# Suffixes of trajectories.
_TRAJECTORIES = (".tum", ".txt")

EPILOG = """\
Poses come from a topic of a bag (geometry_msgs/PoseWithCovarianceStamped or PoseStamped, nav_msgs/Odometry), the
transforms from the map to the robot's base (/tf), a TUM trajectory, or the poses that a CARMEN log contains. The
default is the transforms, if the bag has them, else the only topic of poses. A pose belongs to a scan if it has the
scan's time within 0.05 s, or lies between poses that are at most 0.5 s apart.

p_lost is the probability that the pose is off by more than 1 m or 0.5 rad. A pose is 'lost' if scans contradict it,
and 'uncertain' where they leave doubt. The radius is the distance that the error of the position exceeds with at most
the probability --risk. The whole map is searched for some of the scans of each lost stretch.

--truth adds the integrity: a pose is available if its radius is at most --alert-limit. It is then misleading if its
error exceeds the radius but not the alert limit, and hazardously misleading if it exceeds the alert limit. The time to
alert is counted from the first scan with an error above the limit to the first radius above it.

examples:
  gpusense judge --map map.yaml --log run.bag
  gpusense judge --map map.yaml --log run.mcap --poses /amcl_pose \\
      --plot judged.png
  gpusense judge --map map.yaml --log run.log.gz --poses run.tum \\
      --csv judged.csv
  gpusense judge --map map.yaml --log run.bag --truth true.tum --risk 0.01 \\
      --alert-limit 0.5"""


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("--map YAML", "a map_server map", Path, required=True)
    add_log(add, "a log with laser scans", several="lasers that judge the poses")
    add("--poses SOURCE", "topic of a bag with the poses, such as /amcl_pose, or /tf; or a TUM trajectory, such as "
        "run.tum (default: /tf, the only topic of poses, or the poses of a CARMEN log)", _source)  # fmt: skip
    add("--map-frame NAME", "frame of the map among transforms", default="map")
    add("--risk P", "probability that the error exceeds the radius, at least 0.01", positive_number, 0.05)
    add(
        "--truth FILE",
        "a TUM trajectory of true poses on the map, for errors, integrity and the Stanford diagram",
        Path,
    )
    add("--alert-limit M", "with --truth: largest error that is safe [m]", positive_number, 0.5)
    add("--plot FILE", "draw the track on the map coloured by p_lost, p_lost and radius over time, and errors", picture)
    add("--csv FILE", "write a row for each pose", csv_file)
    add("--record FILE", "record the run for the viewer Rerun", Output(".rrd"))


def run(args: argparse.Namespace) -> int:
    """Judge the poses, and print the results; after Ctrl-C, the results so far."""
    grid = gs.read_map(args.map)
    truth = None if args.truth is None else trajectory_files.read_tum(args.truth)
    steps = read_chosen_steps(args)
    with options_named():
        source, posed = log_steps.posed_scans(args.log, steps, args.poses, map_frame=args.map_frame)
        judge = judging.TrajectoryJudge(_models(args, grid, steps), risk=args.risk)
    with working(judge, len(posed)) as step:
        for one in posed:
            step(f"scan {one.index}")
            judge.add(one.index, one.scan, np.array(one.reference), one.covariance, one.odometry)
    found = judge.result(len(steps))
    _report(args, grid, found, source, [one.scan for one in posed[: len(judge)]], truth)
    return int(found.lost or not found.informed)


def _source(text: str) -> str | Path:
    """Return the file of a trajectory, or the topic of a bag."""
    path = Path(text)
    return path if path.suffix.lower() in _TRAJECTORIES or path.is_file() else text


def _models(args: argparse.Namespace, grid: gs.OccupancyGrid, steps: list[Step]) -> list[ScanModel]:
    """Return the likelihood field of each scanner."""
    scanners = dict.fromkeys(step.scan.scanner for step in steps)
    return [gs.LikelihoodFieldModel(grid, one, backend=args.backend) for one in scanners]


def _report(
    args: argparse.Namespace, grid: gs.OccupancyGrid, found: gs.Judgement, source: str, scans: Sequence[gs.Scan],
    truth: tuple[np.ndarray, np.ndarray] | None,
) -> None:  # fmt: skip
    """Write the files, and print the results."""
    from gpusense.plots.runs import judgement_figure
    from gpusense.plots.viewer import Recording

    errors, rated = np.full(len(found.times), math.nan), None
    if truth is not None:
        errors = judging.errors_of(found, *truth)
        known = np.isfinite(errors)
        times = found.times[known] if (np.diff(found.times[known]) > 0).all() else None
        rated = gs.integrity(errors[known], found.radii[known], alert_limit=args.alert_limit, times=times)
    x, y, theta = found.poses.T
    write_table(
        args.csv, scan=found.index, time=[f"{time:.6f}" for time in found.times], x=x, y=y, theta=theta,
        p_lost=found.p_lost, verdict=found.verdicts, explained=found.explained, radius=found.radii, error=errors,
    )  # fmt: skip
    draw(args.plot, lambda: judgement_figure(grid, found, rated, errors))
    if args.record is not None:
        Recording(grid, "judge").write_judgement(found, scans, args.record)
    if args.json:
        output.report(_document(found, source, rated, errors), args)
        return
    output.result(headline(found))
    output.fact("poses", f"{len(found.times)} of {counted(found.scans, 'scan')}, by {source}")
    print_stretches(found.stretches, float(found.times[0]), found.risk)
    if rated is not None:
        _print_integrity(rated, found.risk)
    output.files(args.plot, args.csv, args.record)


def headline(found: gs.Judgement) -> str:
    """Return the verdict in one line, the worst stretches first."""
    total, unsure, begin = _seconds(found.duration()), found.duration("uncertain"), float(found.times[0])
    if not found.informed:
        return f"NO VERDICT: no scan of {total} has a reading to judge by"
    if len(found.times) == 1:
        (verdict,) = found.verdicts
        word = "RIGHT" if verdict == "tracking" else verdict.upper()
        return f"{word} at its only pose; p_lost {found.p_lost[0]:.2g}"
    parts = [_lost([one for one in found.stretches if one.verdict == "lost"], begin)] if found.lost else []
    parts += [f"uncertain for {_seconds(unsure)}"] if unsure else []
    parts.append(f"right for {_seconds(found.duration('tracking'), unit=False)} of {total}")
    parts += [f"p_lost at most {found.p_lost.max():.2g}"] if len(parts) == 1 else []
    word, space, rest = "; ".join(parts).partition(" ")
    return f"{word.upper()}{space}{rest}"


def _lost(lost: Sequence[gs.Stretch], begin: float) -> str:
    """Return when the poses were lost, and how far off."""
    off = max((one.off for one in lost if not math.isnan(one.off)), default=math.nan)
    away = "" if math.isnan(off) else f", {'up to ' if len(lost) > 1 else ''}{off:.1f} m off the likeliest place"
    if len(lost) == 1:
        return f"lost from {lost[0].start - begin:.1f} s to {lost[0].end - begin:.1f} s{away}"
    total = sum(one.duration for one in lost)
    return f"lost for {_seconds(total)} in {len(lost)} stretches, first from {lost[0].start - begin:.1f} s{away}"


def _seconds(time: float, *, unit: bool = True) -> str:
    return (f"{time:.0f}" if time >= 9.95 else f"{time:.1f}") + (" s" if unit else "")


def _print_integrity(rated: gs.Integrity, risk: float) -> None:
    output.fact(
        "integrity",
        f"hazardously misleading {100 * rated.hazardous:.3g} %, misleading {100 * rated.misleading:.3g} %, available "
        f"{100 * rated.available:.3g} % of {counted(len(rated.errors), 'pose')} with a truth, at risk {risk:g} and "
        f"alert limit {rated.alert_limit:g} m",
    )
    output.fact("error", f"median {length(float(np.median(rated.errors)))}; above the radius in "
                f"{100 * rated.exceeded:.3g} % of the poses")  # fmt: skip
    delays = rated.times_to_alert
    if len(delays):
        alerted = delays[np.isfinite(delays)]
        longest = f", after at most {alerted.max():.2g} s" if len(alerted) else ""
        output.fact("alerts", f"{len(alerted)} of {counted(len(delays), 'error')} above the alert limit{longest}")


def _document(found: gs.Judgement, source: str, rated: gs.Integrity | None, errors: np.ndarray) -> dict[str, Any]:
    names = ("lost", "informed", "scans", "risk", "index", "times", "poses", "p_lost", "verdicts", "explained", "radii")
    result = {name: getattr(found, name) for name in names} | {
        "verdict": headline(found), "source": source, "stretches": stretch_rows(found.stretches), "integrity": None,
        "seconds": {word: found.duration(word) for word in ("tracking", "uncertain", "lost")},
    }  # fmt: skip
    if rated is not None:
        figures = ("alert_limit", "hazardous", "misleading", "available", "exceeded", "times_to_alert")
        rates = {"poses": len(rated.errors)} | {name: getattr(rated, name) for name in figures}
        result |= {"errors": errors, "integrity": rates}
    return result


# Most stretches that are printed.
_MOST = 12


def print_stretches(stretches: Sequence[gs.Stretch], begin: float, risk: float) -> None:
    """Print the stretches, the worst ones of many, by time since ``begin`` [s]."""
    order = {"lost": 0, "uncertain": 1, "tracking": 2}
    chosen = sorted(stretches, key=lambda one: (order[one.verdict], -one.duration))[:_MOST]
    for one in sorted(chosen, key=lambda one: one.first):
        output.fact(one.verdict, _summary(one, begin, risk))
        if one.place is not None:
            output.fact("", _place(one))
        if one.diagnosis is not None:
            output.fact("", one.diagnosis.text)
    if len(chosen) < len(stretches):
        output.fact("", f"and {len(stretches) - len(chosen)} shorter ones; --json lists all")


def _summary(one: gs.Stretch, begin: float, risk: float) -> str:
    share, radius = "no beam to judge by", ""
    if math.isfinite(one.explained):
        share = f"{100 * one.explained:.0f} % of the beams explained"
    if math.isfinite(one.radius):
        some = "" if one.promised == 1 else f" ({math.floor(100 * one.promised)} % of the scans)"
        radius = f", within {length(one.radius)} at risk {risk:g}{some}"
    return f"{one.start - begin:.1f} s to {one.end - begin:.1f} s: p_lost at most {one.p_lost:.2g}, {share}{radius}"


def _place(one: gs.Stretch) -> str:
    assert one.place is not None
    if one.place.status == "no match":
        return "no place of the map explains the scans"
    x, y, theta = one.place.pose.tolist()
    sure = "more likely at" if one.place.status == "found" else "among several places, likeliest at"
    return (
        f"{sure} x = {x:.2f}, y = {y:.2f}, theta = {theta:.2f} (p_right {one.place.p_right:.2g}), {one.off:.1f} m off"
    )


def stretch_rows(stretches: Sequence[gs.Stretch]) -> list[dict[str, Any]]:
    """Return the stretches as JSON documents."""
    rows = []
    for one in stretches:
        names = ("verdict", "first", "last", "start", "end", "p_lost", "explained", "radius", "promised", "pose", "off")
        row = {name: getattr(one, name) for name in names}
        place = one.place
        row["place"] = place and {"pose": place.pose, "p_right": place.p_right, "status": place.status}
        row["evidence"] = None if one.diagnosis is None else asdict(one.diagnosis) | {"text": one.diagnosis.text}
        rows.append(row)
    return rows
