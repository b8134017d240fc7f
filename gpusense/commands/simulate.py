"""Run ``gpusense simulate``: simulate the log of a robot that drives through a map, for tests and teaching."""

from __future__ import annotations

import argparse
import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense._util.files import check_writable
from gpusense.commands import output
from gpusense.commands.arguments import (
    Options,
    Output,
    add_backend,
    finite_number,
    not_negative_number,
    positive_number,
    range_number,
    tum_file,
    whole_number,
)
from gpusense.commands.output import counted
from gpusense.commands.parameter_files import Localization, read_localization
from gpusense.evaluation import buildings, trajectory_files
from gpusense.evaluation.simulation import run as simulation

FIRST = ("world", "map", "log_out", "map_out", "scans")
SHARED = ("seed", "json")

EPILOG = """\
The robot drives between random places, or along the poses of --path. Its readings are drawn from the beam model around
the ranges to walls and people; its odometry has the noise of the odometry motion model. With --moved, --removed,
--added and --glass the world differs from the map; --true-map replaces the world, so that --map is wrong. The same
options and seed make the same log on every device.

A CARMEN log contains the laser's true poses, for comparison by 'gpusense localize', 'score', 'fit' and 'match'. Bags
contain LaserScan, Odometry and transforms; --tum writes the robot's true poses for --reference.

examples:
  gpusense simulate --world office --map-out office.yaml --log-out run.log
  gpusense localize --map office.yaml --log run.log
  gpusense simulate --map office.yaml --log-out crowded.log.gz --hidden 0.3 \\
      --moved 0.1 --seed 7
  gpusense simulate --map office.yaml --log-out run.bag --mount 0.2 0 0 \\
      --tum truth.tum"""


def add_options(add: Options) -> None:
    """Add the command's options."""
    with add.exclusive(required=True):
        add("--map YAML", "the robot's map, a map_server map", Path)
        add("--world NAME", "a generated map instead: office, corridor, hall or twins, or one of these with a separate "
            "seed, as in office:3")  # fmt: skip
    add("--log-out FILE", "the log to write", Output(), required=True)
    add("--format", "a CARMEN log, gzipped if the name ends in .gz; a bag of ROS 1 (.bag); a new folder with a bag of "
        "ROS 2 (default: by the name, ros1 for .bag and carmen for others)", ("carmen", "ros1", "ros2"))  # fmt: skip
    add("--map-out YAML", "write the robot's map", Output(".yaml"))
    add("--world-out YAML", "write the true world, without people", Output(".yaml"))
    add("--tum FILE", "write the true poses of the robot", tum_file)
    _add_run(add)
    _add_world(add)
    _add_sensors(add)
    add_backend(add, "numpy")


def _add_run(add: Options) -> None:
    add("--scans T", "number of scans (default: 200, or the poses of --path)", whole_number(low=1, high=1_000_000))
    add("--path FILE", "a TUM trajectory of true poses of the robot to follow", Path)
    add("--step M", "distance between scans [m]", positive_number, 0.2)
    add("--turn RAD", "largest turn between scans [rad]", positive_number, 0.35)
    add("--period S", "time between scans [s]", positive_number, 0.25)
    add("--clearance M", "least distance from walls [m]", not_negative_number, 0.35)
    add("--kidnaps N", "number of times that the robot is carried elsewhere without odometry", whole_number(low=0), 0)


def _add_world(add: Options) -> None:
    add("--true-map YAML", "the true world, instead of the robot's map with changes", Path)
    add("--people N", "people who walk near the robot", whole_number(low=0, high=1000), 0)
    add("--hidden SHARE", "share of the beams that additional people hide, up to 0.9", not_negative_number, 0.0)
    add("--moved SHARE", "share of the walls that are moved by 0.5 to 2 m", not_negative_number, 0.0)
    add("--removed SHARE", "share of the walls that are removed", not_negative_number, 0.0)
    add("--added SHARE", "new furniture, as a share of the walls", not_negative_number, 0.0)
    add("--glass SHARE", "share of the walls that beams pass through", not_negative_number, 0.0)


def _add_sensors(add: Options) -> None:
    add("--beams K", "beams of the laser", whole_number(low=1, high=100_000), 181)
    add("--view DEG", "angle between the first and the last beam [deg], below 360", positive_number, 180.0)
    add("--range-max M", "largest range [m]", range_number, 20.0)
    add("--mount X Y THETA", "pose of the laser on the robot [m, m, rad]", finite_number, (0.0, 0.0, 0.0))
    add("--noise M", "standard deviation of ranges [m] (default: 0.02)", positive_number)
    add("--motion-noise A1 A2 A3 A4", "variances of the odometry per squared motion, as in 'gpusense localize' "
        "(default: a fair odometer's, 5 %% of turns and distances)", not_negative_number)  # fmt: skip
    add("--parameters YAML", "a file with beam_model or odometry_motion, such as 'gpusense fit --out' writes, for "
        "readings and odometry", Path)  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Simulate, and write the files."""
    args.format = _check_output(args)
    grid = gs.read_map(args.map) if args.map else _generated(args.world, args.seed)
    world = None if args.true_map is None else gs.read_map(args.true_map)
    path = None if args.path is None else trajectory_files.read_tum(args.path)[1]
    parameters, motion = _noise(args)
    made = gs.worlds.simulate_run(
        grid, _scanner(args), scans=args.scans, world=world, path=path, parameters=parameters, motion=motion,
        people=args.people, hidden=args.hidden, moved=args.moved, removed=args.removed, added=args.added,
        glass=args.glass, kidnaps=args.kidnaps, step=args.step, turn=args.turn, period=args.period,
        clearance=args.clearance, seed=args.seed, backend=args.backend,
    )  # fmt: skip
    for file, content in ((args.map_out, made.grid), (args.world_out, made.world)):
        if file is not None:
            gs.write_map(content, file)
    if args.tum is not None:
        trajectory_files.write_tum(args.tum, made.times.tolist(), made.poses)
    gs.worlds.write_run(made, args.log_out, args.format)
    _report(args, made)
    return 0


def _check_output(args: argparse.Namespace) -> str:
    """Return the format of the log, after checking that it can be written."""
    from gpusense.logs.bag_writer import check_bag

    kind = simulation.kind_of(args.log_out) if args.format is None else str(args.format)
    if kind == "carmen":
        check_writable(args.log_out)
        return kind
    try:
        check_bag(args.log_out, first=kind == "ros1")
    except ImportError as error:
        raise ValueError(f"--format: {error}") from None
    return kind


def _generated(name: str, seed: int) -> gs.OccupancyGrid:
    """Return a generated world by a name such as ``office`` or ``office:3``."""
    kind, colon, number = name.partition(":")
    if kind not in buildings.WORLDS or (colon and not (number.isascii() and number.isdigit() and len(number) < 10)):
        raise ValueError(
            f"--world: must be one of {', '.join(buildings.WORLDS)}, or with a seed as in office:3, got {name!r}"
        )
    return buildings.WORLDS[kind](int(number) if colon else seed)


def _scanner(args: argparse.Namespace) -> Any:
    if args.view >= 360:
        raise ValueError(f"--view: must be below 360, got {args.view:g}")
    view = math.radians(args.view)
    step = view / max(args.beams - 1, 1)
    return gs.Scanner.uniform(
        angle_min=-view / 2 if args.beams > 1 else 0.0, angle_increment=step, count=args.beams,
        range_max=args.range_max, mount=args.mount,
    )  # fmt: skip


def _noise(args: argparse.Namespace) -> tuple[gs.BeamParameters, gs.OdometryMotion]:
    """Return the mixture of the readings and the noise of the odometry."""
    given = Localization(None, {}) if args.parameters is None else read_localization(args.parameters)
    parameters = given.sensor if isinstance(given.sensor, gs.BeamParameters) else simulation.READINGS
    if args.noise is not None:
        parameters = parameters.replace(sigma_hit=args.noise)
    motion = gs.OdometryMotion(**given.noise) if given.noise else simulation.MOTION
    if args.motion_noise is not None:
        motion = dataclasses.replace(motion, alpha=tuple(args.motion_noise))
    return parameters, motion


def _report(args: argparse.Namespace, made: gs.worlds.SimulatedRun) -> None:
    steps = np.hypot(*np.diff(made.poses[:, :2], axis=0).T)
    length = float(steps[~made.kidnapped[1:]].sum())
    changed = int(np.count_nonzero(made.world.occupied != made.grid.occupied)) if args.true_map is None else None
    none = float(np.mean(np.isinf(made.scans))) if made.scans.size else 0.0
    if args.json:
        output.document({
            "log": str(args.log_out), "format": args.format, "scans": len(made.times), "beams": made.scanner.count,
            "length_m": length, "no_return": none, "hidden": float(made.hidden.mean()), "cells_changed": changed,
            "kidnapped_at": np.flatnonzero(made.kidnapped), "seed": args.seed, "first_pose": made.poses[0],
            "last_pose": made.poses[-1], "last_odometry": made.odometry[-1],
        })  # fmt: skip
        return
    output.result(f"SIMULATED: {counted(len(made.times), 'scan')} of {counted(made.scanner.count, 'beam')} over "
                  f"{length:.0f} m")  # fmt: skip
    output.fact("readings", f"{100 * none:.1f} % without return, {100 * made.hidden.mean():.1f} % hidden by people")
    if made.kidnapped.any():
        scans = ", ".join(map(str, np.flatnonzero(made.kidnapped).tolist()))
        output.fact("kidnaps", f"carried elsewhere before scans {scans}")
    output.files(args.map_out, args.world_out, args.log_out, args.tum)
    if grid := args.map_out or args.map:
        print(f"next       gpusense localize --map {grid} --log {args.log_out} --global")
