"""Run ``gpusense explain``: the parts that a scene leaves out, keeps and could leave out, and the kernels' text."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

import gpusense as gs
from gpusense._util.typing import CasterName
from gpusense.commands import output
from gpusense.commands.arguments import Options, refuse, scan_model, whole_number
from gpusense.commands.demo import make_world
from gpusense.commands.output import counted
from gpusense.commands.scans import add_log, read_scan
from gpusense.models.scan import savings

if TYPE_CHECKING:
    from gpusense.interface.plan import Plan

FIRST = ("map", "log", "model", "parameters", "measure")
SHARED = ("range", "model", "backend", "seed", "verbose")

EPILOG = """\
The scene is a map, a scan of a log, the model's parameters, and 2000 particles in the free cells of the map. The
default map is the building of 'gpusense demo'; the default scan is drawn by the beam model at a free pose of the map.

The report lists the omitted parts; with -v also, after +, parts that the scene needs, and, after ?, parts that another
choice would omit. --measure times each part that a kernel's flag restores, with and without it, on this device.
Differences below a few percent of the call are noise.

examples:
  gpusense explain
  gpusense explain --map map.yaml --log run.log.gz \\
      --parameters fitted/parameters.yaml --measure
  gpusense explain --model field --set z_rand=0 z_hit=1 --sources"""


def add_options(add: Options) -> None:
    """Add the command's options."""
    add("--map YAML", "a map_server map (default: the building of 'gpusense demo')", Path)
    add_log(add, "a log with scans, of the robot in the map", required=False)
    add("--scan I", "index of the log's scan (default: 0)", whole_number(low=0))
    add("--caster", "method of the expected ranges; beam model only", get_args(CasterName))
    add("--measure", "time the scene with and without each part")
    add("--sources", "also print the text of the kernels as compiled for the scene")


def run(args: argparse.Namespace) -> int:
    """Score the scene, and print the report of its model."""
    grid, scanner, ranges = _scene(args)
    if args.caster is not None and args.model == "field":
        raise ValueError(f"--caster: must be left out with the field, got {args.caster}")
    model = scan_model(args, grid, scanner, **({} if args.caster is None else {"caster": args.caster}))
    model.log_likelihood(savings.poses_on(grid), ranges)
    plan = model.plan(measure=args.measure)
    texts = model.sources() if args.sources else {}
    if args.json:
        output.report(_document(plan) | ({"sources": texts} if args.sources else {}))
        return 0
    output.result(f"{counted(len(plan.omissions), 'part')} left out, {len(plan.kept)} kept, {len(plan.could_go)} that "
                  f"another choice would leave out: {plan.title}")  # fmt: skip
    for part in plan.omissions:
        output.fact(f"- {part.what}:", f"{part.why}; saves {part.saves}{plan.saving(part)}")
    if args.verbose:
        print(f"\n{plan}")
    for kernel, text in texts.items():
        print(f"\n{kernel}:\n{text.rstrip()}")
    return 0


def _scene(args: argparse.Namespace) -> tuple[gs.OccupancyGrid, gs.Scanner, np.ndarray]:
    """Return the map, the scanner and the readings."""
    if args.log is not None and args.map is None:
        raise ValueError(f"--map: must come with --log, got --log {args.log} alone")
    if args.log is None:
        of_log = ("scan", "topic", "mount", "range_max", "range_min", "frame", "odometry_from")
        refuse(args, of_log, "must come with --log")
    grid, scanner = make_world(args.seed)
    if args.map is not None:
        grid = gs.read_map(args.map)
    if args.log is not None:
        scan = read_scan(args)
        return grid, scan.scanner, scan.ranges
    rng = np.random.default_rng(args.seed)
    truth = gs.worlds.free_pose(grid, rng)
    return grid, scanner, gs.worlds.simulate_scan(grid, scanner, truth, gs.BeamParameters(), rng)


def _document(plan: Plan) -> dict[str, Any]:
    """Return a plan as JSON."""
    measured = plan.measured or {}
    left_out = [
        {"part": part.what, "reason": part.why, "saves": part.saves, "measured_s": measured.get(part.what)}
        for part in plan.omissions
    ]
    kept, could_go = ([{"part": one.what, "reason": one.why} for one in some] for some in (plan.kept, plan.could_go))
    flags = sorted(plan.code)
    return {"title": plan.title, "flags": flags, "left_out": left_out, "kept": kept, "could_go": could_go}
