"""Run ``gpusense localize``: localise a robot along a recorded log with a particle filter."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from gpusense._util.progress import progress
from gpusense.commands.arguments import (
    add_backend,
    add_json,
    add_seed,
    add_temperature,
    finite_number,
    not_negative_number,
    output_path,
    positive_number,
    whole_number,
)
from gpusense.commands.scans import add_choice, add_log
from gpusense.commands.signals import held
from gpusense.localization.defaults import DEFAULTS

if TYPE_CHECKING:
    from gpusense.commands.localize_report import Recorder
    from gpusense.evaluation.steps import Step
    from gpusense.evaluation.tracking import Track
    from gpusense.localization.filter import ParticleFilter

NAME = "localize"
HELP = "Localise a robot along a recorded log with a particle filter."
FIRST = ("map", "log", "everywhere", "start", "plot")

LOST = 1

EPILOG = """\
The filter starts at --start or at the first reference pose, with deviations of 0.5 m and 0.26 rad, or with --global
anywhere in the free space of the map. It moves with the log's odometry and weighs each chosen scan. The weighted mean
is compared with reference poses, from --reference or from the log. Errors count from the first of five consecutive
scans within 1 m and 20 degrees. -v also prints calibration and times: coverage is the share of reference poses inside
the 50, 80 and 95 % regions of the estimate; a rank is the share of particles behind a reference pose, to its right, or
clockwise of it, and many ranks near 0 and 100 % show overconfidence; NEES is the squared distance of a reference pose
in deviations.

The first line is the verdict, which needs no reference poses: 'tracking'; 'uncertain' for spread-out particles or
doubtful scans; or 'lost' if scans contradict the pose, as beams through walls do on a wrong map. p_lost is the
probability that the pose is off by more than 1 m or 0.5 rad.

A file of nav2 sets amcl's model, beams, particles, noise of the odometry, recovery and initial pose; options of this
command take precedence. Its frames, topics and gates (update_min_d, update_min_a, resample_interval) have no effect.

Ctrl-C ends the run with the results so far, and writes the files.

Exit codes: 0 the verdict is 'tracking', 1 uncertain or lost at the end, or no reading there to judge by, 2 bad input,
130 interrupted, 143 terminated.

examples:
  gpusense localize --map map.yaml --log run.log.gz
  gpusense localize --map map.yaml --log run.log.gz --global \\
      --particles 20000 --tum run.tum --plot run.png
  gpusense localize --map map.yaml --log run.bag --global --animate run.gif
  gpusense localize --map map.yaml --log run.bag --topic /front \\
      --start 1.5 -2 0.3
  gpusense localize --map map.yaml --log run.mcap --parameters nav2_params.yaml
  gpusense localize --map map.yaml --log run.log.gz --every 2 --offset 1 \\
      --parameters fitted/parameters.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("--map", required=True, type=Path, metavar="YAML", help="a map_server map")
    add_log(parser, "a log with laser scans and odometry", several="lasers that correct the filter")
    add("--particles", type=whole_number(low=1), metavar="N",
        help=f"particles (default: {DEFAULTS.particles}, with --global {DEFAULTS.particles_everywhere})")  # fmt: skip
    begin = parser.add_mutually_exclusive_group()
    begin.add_argument("--global", dest="everywhere", action="store_true",
        help="begin anywhere in the free space of the map")  # fmt: skip
    begin.add_argument("--start", type=finite_number, nargs=3, metavar=("X", "Y", "THETA"),
        help="begin around a pose on the map [m, m, rad] (default: the first reference pose, at its scan)")  # fmt: skip
    add("--reference", type=Path, metavar="FILE",
        help="a TUM trajectory of true poses on the map to compare with, by the times of the scans (default: the "
        "logged poses)")  # fmt: skip
    add("--parameters", "--params", type=Path, metavar="YAML",
        help="a file with beam_model or odometry_motion, such as 'gpusense fit --out' writes, or nav2's parameters of "
        "amcl (default: a likelihood field, and the noise below)")  # fmt: skip
    add("--node", metavar="NAME", help="amcl's node in a file of nav2 with several, such as /robot1/amcl")
    add("--beams", type=whole_number(low=1), metavar="B", help="thin each scan evenly to B beams (default: all)")
    add_temperature(parser, "auto: learned from the scans")
    add("--motion-noise", type=not_negative_number, nargs=4, metavar=("A1", "A2", "A3", "A4"),
        help="variances of the odometry per squared motion, Probabilistic Robotics table 5.6: of turns by turns "
        "[rad^2/rad^2] and by translation [rad^2/m^2], of translations by translation and by turns "
        f"(default: {' '.join(map(str, DEFAULTS.alpha))})")  # fmt: skip
    add("--sideways", type=not_negative_number, metavar="S",
        help="variance of sideways slips per squared turn [m^2/rad^2] "
        f"(default: {DEFAULTS.sideways})")  # fmt: skip
    add("--reverse", type=not_negative_number, metavar="P",
        help=f"probability that a translation was reversed (default: {DEFAULTS.reverse})")  # fmt: skip
    add("--fit-motion", action="store_true", help="learn the motion noise from the reference poses of this log first")
    add("--recovery", choices=("sensor", "augmented", "none"),
        help="if scans contradict the pose: search for a rival that later scans must confirm, or inject particles "
        f"anywhere, or neither (default: {DEFAULTS.recovery})")  # fmt: skip
    add("--beam-skip", type=positive_number, metavar="P",
        help="skip beams, such as on people, that less than this share of the particles explains")  # fmt: skip
    add_choice(parser)
    add_backend(parser)
    add_seed(parser)
    add_json(parser, verbose=True)
    add("--tum", type=output_path(".tum", ".txt"), metavar="FILE", help="write the trajectory for evo")
    add("--tum-from", choices=("tracking", "start"), default="tracking",
        help="where the trajectory begins: at the first scan whose verdict is 'tracking', or at the first one "
        "(default: %(default)s)")  # fmt: skip
    add("--plot", type=output_path(".png", ".pdf", ".svg"), metavar="FILE",
        help="draw map, particles, estimated and reference poses")  # fmt: skip
    add("--animate", type=output_path(".gif"), metavar="FILE", help="animate the run: particles, scan, verdict")
    add("--record", type=output_path(".rrd"), metavar="FILE", help="record the run for the viewer Rerun")


def run(args: argparse.Namespace) -> int:
    """Localise, and print the results; after Ctrl-C, the results so far."""
    from gpusense.commands.localize_report import report
    from gpusense.commands.localize_setup import make_filter, read_chosen, read_parameters, start_of
    from gpusense.evaluation.tracking import Track, follow, start
    from gpusense.world.map_files import read_map

    read = read_parameters(args)
    grid = read_map(args.map)
    steps = read_chosen(args, read)
    pf = make_filter(args, grid, steps, read)
    pose, covariance = start_of(args, read.nav2) or (None, None)
    start(pf, steps, everywhere=args.everywhere, pose=pose, covariance=covariance)
    track, recorders = Track(), _recorders(args, pf, len(steps))
    with held(track.steps) as stops, progress(len(steps)) as step:
        step("starting")
        for one in follow(pf, steps, track):
            step(_text(track, one))
            for recorder in recorders.values():
                recorder.add(pf, track, one)
    found = report(args, pf, track, len(steps), recorders)
    if stops:
        raise stops[0]
    return 0 if found["verdict"] == "tracking" and found["explained_at_end"] is not None else LOST


def _recorders(args: argparse.Namespace, pf: ParticleFilter, scans: int) -> dict[Path, Recorder]:
    """Return the recorders of the run by their files."""
    recorders: dict[Path, Recorder] = {}
    if args.record is not None:
        from gpusense.plots.viewer import Recording

        recorders[args.record] = Recording(pf.grid)
    if args.animate is not None:
        from gpusense.plots.animation import Animation

        recorders[args.animate] = Animation(pf.grid, scans)
    return recorders


def _text(track: Track, step: Step) -> str:
    errors = track.errors()
    error = "" if errors is None or math.isnan(errors[0][-1]) else f", error {errors[0][-1]:.2f} m"
    rate = 1 / max(sum(track.seconds[-1]), 1e-9)
    return f"scan {step.index}{error}, {track.sizes[-1]:.0f} effective, {rate:.0f} scans/s"
