"""Run ``gpusense localize``: localise a robot along a recorded log with a particle filter."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import gpusense as gs
from gpusense.commands.arguments import (
    Options,
    Output,
    finite_number,
    not_negative_number,
    picture,
    positive_number,
    temperature,
    tum_file,
    whole_number,
)
from gpusense.commands.localize_report import report
from gpusense.commands.parameter_files import Localization, read_localization
from gpusense.commands.scans import add_log, options_named, read_chosen_steps
from gpusense.commands.signals import working
from gpusense.evaluation import log_steps, tracking, trajectory_files
from gpusense.localization.defaults import DEFAULTS

if TYPE_CHECKING:
    from gpusense.commands.localize_report import Recorder
    from gpusense.evaluation.log_steps import Step
    from gpusense.localization.motion import MotionModel
    from gpusense.localization.nav2 import Nav2Options

FIRST = ("map", "log", "everywhere", "start", "plot")
SHARED = ("beams", "choice", "backend", "seed", "verbose")
CODES = {0: "the verdict is 'tracking'", 1: "uncertain or lost at the end, or no reading there to judge by"}


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


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("--map YAML", "a map_server map", Path, required=True)
    add_log(add, "a log with laser scans and odometry", several="lasers that correct the filter")
    add("--particles N", f"particles (default: {DEFAULTS.particles}, with --global {DEFAULTS.particles_everywhere})",
        whole_number(low=1))  # fmt: skip
    with add.exclusive():
        add("--global", "begin anywhere in the free space of the map", dest="everywhere")
        add("--start X Y THETA", "begin around a pose on the map [m, m, rad] (default: the first reference pose)",
            finite_number)  # fmt: skip
    add("--reference FILE", "a TUM trajectory of true poses on the map to compare with, by the times of the scans "
        "(default: the logged poses)", Path)  # fmt: skip
    add("--parameters YAML", "a file of 'gpusense fit --out' (beam_model, odometry_motion), or nav2's parameters "
        "(default: a likelihood field, and the noise below)", Path)  # fmt: skip
    add("--node NAME", "amcl's node in a file of nav2 with several, such as /robot1/amcl")
    add("--temperature T", "factor of log-likelihoods in (0, 1], or auto: learned from the scans",
        temperature, DEFAULTS.temperature)  # fmt: skip
    add("--motion-noise A1 A2 A3 A4", "variances of the odometry per squared motion, Probabilistic Robotics table 5.6: "
        "of turns by turns [rad^2/rad^2] and by translation [rad^2/m^2], of translations by translation and by turns "
        f"(default: {' '.join(map(str, DEFAULTS.alpha))})", not_negative_number)  # fmt: skip
    add("--sideways S", f"variance of sideways slips per squared turn [m^2/rad^2] (default: {DEFAULTS.sideways})",
        not_negative_number)  # fmt: skip
    add(
        "--reverse P", f"probability that a translation was reversed (default: {DEFAULTS.reverse})", not_negative_number
    )
    add("--fit-motion", "learn the motion noise from the reference poses of this log first")
    add("--recovery", "if scans contradict the pose: search for a rival that later scans must confirm, or inject "
        f"particles anywhere, or neither (default: {DEFAULTS.recovery})", ("sensor", "augmented", "none"))  # fmt: skip
    add("--beam-skip P", "skip beams, such as on people, that less than this share of the particles explains",
        positive_number)  # fmt: skip
    add("--tum FILE", "write the trajectory for evo", tum_file)
    add("--tum-from", "where the trajectory begins: at the first scan whose verdict is 'tracking', or at the first one",
        ("tracking", "start"), "tracking")  # fmt: skip
    add("--plot FILE", "draw map, particles, estimated and reference poses", picture)
    add("--animate FILE", "animate the run: particles, scan, verdict", Output(".gif"))
    add("--record FILE", "record the run for the viewer Rerun", Output(".rrd"))


def run(args: argparse.Namespace) -> int:
    """Localise, and print the results; after Ctrl-C, the results so far."""
    from gpusense.plots import viewer

    read = read_parameters(args)
    grid = gs.read_map(args.map)
    steps = read_chosen(args, read)
    pf = make_filter(args, grid, steps, read)
    pose, covariance = start_of(args, read.nav2) or (None, None)
    with options_named():
        tracking.start(pf, steps, everywhere=args.everywhere, pose=pose, covariance=covariance)
    track, recorders = tracking.Track(), dict[Path, "Recorder"]()
    if args.record is not None:
        recorders[args.record] = viewer.Recording(pf.grid)
    if args.animate is not None:
        recorders[args.animate] = viewer.Animation(pf.grid, len(steps))
    with working(track.steps, len(steps)) as step:
        step("starting")
        for one in tracking.follow(pf, steps, track):
            step(_text(track, one))
            for recorder in recorders.values():
                recorder.add(pf, track, one)
    found = report(args, pf, track, len(steps), recorders)
    return int(found["verdict"] != "tracking" or found["explained_at_end"] is None)


def _text(track: tracking.Track, step: Step) -> str:
    errors = track.errors()
    error = "" if errors is None or math.isnan(errors[0][-1]) else f", error {errors[0][-1]:.2f} m"
    rate = 1 / max(sum(track.seconds[-1]), 1e-9)
    return f"scan {step.index}{error}, {track.sizes[-1]:.0f} effective, {rate:.0f} scans/s"


def read_parameters(args: argparse.Namespace) -> Localization:
    """Read ``--parameters``, and print the parameters of a nav2 file that have no effect."""
    if args.parameters is None:
        if args.node is not None:
            raise ValueError(f"--node: must come with --parameters, got {args.node} alone")
        return Localization(None, {})
    with options_named():
        read = read_localization(args.parameters, args.node)
    if read.nav2 is not None and read.nav2.ignored:
        sys.stderr.write(f"gpusense: {args.parameters}: without effect here: {', '.join(read.nav2.ignored)}\n")
    return read


def read_chosen(args: argparse.Namespace, read: Localization) -> list[Step]:
    """Read the chosen scans, with the poses of ``--reference`` if set."""
    steps = read_chosen_steps(args)
    if read.nav2 is not None:
        near, far = read.nav2.range_limits
        steps = _limited(steps, near, None if args.range_max is not None else far)
    if args.reference is None:
        return steps
    steps = log_steps.with_references(steps, *trajectory_files.read_tum(args.reference))
    if args.everywhere or start_of(args, read.nav2) is not None:
        return steps
    # The run begins at the first reference pose.
    return steps[next(i for i, step in enumerate(steps) if step.reference is not None) :]


def _limited(steps: list[Step], near: float | None, far: float | None) -> list[Step]:
    """Return steps with scanners limited to a range_min and a range_max, like nav2_amcl's."""
    scanners: dict[gs.Scanner, gs.Scanner] = {}
    for step in steps:
        if (one := step.scan.scanner) not in scanners:
            least = one.range_min if near is None else max(near, one.range_min)
            most = one.range_max if far is None else min(far, one.range_max)
            scanners[one] = gs.Scanner(one.bearings, most, least, one.mount)
    return [replace(step, scan=replace(step.scan, scanner=scanners[step.scan.scanner])) for step in steps]


def start_of(args: argparse.Namespace, nav2: Nav2Options | None) -> tuple[Any, Any] | None:
    """Return pose and covariance of the start from ``--start`` or nav2's file; None for the first reference pose."""
    usual = np.diag(np.square(DEFAULTS.start))
    if args.start is not None:
        return args.start, usual
    if nav2 is None or nav2.initial_pose is None:
        return None
    return nav2.initial_pose, usual if nav2.initial_covariance is None else np.array(nav2.initial_covariance)


def make_filter(
    args: argparse.Namespace, grid: gs.OccupancyGrid, steps: list[Step], read: Localization
) -> gs.ParticleFilter:
    """Make the filter, with a model for each laser; options of the command line override the file."""
    scanners = {step.sensor: step.scan.scanner for step in steps}
    parameters, nav2 = read.sensor, read.nav2
    beams = args.beams or (DEFAULTS.beams if nav2 is None else nav2.max_beams)
    kind: Any = gs.BeamModel if isinstance(parameters, gs.BeamParameters) else gs.LikelihoodFieldModel
    models = [kind(grid, scanners[one], parameters, beams=beams, backend=args.backend) for one in sorted(scanners)]
    chosen: dict[str, Any] = dict(
        particles=DEFAULTS.particles_everywhere if args.everywhere else DEFAULTS.particles,
        recovery=DEFAULTS.recovery,
        beam_skip=None,
    )
    if nav2 is not None:
        most = DEFAULTS.particles_everywhere if args.everywhere else nav2.particles[1]
        chosen = dict(
            particles=(nav2.particles[0], max(most, nav2.particles[1])), beam_skip=nav2.beam_skip,
            recovery="augmented" if all(nav2.recovery) else None,
        )  # fmt: skip
    given = {name: getattr(args, name) for name in chosen if getattr(args, name) is not None}
    if args.recovery == "none":
        given["recovery"] = None
    return gs.ParticleFilter(
        models, motion=_motion(args, steps, read), seed=args.seed, temperature=args.temperature, **(chosen | given)
    )


def _motion(args: argparse.Namespace, steps: list[Step], read: Localization) -> MotionModel:
    """Return the motion model from the options, or else from the file of parameters."""
    options = dict(alpha=args.motion_noise, sideways=args.sideways, reverse=args.reverse)
    given = {name: value for name, value in options.items() if value is not None}
    if args.fit_motion:
        for name in ("motion_noise", "sideways", "reverse"):
            if getattr(args, name) is not None:
                option = "--" + name.replace("_", "-")
                raise ValueError(f"--fit-motion: must be given without {option}, which it learns, got both")
        fit = gs.fit_odometry_motion(*log_steps.references_to_learn_from(steps))
        if fit.undetermined:
            names = ", ".join(fit.undetermined)
            print(f"gpusense: --fit-motion: the log does not determine {names}: at most the default", file=sys.stderr)
        return fit.motion
    if read.nav2 is None:
        return gs.OdometryMotion(**read.noise | given)
    if read.nav2.motion == "omni" and not given:
        return read.nav2.make_motion()
    return gs.OdometryMotion(**dict(alpha=read.nav2.alpha[:4]) | given)
