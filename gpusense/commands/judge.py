"""Run ``gpusense judge``: judge the poses of any localiser in a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from gpusense._util.progress import progress
from gpusense.commands.arguments import add_backend, add_json, output_path, positive_number
from gpusense.commands.scans import add_choice, add_log, options_named, read_chosen_steps

if TYPE_CHECKING:
    from gpusense.evaluation.steps import Step
    from gpusense.models.scan.model import ScanModel
    from gpusense.world.grid import OccupancyGrid

NAME = "judge"
HELP = "Judge the poses of any localiser in a recording: when they were right, when lost, and why."
FIRST = ("map", "log", "poses", "plot", "truth")

LOST = 1
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

Ctrl-C ends the run with the results so far.

Exit codes: 0 the poses were not lost, 1 they were, or no scan had a reading to judge by, 2 bad input, 130 interrupted,
143 terminated.

examples:
  gpusense judge --map map.yaml --log run.bag
  gpusense judge --map map.yaml --log run.mcap --poses /amcl_pose \\
      --plot judged.png
  gpusense judge --map map.yaml --log run.log.gz --poses run.tum \\
      --csv judged.csv
  gpusense judge --map map.yaml --log run.bag --truth true.tum --risk 0.01 \\
      --alert-limit 0.5"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("--map", required=True, type=Path, metavar="YAML", help="a map_server map")
    add_log(parser, "a log with laser scans", several="lasers that judge the poses")
    add("--poses", type=_source, metavar="SOURCE",
        help="topic of a bag with the poses, such as /amcl_pose, or /tf; or a TUM trajectory, such as run.tum "
        "(default: /tf, the only topic of poses, or the poses of a CARMEN log)")  # fmt: skip
    add("--map-frame", default="map", metavar="NAME", help="frame of the map among transforms (default: %(default)s)")
    add("--risk", type=positive_number, default=0.05, metavar="P",
        help="probability that the error exceeds the radius, at least 0.01 (default: %(default)s)")  # fmt: skip
    add("--truth", type=Path, metavar="FILE",
        help="a TUM trajectory of true poses on the map, for errors, integrity and the Stanford diagram")  # fmt: skip
    add("--alert-limit", type=positive_number, default=0.5, metavar="M",
        help="with --truth: largest error that is safe [m] (default: %(default)s)")  # fmt: skip
    add_choice(parser)
    add_backend(parser)
    add_json(parser)
    add("--plot", type=output_path(".png", ".pdf", ".svg"), metavar="FILE",
        help="draw the track on the map coloured by p_lost, p_lost and radius over time, and errors")  # fmt: skip
    add("--csv", type=output_path(".csv"), metavar="FILE", help="write a row for each pose")
    add("--record", type=output_path(".rrd"), metavar="FILE", help="record the run for the viewer Rerun")


def run(args: argparse.Namespace) -> int:
    """Judge the poses, and print the results; after Ctrl-C, the results so far."""
    from gpusense.commands.judge_report import report
    from gpusense.evaluation.judging import TrajectoryJudge
    from gpusense.evaluation.posed_scans import posed_scans
    from gpusense.evaluation.trajectory_files import read_tum
    from gpusense.world.map_files import read_map

    grid = read_map(args.map)
    truth = None if args.truth is None else read_tum(args.truth)
    steps = read_chosen_steps(args)
    with options_named():
        posed = posed_scans(args.log, steps, args.poses, map_frame=args.map_frame)
        judge = TrajectoryJudge(_models(args, grid, steps), risk=args.risk)
    try:
        with progress(len(posed.scans)) as step:
            for one in posed.scans:
                step(f"scan {one.index}")
                judge.add(one.index, one.scan, one.pose, one.covariance, one.odometry)
    except KeyboardInterrupt:
        if judge.count:
            report(args, grid, judge.result(len(steps)), posed, truth)
        raise
    found = judge.result(len(steps))
    report(args, grid, found, posed, truth)
    return 0 if found.informed and not found.lost else LOST


def _source(text: str) -> str | Path:
    """Return the file of a trajectory, or the topic of a bag."""
    path = Path(text)
    return path if path.suffix.lower() in _TRAJECTORIES or path.is_file() else text


def _models(args: argparse.Namespace, grid: OccupancyGrid, steps: list[Step]) -> list[ScanModel]:
    """Return the likelihood field of each scanner."""
    from gpusense.models.scan.field import LikelihoodFieldModel

    scanners = dict.fromkeys(step.scan.scanner for step in steps)
    return [LikelihoodFieldModel(grid, one, backend=args.backend) for one in scanners]
