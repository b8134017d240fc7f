"""Run ``gpusense map``: build an occupancy grid from a log, with logged poses or a chain of matches."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gpusense._util.progress import progress
from gpusense.commands.arguments import (
    add_backend,
    add_json,
    number,
    output_path,
    positive_number,
)
from gpusense.commands.map_chain import (
    add_chain,
    chain_log,
    check_chain,
    document,
    is_chained,
    print_chain,
    write_chain,
)
from gpusense.commands.output import counted, grouped, print_fact, print_files, print_report, print_result
from gpusense.commands.scans import add_choice, add_log, add_reference, read_scans_of_lasers, scanners_of
from gpusense.commands.signals import code_of, word_of
from gpusense.evaluation.machine import machine_line
from gpusense.world.map_greys import MODES

if TYPE_CHECKING:
    from gpusense.commands.map_chain import ChainedScans
    from gpusense.mapping.build import MapBuilder
    from gpusense.world.grid import OccupancyGrid

NAME = "map"
HELP = "Build an occupancy grid from the scans of a log."
FIRST = ("log", "out", "plot", "chain", "resolution")

# Scans per step of the progress bar.
_SCANS = 64

EPILOG = """\
Each ray makes the cells that it crosses more likely free, and the cell where it ends more likely occupied. Cells
without a ray stay unknown. The map is map_server's YAML file and an image with white free, black occupied and grey
unknown cells; remove people and close gaps in an image editor.

Logs without corrected poses, such as bags, are chained: each scan is matched to the previous scan and to key scans
around it, revisited places are found and matched, and least squares over all matches and the odometry yields the poses.
The command reports closed loops and doubtful stretches. Poses in raw CARMEN logs are copies of the odometry: --chain
finds better poses. --reference takes the poses of a TUM trajectory. Several lasers of a bag, with mounts from its
transforms, make a common trajectory and map.
A chain begins at 0 0 0 of its map: 'gpusense localize' follows the same log from --start 0 0 0, others with --global.

Ctrl-C ends the chain and writes the map of the scans so far, or ends the map with some of the scans. A map of more than
four million cells is built in bands of rows; an interrupted one holds the finished bands, and some scans of the next.

Exit codes: 0 success, 2 bad input, 130 interrupted, 143 terminated.

examples:
  gpusense map --log run.bag --out map.yaml --tum run.tum --plot map.png
  gpusense localize --map map.yaml --log run.bag --start 0 0 0
  gpusense map --log run.bag --topic /front /rear --out map.yaml
  gpusense map --log run.log.gz --chain --range-limit 20 --out map.yaml
  gpusense map --log run.log.gz --every 2 --range-limit 20 --resolution 0.1 \\
      --out even.yaml
  gpusense map --log run.bag --reference run.tum --out map.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add_log(parser, "a log with scans", several="lasers of the map")
    add_reference(parser)
    add_chain(parser)
    add("--out", required=True, type=output_path(".yaml"), metavar="YAML", help="the map, next to its image")
    add("--mode", choices=MODES, default="trinary",
        help="trinary: white, black and grey; scale: shades, a PNG; raw: per cent as greys, almost black "
        "(default: %(default)s)")  # fmt: skip
    add("--resolution", type=positive_number, default=0.05, metavar="M", help="side of a cell [m] (default: 0.05)")
    add("--range-limit", type=positive_number, metavar="M",
        help="longer ranges clear cells up to it and mark no obstacle [m] (default: none)")  # fmt: skip
    add("--clear-max", action="store_true", help="clear cells along 'no return' readings, up to --range-limit")
    add("--p-hit", type=number, default=0.85, metavar="P", help="occupancy after one hit (default: %(default)s)")
    add("--p-miss", type=number, default=0.45, metavar="P", help="occupancy after one miss (default: %(default)s)")
    add_choice(parser)
    add_backend(parser)
    add_json(parser, verbose=True)


def run(args: argparse.Namespace) -> int:
    """Build and write the map; after Ctrl-C, the map of the scans so far."""
    from gpusense.evaluation.scoring import check_poses
    from gpusense.mapping.build import MapBuilder

    check_chain(args)
    scans, sensor = read_scans_of_lasers(args)
    chained, stop, chosen = None, None, len(scans)
    if is_chained(args, scans):
        chained = chain_log(args, scans, sensor)
        scans, stop = chained.scans, chained.stop
        sensor = sensor[: len(scans)]
    check_poses(scans, args.log)
    motions = None if chained is None else chained.chain.motions
    builder = MapBuilder(
        [scan.ranges for _, scan in scans], [scan.pose or (0.0, 0.0, 0.0) for _, scan in scans],
        resolution=args.resolution, origin=None, shape=None, range_limit=args.range_limit, clear_max=args.clear_max,
        p_hit=args.p_hit, p_miss=args.p_miss, p_prior=0.5, occupied_threshold=65, backend=args.backend, each=_SCANS,
        motion=motions, **scanners_of(scans, sensor),
    )  # fmt: skip
    done, ended = _build(builder)
    grid = builder.grid()
    image = _write(args, grid)
    if chained is not None:
        write_chain(args, chained, grid)
    counted = round(done * len(scans))
    _report(args, builder, grid, image, (counted, chosen), chained)
    stop = stop or ended
    if stop is not None:
        held = f"{counted} of {chosen} scans"
        if builder.bands > 1:
            held = f"its lower part, {100 * done:.0f}% of the work; the rest is unknown"
        sys.stderr.write(f"gpusense: {word_of(stop)}: the map holds {held}\n")
        return code_of(stop)
    return 0


def _write(args: argparse.Namespace, grid: OccupancyGrid) -> Path:
    """Write the map, and return the path of its image."""
    from gpusense.world.map_files import write_map

    transparent = args.mode == "scale" and bool(grid.unknown.any())
    form: Literal["pgm", "png"] = "png" if transparent else "pgm"
    write_map(grid, args.out, mode=args.mode, image_format=form)
    image: Path = args.out.with_suffix(f".{form}")
    return image


def _report(
    args: argparse.Namespace, builder: MapBuilder, grid: OccupancyGrid, image: Path, scans: tuple[int, int],
    chained: ChainedScans | None,
) -> None:  # fmt: skip
    """Print a summary of the map."""
    rows, cols = grid.shape
    free, occupied = int(grid.free.sum()), int(grid.occupied.sum())
    if args.json:
        print_report({
            "map": str(args.out), "image": str(image), "mode": args.mode, "scans": scans[0],
            "scans_chosen": scans[1], "rays": builder.rays, "rows": rows, "cols": cols,
            "resolution": grid.resolution, "origin": grid.origin, "free": free, "occupied": occupied,
            "chain": None if chained is None else document(args, chained),
        })  # fmt: skip
        return
    if chained is None:
        print_result(f"MAPPED: {counted(scans[0], 'scan')} at {'reference' if args.reference else 'logged'} poses")
    else:
        print_chain(chained)
    size = f"{cols * grid.resolution:.0f} x {rows * grid.resolution:.0f} m, cells of {grid.resolution:g} m"
    print_fact("map", f"{size}: {grouped(occupied)} occupied, {grouped(free)} free")
    print_files(args.out, image, args.plot, args.tum, args.poses)
    start = " --start 0 0 0" if chained is not None else ""
    print(f"next       gpusense localize --map {args.out} --log {args.log}{start}")
    if args.verbose:
        chain = "" if chained is None else f"{chained.chain.explain()}\nchained in {chained.seconds:.1f} s\n"
        print(f"\n{chain}{counted(builder.rays, 'ray')} of {counted(scans[0], 'scan')}, {rows} x {cols} cells\n"
              f"{machine_line()}")  # fmt: skip


def _build(builder: MapBuilder) -> tuple[float, KeyboardInterrupt | None]:
    """Count all rays; return the finished share of the work, and the signal that stopped it, or None."""
    done = 0.0
    with progress(max(builder.parts, 1)) as step:
        try:
            for done in builder.steps():
                step(f"{100 * done:.0f}%")
        except KeyboardInterrupt as stop:
            return done, stop
    return done, None
