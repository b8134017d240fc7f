"""Prepare ``gpusense localize``: scans of the log, the filter with its models, and its start."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from gpusense.commands.parameter_files import Localization, read_localization
from gpusense.commands.scans import options_named, read_chosen_steps
from gpusense.localization.defaults import DEFAULTS
from gpusense.world.scanner import Scanner

if TYPE_CHECKING:
    from gpusense.evaluation.steps import Step
    from gpusense.localization.filter import ParticleFilter
    from gpusense.localization.motion import MotionModel
    from gpusense.localization.nav2 import Nav2Options
    from gpusense.world.grid import OccupancyGrid


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
    from gpusense.evaluation.steps import with_references
    from gpusense.evaluation.trajectory_files import read_tum

    steps = read_chosen_steps(args)
    if read.nav2 is not None:
        near, far = read.nav2.range_limits
        steps = _limited(steps, near, None if args.range_max is not None else far)
    if args.reference is None:
        return steps
    steps = with_references(steps, *read_tum(args.reference))
    if args.everywhere or start_of(args, read.nav2) is not None:
        return steps
    # The run begins at the first reference pose.
    return steps[next(i for i, step in enumerate(steps) if step.reference is not None) :]


def _limited(steps: list[Step], near: float | None, far: float | None) -> list[Step]:
    """Return steps with scanners limited to a range_min and a range_max, like nav2_amcl's."""
    scanners: dict[Scanner, Scanner] = {}
    for step in steps:
        if (one := step.scan.scanner) not in scanners:
            least = one.range_min if near is None else max(near, one.range_min)
            most = one.range_max if far is None else min(far, one.range_max)
            scanners[one] = Scanner(one.bearings, most, least, one.mount)
    return [replace(step, scan=replace(step.scan, scanner=scanners[step.scan.scanner])) for step in steps]


def start_of(args: argparse.Namespace, nav2: Nav2Options | None) -> tuple[Any, Any] | None:
    """Return pose and covariance of the start from ``--start`` or nav2's file; None for the first reference pose."""
    usual = np.diag(np.square(DEFAULTS.start))
    if args.start is not None:
        return args.start, usual
    if nav2 is None or nav2.initial_pose is None:
        return None
    return nav2.initial_pose, usual if nav2.initial_covariance is None else np.array(nav2.initial_covariance)


def make_filter(args: argparse.Namespace, grid: OccupancyGrid, steps: list[Step], read: Localization) -> ParticleFilter:
    """Make the filter, with a model for each laser; options of the command line override the file."""
    from gpusense.localization.filter import ParticleFilter
    from gpusense.models.scan.beam import BeamModel
    from gpusense.models.scan.field import LikelihoodFieldModel
    from gpusense.world.parameters import BeamParameters

    scanners = {step.sensor: step.scan.scanner for step in steps}
    for sensor, name in enumerate(args.topic):
        if sensor not in scanners:
            raise ValueError(f"--topic: must have scans that are chosen, got none of {name}")
    parameters, nav2 = read.sensor, read.nav2
    beams = args.beams or (DEFAULTS.beams if nav2 is None else nav2.max_beams)
    kind: Any = BeamModel if isinstance(parameters, BeamParameters) else LikelihoodFieldModel
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
    return ParticleFilter(
        models, motion=_motion(args, steps, read), seed=args.seed, temperature=args.temperature, **(chosen | given)
    )


def _motion(args: argparse.Namespace, steps: list[Step], read: Localization) -> MotionModel:
    """Return the motion model from the options, or else from the file of parameters."""
    from gpusense.evaluation.steps import references_to_learn_from
    from gpusense.localization.motion import OdometryMotion
    from gpusense.localization.motion_fit import fit_odometry_motion

    options = dict(alpha=args.motion_noise, sideways=args.sideways, reverse=args.reverse)
    given = {name: value for name, value in options.items() if value is not None}
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
    if read.nav2 is None:
        return OdometryMotion(**read.noise | given)
    if read.nav2.motion == "omni" and not given:
        return read.nav2.make_motion()
    return OdometryMotion(**dict(alpha=read.nav2.alpha[:4]) | given)
