"""Run ``gpusense localize``: localise a robot along a recorded log with a particle filter."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from gpusense.localization.defaults import DEFAULTS

if TYPE_CHECKING:
    from gpusense.evaluation.steps import Step
    from gpusense.evaluation.tracking import Track
    from gpusense.localization.filter import ParticleFilter
    from gpusense.localization.motion import MotionModel
    from gpusense.plots.viewer import Recording

NAME = "localize"
HELP = "Localise a robot along a recorded log with a particle filter."

LOST = 1

_EPILOG = """\
The filter begins around the first reference pose or that of --start, with deviations of 0.5 m and 0.26 rad, or with
--global anywhere in the free space of the map. It moves with the log's odometry and weighs each chosen scan. Errors
are those of the weighted mean against reference poses: those of --reference, or the logged ones. Coverage is the share
of reference poses inside the 50, 80 and 95 % regions of the estimate. A rank is the share of particles behind a
reference pose, to its right, or clockwise of it: many near 0 and 100 % are overconfidence. NEES is the squared distance
of a reference pose in deviations.

The verdict at the end does not need reference poses. It is 'tracking'; 'uncertain', where the particles lie apart or
the scans leave doubt; or 'lost', where scans contradict the pose, as beams that pass through walls do on a wrong map.
p_lost is the probability that the pose is off by more than 1 m or 0.5 rad. Evidence and the likely cause follow it.

Ctrl-C ends the run with the results so far, and writes the files.

Exit codes: 0 the verdict is 'tracking', 1 uncertain or lost at the end, or no reading there to judge by, 2 bad input,
130 interrupted.

example:
  gpusense localize --map map.yaml --log run.log.gz
  gpusense localize --map map.yaml --log run.log.gz --global --particles 20000 --tum run.tum --plot run.png
  gpusense localize --map map.yaml --log run.log.gz --start 1.5 -2 0.3
  gpusense localize --map map.yaml --log run.log.gz --every 2 --offset 1 --parameters fitted/parameters.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.epilog = _EPILOG
    add = parser.add_argument
    add("--map", required=True, type=Path, metavar="YAML", help="a map_server map")
    add(
        "--log",
        required=True,
        type=Path,
        metavar="FILE",
        help="a log with laser scans and odometry: CARMEN or Wean Hall, plain or .gz, rosbag 1 or 2, MCAP",
    )
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
        help="a file with beam_model or odometry_motion, such as 'gpusense fit --out' writes (default: a likelihood "
        "field, and the noise below)")  # fmt: skip
    add(
        "--sensors",
        nargs="+",
        default=[],
        metavar="NAME",
        help="lasers that correct the filter: topics of a bag, front or rear of a CARMEN log (default: its main laser)",
    )
    add("--beams", type=whole_number(low=1), metavar="B", help="thin each scan evenly to B beams (default: all)")
    add_temperature(parser, "auto: learned from the scans")
    add("--motion-noise", type=not_negative_number, nargs=4, metavar=("A1", "A2", "A3", "A4"),
        help="variances of the odometry per squared motion, Probabilistic Robotics table 5.6: of turns by turns "
        "[rad^2/rad^2] and by translation [rad^2/m^2], of translations by translation and by turns "
        f"(default: {' '.join(map(str, DEFAULTS.alpha))})")  # fmt: skip
    add("--sideways", type=not_negative_number, metavar="S",
        help="variance of slips to the side per squared turn [m^2/rad^2] "
        f"(default: {DEFAULTS.sideways})")  # fmt: skip
    add("--reverse", type=not_negative_number, metavar="P",
        help=f"probability that a translation went the other direction (default: {DEFAULTS.reverse})")  # fmt: skip
    add("--fit-motion", action="store_true", help="learn the motion noise from the reference poses of this log first")
    add("--recovery", choices=("augmented", "sensor"),
        help="inject particles when the filter is lost: anywhere, or where the scan is likely (default: only a start "
        "with --global is repeated)")  # fmt: skip
    add("--beam-skip", type=positive_number, metavar="P",
        help="leave out beams, such as of people, that less than this share of the particles explains")  # fmt: skip
    add("--every", type=whole_number(low=1), default=1, metavar="E", help="every E-th scan, from --offset on")
    add("--offset", type=whole_number(low=0), default=0, metavar="O", help="index of the first scan (default: 0)")
    add("--limit", type=whole_number(low=1), metavar="S", help="largest number of scans (default: all)")
    add("--range-max", type=positive_number, metavar="M",
        help="readings of at least this are 'no return' [m] (default: the log's reading for 'no return')")  # fmt: skip
    add_backend(parser)
    add_seed(parser)
    add_json(parser)
    add("--tum", type=output_path(".tum", ".txt"), metavar="FILE", help="write the trajectory, as evo reads it")
    add("--tum-from", choices=("tracking", "start"), default="tracking",
        help="where the trajectory begins: at the first scan whose verdict is 'tracking', or at the first one "
        "(default: %(default)s)")  # fmt: skip
    add("--plot", type=output_path(".png", ".pdf", ".svg"), metavar="FILE",
        help="draw map, particles, estimated and reference poses")  # fmt: skip
    add("--record", type=output_path(".rrd"), metavar="FILE", help="record the run for the viewer Rerun")


def run(args: argparse.Namespace) -> int:
    """Localise, and print the results; after Ctrl-C those so far."""
    from gpusense.commands.localize_report import report
    from gpusense.evaluation.tracking import Track, follow, start

    steps = _steps(args)
    pf = _filter(args, steps)
    start(pf, steps, everywhere=args.everywhere, pose=args.start)
    track, recording = Track(), _recording(args, pf)
    try:
        with progress(len(steps)) as step:
            step("starting")
            for one in follow(pf, steps, track):
                step(_text(track, one))
                if recording is not None:
                    recording.add(pf, track, one)
    except KeyboardInterrupt:
        if track.steps:
            report(args, pf, track, len(steps), recording)
        raise
    found = report(args, pf, track, len(steps), recording)
    return 0 if found["verdict"] == "tracking" and found["explained_at_end"] is not None else LOST


def _steps(args: argparse.Namespace) -> list[Step]:
    """Read the chosen scans, with the poses of ``--reference`` where it is given.

    Raises:
        ValueError: a file breaks its format, or has no scan or pose of these.
    """
    from gpusense.evaluation.steps import read_steps, with_references
    from gpusense.evaluation.trajectory_files import read_tum

    try:
        steps = read_steps(
            args.log, range_max=args.range_max, every=args.every, offset=args.offset, limit=args.limit,
            sensors=args.sensors,
        )  # fmt: skip
    except ValueError as error:
        # The option has another name than the arguments.
        rest = str(error).removeprefix("topic: ").removeprefix("sensors: ")
        raise (error if rest == str(error) else ValueError(f"--sensors: {rest}")) from None
    if args.reference is None:
        return steps
    steps = with_references(steps, *read_tum(args.reference))
    if args.everywhere or args.start is not None:
        return steps
    # The run begins around the first reference pose.
    return steps[next(i for i, step in enumerate(steps) if step.reference is not None) :]


def _recording(args: argparse.Namespace, pf: ParticleFilter) -> Recording | None:
    """Begin a recording; None where none is asked for.

    Raises:
        ValueError: the library is not installed.
    """
    if args.record is None:
        return None
    from gpusense.plots.viewer import Recording

    try:
        return Recording(pf.grid)
    except ImportError as error:
        raise ValueError(f"--record: {error}") from None


def _filter(args: argparse.Namespace, steps: list[Step]) -> ParticleFilter:
    """Make the filter, with a model for each laser.

    Raises:
        ValueError: an option breaks its rule, a file its format, or the backend is absent.
    """
    from gpusense.commands.parameter_files import read_localization
    from gpusense.localization.filter import ParticleFilter
    from gpusense.models.scan.beam import BeamModel
    from gpusense.models.scan.field import LikelihoodFieldModel
    from gpusense.world.map_files import read_map
    from gpusense.world.parameters import LikelihoodFieldParameters

    grid = read_map(args.map)
    scanners = {step.sensor: step.scan.scanner for step in steps}
    for sensor, name in enumerate(args.sensors):
        if sensor not in scanners:
            raise ValueError(f"--sensors: must have scans that are chosen, got none of {name}")
    beams = DEFAULTS.beams if args.beams is None else args.beams
    beam, noise = (None, {}) if args.parameters is None else read_localization(args.parameters)
    field = LikelihoodFieldParameters(**DEFAULTS.field)
    models: list[Any] = [
        LikelihoodFieldModel(grid, scanners[sensor], field, beams=beams, backend=args.backend)
        if beam is None
        else BeamModel(grid, scanners[sensor], beam, beams=beams, backend=args.backend)
        for sensor in sorted(scanners)
    ]
    particles = DEFAULTS.particles_everywhere if args.everywhere else DEFAULTS.particles
    return ParticleFilter(
        models, motion=_motion(args, steps, noise), particles=particles if args.particles is None else args.particles,
        seed=args.seed, temperature=args.temperature, recovery=args.recovery, beam_skip=args.beam_skip,
    )  # fmt: skip


def _motion(args: argparse.Namespace, steps: list[Step], noise: dict[str, Any]) -> MotionModel:
    """Return the motion model of the options, and of the file of parameters where an option is not given.

    Raises:
        ValueError: there are no logged poses to learn from, or a number breaks its rule.
    """
    from gpusense.evaluation.steps import references_to_learn_from
    from gpusense.localization.motion import OdometryMotion
    from gpusense.localization.motion_fit import fit_odometry_motion

    if args.fit_motion:
        for name in ("motion_noise", "sideways", "reverse"):
            if getattr(args, name) is not None:
                option = "--" + name.replace("_", "-")
                raise ValueError(f"--fit-motion: must be given without {option}, which it learns, got both")
        fit = fit_odometry_motion(*references_to_learn_from(steps))
        if fit.undetermined:
            names = ", ".join(fit.undetermined)
            print(f"gpusense: --fit-motion: the log does not determine {names}: at most the default", file=sys.stderr)
        return fit.motion
    given = dict(alpha=args.motion_noise, sideways=args.sideways, reverse=args.reverse)
    return OdometryMotion(**noise | {name: value for name, value in given.items() if value is not None})


def _text(track: Track, step: Step) -> str:
    errors = track.errors()
    error = "" if errors is None or math.isnan(errors[0][-1]) else f", error {errors[0][-1]:.2f} m"
    rate = 1 / max(sum(track.seconds[-1]), 1e-9)
    return f"scan {step.index}{error}, {track.sizes[-1]:.0f} effective, {rate:.0f} scans/s"
